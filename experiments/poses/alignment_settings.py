"""Settings of the simulated alignment of a lens with one misaligned element."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dolens.alignment.element_fit import POSE
from dolens.alignment.moments import Pixels
from dolens.alignment.spot_moments import SENSOR
from dolens.errors import InputError, check_choice, check_keys
from dolens.experiments.checks import check_count, check_finite, check_positive
from dolens.optics.parameter_names import unit_factors


@dataclass(frozen=True)
class Detector:
    """The detector that counts the photons of the spots.

    Attributes:
        pixel_pitch: mm; 0: every photon is located exactly, and nothing is read.
        read_noise: electrons RMS of a pixel.
        window: half of the side of the square that a spot is summed over, in its RMS radii.

    Raises:
        InputError: a number out of range, or read noise without pixels.
    """

    pixel_pitch: float
    read_noise: float
    window: float

    def __post_init__(self) -> None:
        if self.pixel_pitch == 0.0 and self.read_noise != 0.0:
            raise InputError(f"read_noise: {self.read_noise!r}; allowed: 0 where pixel_pitch is 0")
        self.pixels()

    def pixels(self) -> Pixels | None:
        """Return the pixels; None for an ideal detector."""
        if self.pixel_pitch == 0.0:
            return None
        return Pixels(self.pixel_pitch, self.read_noise, self.window)


@dataclass(frozen=True)
class Misalignments:
    """The simulated lenses: one that is known, and a number of random ones.

    Attributes:
        demo: the first lens: `element`, and any of `tilt_x`, `tilt_y` (degrees), `decenter_x`,
            `decenter_y` (mm); its sensor's place is random.
        count: random lenses: elements are equally likely, tilts and decentres uniform.
        tilt_range: half-range of the tilts about x and y, degrees.
        decenter_range: half-range of the decentres, mm.
        sensor_shift_range: half-range of the sensor's place in x and in y, mm; 0: it is known.
        focus_range: half-range of the sensor's place along the axis, mm; 0: it is known.
        seed: of the lenses and of noise.

    Raises:
        InputError: a number out of range, or an unknown key of `demo`.
    """

    demo: Mapping[str, Any]
    count: int
    tilt_range: float
    decenter_range: float
    sensor_shift_range: float
    focus_range: float
    seed: int

    def __post_init__(self) -> None:
        check_count("misalignments", self.count)
        check_positive("tilt_range", self.tilt_range)
        check_positive("decenter_range", self.decenter_range)
        for key in ("sensor_shift_range", "focus_range"):
            number = getattr(self, key)
            if not 0.0 <= number < math.inf:
                raise InputError(f"{key}: {number!r}; allowed: a positive number, or 0 if known")
        check_keys(self.demo, ("element", *POSE), "demo")
        for name in POSE:
            check_finite(f"demo.{name}", self.demo.get(name, 0.0))

    def unknown_of_sensor(self) -> list[str]:
        """Return the names of the sensor's coordinates that are unknown to the fits."""
        return [name for name, half_range in self._places().items() if half_range > 0.0]

    def half_range(self) -> Tensor:
        """Return the half-ranges of tilts (radians), decentres and unknown coordinates (mm)."""
        tilt, shift = self.tilt_range, self.decenter_range
        pose = torch.tensor([tilt, tilt, shift, shift], dtype=torch.float64) * unit_factors(POSE)
        places = [float(half_range) for half_range in self._places().values() if half_range > 0.0]
        return torch.cat([pose, torch.tensor(places, dtype=torch.float64)])

    def known_case(self, elements: Sequence[str]) -> tuple[int, Tensor]:
        """Return the demo's element (its number) and pose (4,), in radians and mm.

        Raises:
            InputError: it names none of the elements.
        """
        name = self.demo.get("element")
        check_choice(name, elements, "demo.element")
        values = [float(self.demo.get(part, 0.0)) for part in POSE]
        pose = torch.tensor(values, dtype=torch.float64) * unit_factors(POSE)
        return list(elements).index(name), pose

    def _places(self) -> dict[str, float]:
        shift = self.sensor_shift_range
        return dict(zip(SENSOR, (shift, shift, self.focus_range), strict=True))
