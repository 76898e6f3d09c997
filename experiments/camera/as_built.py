"""Cameras as built: each lens is off by its tolerances, and focused by an assembly line."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError, check_choice, check_count
from dolens.experiments.camera.views.base import Imaging, seed_of
from dolens.experiments.settings import check_positive
from dolens.optics.lens import Lens
from dolens.sensor.noise import generator_of, noisy_point_spread_functions
from dolens.tolerancing import (
    FocusTarget,
    Tolerances,
    assembled,
    expected_spread,
    scaled_tolerances,
    tolerances_from,
)

# What a network knows of the lens whose images it restores.
CALIBRATIONS = ("design", "own", "measured")
# A stream of random numbers apart from those of images, noise and scenes.
_OFFSET = 1 << 37
# Lenses of a test do not meet those of a training.
_TESTED = 1 << 35


@dataclass(frozen=True)
class AsBuilt:
    """Settings of lenses that are made with errors; they count where tolerances are given.

    Attributes:
        factor: multiplies all tolerances.
        train: whether training images are taken through lenses that are made anew at each step;
            else the lens is trained as drawn, and judged as built.
        lenses_per_step: made for each step; they share its textures.
        focused: whether an assembly line sets each sensor, by a point on the axis.
        calibration: which point spread functions the network is given: `design`, those of the
            lens as drawn, the same for all; `own`, those of each lens; `measured`, the same with
            the noise of a measurement.
        electrons: that a measured function has in all.
        read_noise: electrons a pixel, of a measured function.
        desensitising: weight of the mean square by which errors move rays within their spots, in
            pixels², beside the loss; 0: none.
        tested: lenses that the camera is judged by, behind its test; 0: none.
        crops: test crops that each of them images.
        judged_factors: factors besides, at which the same camera is judged by as many lenses; the
            errors of the lens of one number are in proportion.
        loss_db: a lens passes whose worst view loses no more than this to the lens as drawn.

    Raises:
        InputError: a number out of range, or an unknown word.
    """

    factor: float = 1.0
    train: bool = True
    lenses_per_step: int = 1
    focused: bool = True
    calibration: str = "design"
    electrons: float = 1.0e5
    read_noise: float = 3.0
    desensitising: float = 0.0
    tested: int = 500
    crops: int = 4
    judged_factors: Sequence[float] = ()
    loss_db: float = 1.0

    def __post_init__(self) -> None:
        check_choice(self.calibration, CALIBRATIONS, "as_built.calibration")
        for name in ("factor", "electrons", "loss_db"):
            check_positive(f"as_built.{name}", getattr(self, name))
        for name in ("lenses_per_step", "crops"):
            check_count(f"as_built.{name}", getattr(self, name))
        for name in ("tested", "read_noise", "desensitising"):
            if not getattr(self, name) >= 0:
                raise InputError(f"as_built.{name}: {getattr(self, name)}; allowed: 0 or more")
        for factor in self.judged_factors:
            check_positive("as_built.judged_factors", factor)


class MadeLens(NamedTuple):
    """One lens that was made.

    Attributes:
        values: its parameters, as `Lens.system` takes them.
        errors: (P,), of the tolerances' parameters, in the lens's units.
        number: of the lens; it decides the noise of its calibration.
    """

    values: dict[str, Tensor]
    errors: Tensor
    number: int


class Manufacture:
    """Makes lenses of a design.

    Args:
        settings: how.
        given: tolerances, see `tolerances_from`.
        lens: as training begins; the assembly line's light goes through its pupil.
        views: image the scene.

    Attributes:
        tolerances: of the lens as training begins: relative ones stay shares of those values.

    Raises:
        InputError: tolerances that are not of the lens.
    """

    def __init__(
        self, settings: AsBuilt, given: Mapping[str, Any], lens: Lens, views: Imaging
    ) -> None:
        self.settings = settings
        self.tolerances: Tolerances = tolerances_from(lens, given, settings.factor)
        if not self.tolerances.names:
            raise InputError("tolerances: none is given; allowed: null, or one parameter or more")
        if not views.registers_moved_images:
            raise InputError(
                "renderer: a lens that is made moves its image; allowed with tolerances: "
                "psf_narrow or another psf with registration: centred, or with "
                "views.truth: chief_rays psf with registration: chief_rays, and rays"
            )
        self._views = views
        self._pitch = views.sensor.pixel_pitch
        waves = tuple(views.scene.wavelengths)
        self._target = (
            FocusTarget.of(lens, views.object_distance, waves) if settings.focused else None
        )
        self._spots = views.spots(lens, 3, 6) if settings.desensitising else []

    def at_factor(self, factor: float) -> "Manufacture":
        """Return the manufacture of the same lenses to tolerances times another factor."""
        found = copy.copy(self)
        found.tolerances = scaled_tolerances(self.tolerances, factor / self.settings.factor)
        found.settings = replace(self.settings, factor=factor)
        return found

    @property
    def in_training(self) -> bool:
        """Return whether training images are taken through lenses that are made."""
        return self.settings.train

    @property
    def gives_the_design_s_functions(self) -> bool:
        """Return whether a network is given the same functions for all lenses, the design's."""
        return self.settings.calibration == "design"

    def for_step(self, lens: Lens, step: int) -> list[MadeLens]:
        """Return the lenses of a training step, differentiable in the design."""
        return self._made(lens, self.settings.lenses_per_step, step)

    def tested(self, lens: Lens, number: int) -> MadeLens:
        """Return one of the lenses that judge a camera; the same of every camera."""
        return self._made(lens, 1, _TESTED + number)[0]

    def _made(self, lens: Lens, count: int, number: int) -> list[MadeLens]:
        # Lenses of a test must be the same whatever the seed of a training is.
        seed = 0 if number >= _TESTED else self._views.seed
        generator = generator_of(seed_of(seed, "train", _OFFSET + number))
        return [
            MadeLens(assembled(lens, self.tolerances, errors, self._target), errors, number)
            for errors in self.tolerances.draw(count, generator)
        ]

    def functions(
        self,
        told: Callable[[Mapping[str, Tensor]], Tensor | None],
        design: Mapping[str, Tensor],
        made: MadeLens,
    ) -> Tensor | None:
        """Return the point spread functions that a network is given of images of a made lens.

        Args:
            told: from a lens's values to functions that the camera's network would be given.
            design: variables of the lens as drawn.
            made: the lens whose images it restores.
        """
        own = told(design if self.gives_the_design_s_functions else made.values)
        if own is None or self.settings.calibration != "measured":
            return own
        generator = generator_of(_OFFSET + made.number)
        measured = noisy_point_spread_functions(
            own, self.settings.electrons, self.settings.read_noise, generator
        )
        # The noise is held in the derivative as it is in the value.
        return own + (measured - own).detach()

    def penalty(self, lens: Lens) -> Tensor:
        """Return what sensitivity adds to the loss, ()."""
        if not self._spots:
            return torch.zeros((), dtype=lens.dtype, device=lens.device)
        spreads = [
            expected_spread(lens, self.tolerances, spots, self._target) for spots in self._spots
        ]
        mean = torch.stack(spreads).mean() / self._pitch**2
        return self.settings.desensitising * mean


def manufacture_of(
    settings: AsBuilt | None, given: Mapping[str, Any] | None, lens: Lens, views: Imaging
) -> Manufacture | None:
    """Return what makes the lenses of a camera; None where no tolerances are given."""
    if given is None:
        return None
    return Manufacture(settings or AsBuilt(), given, lens, views)
