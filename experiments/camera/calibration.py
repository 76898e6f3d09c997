"""Calibrations of a camera that give point spread functions other than the true ones.

A network that deconvolves is given the point spread functions of the very lens that made the image.
A real one is given those of a calibration.  Each class here makes the functions of a calibration
that went wrong in one way, for test metrics beside those of the exact functions.
"""

import math
from collections.abc import Mapping
from typing import Any, Protocol

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.experiments.camera.views.base import Imaging
from dolens.optics.lens import Lens
from dolens.sensor.noise import noisy_point_spread_functions
from dolens.tolerancing import assembled, tolerances_from


class Miscalibration(Protocol):
    """Makes point spread functions that a network is given instead of the exact ones."""

    def functions(
        self,
        views: Imaging,
        lens: Lens,
        exact: Tensor,
        generator: torch.Generator,
    ) -> Tensor:
        """Return point spread functions (views, 3, K, K) for one batch.

        Args:
            views: those of the camera.
            lens: the lens that took the images.
            exact: (views, 3, K, K), its own functions.
            generator: on the CPU, for this batch.
        """


class OtherDepth:
    """Gives the functions of one plane, where the target of the calibration stood.

    Args:
        depth: mm in front of the first vertex.
    """

    def __init__(self, depth: float) -> None:
        if not (math.isfinite(depth) and depth > 0.0):
            raise InputError(f"miscalibrations: depth must be positive (mm), not {depth}")
        self.depth = float(depth)

    def functions(
        self,
        views: Imaging,
        lens: Lens,
        exact: Tensor,
        generator: torch.Generator,
    ) -> Tensor:
        """Return the functions of the one plane."""
        return views.point_spread_functions(lens, depths=(self.depth,))


class OtherSample:
    """Gives the functions of another lens of the series, off by its tolerances.

    Every batch gets another sample.

    Args:
        tolerances: as of `dolens.tolerancing.tolerances_from`.
        factor: multiplies all of them.
    """

    def __init__(self, tolerances: Mapping[str, Any], factor: float = 1.0) -> None:
        self.tolerances = dict(tolerances)
        self.factor = factor

    def functions(
        self,
        views: Imaging,
        lens: Lens,
        exact: Tensor,
        generator: torch.Generator,
    ) -> Tensor:
        """Return the functions of a lens whose errors are drawn."""
        tolerances = tolerances_from(lens, self.tolerances, self.factor)
        (errors,) = tolerances.draw(1, generator)
        made = assembled(lens, tolerances, errors, None)
        return views.point_spread_functions(lens.with_values(made))


class NoisyMeasurement:
    """Gives the exact functions with the noise of one measurement.

    Args:
        electrons: collected in the whole of each function and colour.
        read_noise: electrons a pixel.
        seed: of the one measurement.
    """

    def __init__(self, electrons: float, read_noise: float = 0.0, seed: int = 0) -> None:
        if not electrons > 0.0 or not read_noise >= 0.0:
            raise InputError(
                "miscalibrations: electrons must be positive and read_noise at least 0, not "
                f"{electrons} and {read_noise}"
            )
        self.electrons, self.read_noise, self.seed = electrons, read_noise, seed

    def functions(
        self,
        views: Imaging,
        lens: Lens,
        exact: Tensor,
        generator: torch.Generator,
    ) -> Tensor:
        """Return the exact functions with shot noise and read noise."""
        same = torch.Generator().manual_seed(self.seed)
        return noisy_point_spread_functions(exact, self.electrons, self.read_noise, same)


def check(
    miscalibrations: Mapping[str, Miscalibration], lens: Lens, knows_places: bool = False
) -> None:
    """Check that the tolerances of calibrations are parameters of the lens.

    Raises:
        InputError: one is not; or the network is told functions of each image's own place, which
            calibrations do not make.
    """
    if miscalibrations and knows_places:
        raise InputError(
            f"miscalibrations: {', '.join(miscalibrations)}; allowed with views of a field and a "
            "network that is told the functions of each place: none"
        )
    for calibration in miscalibrations.values():
        if isinstance(calibration, OtherSample):
            tolerances_from(lens, calibration.tolerances, calibration.factor)
