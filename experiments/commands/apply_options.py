"""How pictures are applied to: depths, scale, noise, and the files that are written."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from dolens.errors import InputError, check_choice
from dolens.experiments.camera.restored_windows import (
    DEFAULT_WINDOW,
    GRID,
)
from dolens.experiments.camera.views.whole import DIFFRACTION
from dolens.sensor.image_files import MEGAPIXELS

# Pixels of a picture to one of the sensor.
_SMALLEST_SCALE, _LARGEST_SCALE = 0.01, 1000.0
_FORMATS = ("png", "tif")


@dataclass(frozen=True)
class Options:
    """How pictures are applied to.

    Attributes:
        depths: mm in front of the first vertex; none: the run's middle depth.
        scale: pixels of a picture to one of the sensor; None: as the run's views have it.
        diffraction: `none`, `limit` or `wave`; None: as the run's test images have it.
        seed: of the noise.
        bits: of what is written, 8 or 16.
        format: of what is written, `png` or `tif`.
        window: pixels along each side of what is restored at once, a multiple of 64.
        save_raw: whether the sensor's raw values are written too, as .npy.
        raw: whether the files are what a real sensor gave.
        black_level: of raw files, in their own numbers; None: the run's readout's.
        white_level: likewise.
        megapixels: the largest picture that is read, millions of pixels.

    Raises:
        InputError: a value that is not allowed.
    """

    depths: Sequence[float] = ()
    scale: float | None = None
    diffraction: str | None = None
    seed: int = 0
    bits: int = 8
    format: str = "png"
    window: int = DEFAULT_WINDOW
    save_raw: bool = False
    raw: bool = False
    black_level: float | None = None
    white_level: float | None = None
    megapixels: float = MEGAPIXELS

    def __post_init__(self) -> None:
        if self.bits not in (8, 16):
            raise InputError(f"--bits: {self.bits}; allowed: 8, 16")
        check_choice(self.format, _FORMATS, "--format")
        if self.window < GRID or self.window % GRID:
            raise InputError(f"--window: {self.window}; allowed: multiples of {GRID}, pixels")
        if not 0 <= self.seed < 2**63:
            raise InputError(f"--seed: {self.seed}; allowed: 0 to 2^63 - 1")
        if self.scale is not None and not _SMALLEST_SCALE <= self.scale <= _LARGEST_SCALE:
            raise InputError(
                f"--scale: {self.scale:g}; allowed: {_SMALLEST_SCALE:g} to "
                f"{_LARGEST_SCALE:g} pixels"
            )
        if not all(0.0 < depth < math.inf for depth in self.depths):
            raise InputError(f"--depth: {self.depths}; allowed: positive numbers, mm")
        if not 0.0 < self.megapixels < math.inf:
            raise InputError(f"--megapixels: {self.megapixels:g}; allowed: above 0")
        for level in ("black", "white"):
            if not math.isfinite(getattr(self, f"{level}_level") or 0.0):
                raise InputError(f"--{level}-level: must be a finite number")
        if self.white_level is not None and not self.white_level > (self.black_level or 0.0):
            raise InputError(f"--white-level: {self.white_level:g}; allowed: above black")
        if self.diffraction is not None:
            check_choice(self.diffraction, DIFFRACTION, "--diffraction")
        if not self.raw and (self.black_level, self.white_level) != (None, None):
            raise InputError("--black-level and --white-level are of raw files; give --raw too")
        if self.raw and (self.depths or self.scale or self.diffraction or self.save_raw):
            raise InputError(
                "--raw: the files are images already; leave out --depth, --scale, --diffraction "
                "and --save-raw"
            )
