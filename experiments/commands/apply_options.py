"""How pictures are applied to: depths, scale, noise, and the files that are written."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from dolens.errors import InputError, check_choice, comma_hint
from dolens.experiments.camera.restored_windows import GRID
from dolens.experiments.camera.views.whole import DIFFRACTION
from dolens.sensor.image_files import MEGAPIXELS

# Pixels of a picture to one of the sensor.
_SMALLEST_SCALE, _LARGEST_SCALE = 0.01, 1000.0
_FORMATS = ("png", "tif")
_UNITS = {"": 1.0, "mm": 1.0, "cm": 10.0, "m": 1e3, "km": 1e6}
_LENGTH = re.compile(r"([-+]?[0-9.]+(?:e[-+]?[0-9]+)?|nan|inf(?:inity)?) ?([a-z]*)", re.ASCII)
# Micrometres and millimetres that a sensor may have.
_LARGEST_PITCH, _LARGEST_SENSOR = 1e6, 1e5


def depth_of(text: str) -> float:
    """Return a depth in mm: `4500`, `6m`, `30 cm`, or `inf`.

    Raises:
        InputError: it is no length.
    """
    found = _LENGTH.fullmatch(text.strip().lower())
    try:
        if found is not None:
            return float(found[1]) * _UNITS[found[2]]
    except (ValueError, KeyError):
        pass
    raise InputError(
        f"--depth: '{text}' is no length; allowed: mm, or with a unit as in 6m or 30cm, or inf"
        f"{comma_hint(text)}"
    )


def size_of(text: str) -> tuple[float, float]:
    """Return width and height in mm of a sensor: `36x24`.

    Raises:
        InputError: it is none, or not of positive numbers.
    """
    try:
        width, height = (float(part) for part in re.split("[x×]", text.lower()))
    except ValueError:
        width = height = math.nan
    if not (0.0 < width <= _LARGEST_SENSOR and 0.0 < height <= _LARGEST_SENSOR):
        raise InputError(f"--sensor: '{text}'; allowed: WIDTHxHEIGHT in mm, as 36x24")
    return width, height


@dataclass(frozen=True, kw_only=True)
class PictureOptions:
    """How pictures are applied to, whatever the camera.

    Attributes:
        depths: mm in front of the first vertex; none: the camera's own.
        scale: pixels of a picture to one of the sensor; None: as the camera has it.
        diffraction: `none`, `limit` or `wave`; None: as the camera has it.
        seed: of the noise.
        bits: of what is written, 8 or 16.
        format: of what is written, `png` or `tif`.
        window: pixels along each side of what is restored at once, a multiple of 64; None: as the
            camera has it.
        save_raw: whether the sensor's raw values are written too, as .npy.
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
    window: int | None = None
    save_raw: bool = False
    megapixels: float = MEGAPIXELS

    def __post_init__(self) -> None:
        if self.bits not in (8, 16):
            raise InputError(f"--bits: {self.bits}; allowed: 8, 16")
        check_choice(self.format, _FORMATS, "--format")
        if self.window is not None and (self.window < GRID or self.window % GRID):
            raise InputError(f"--window: {self.window}; allowed: multiples of {GRID}, pixels")
        if not 0 <= self.seed < 2**63:
            raise InputError(f"--seed: {self.seed}; allowed: 0 to 2^63 - 1")
        if self.scale is not None and not _SMALLEST_SCALE <= self.scale <= _LARGEST_SCALE:
            raise InputError(
                f"--scale: {self.scale:g}; allowed: {_SMALLEST_SCALE:g} to "
                f"{_LARGEST_SCALE:g} pixels"
            )
        if not all(depth > 0.0 for depth in self.depths):
            raise InputError(f"--depth: {_listed(self.depths)}; allowed: above 0 mm")
        if not 0.0 < self.megapixels < math.inf:
            raise InputError(f"--megapixels: {self.megapixels:g}; allowed: above 0")
        if self.diffraction is not None:
            check_choice(self.diffraction, DIFFRACTION, "--diffraction")


@dataclass(frozen=True, kw_only=True)
class Options(PictureOptions):
    """How a run's camera is applied to pictures.

    Attributes:
        raw: whether the files are what a real sensor gave.
        black_level: of raw files, in their own numbers; None: the run's readout's.
        white_level: likewise.

    Raises:
        InputError: a value that is not allowed.
    """

    raw: bool = False
    black_level: float | None = None
    white_level: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not all(math.isfinite(depth) for depth in self.depths):
            raise InputError(f"--depth: {_listed(self.depths)}; allowed of a run: finite ones, mm")
        for level in ("black", "white"):
            if not math.isfinite(getattr(self, f"{level}_level") or 0.0):
                raise InputError(f"--{level}-level: must be a finite number")
        if self.white_level is not None and not self.white_level > (self.black_level or 0.0):
            raise InputError(f"--white-level: {self.white_level:g}; allowed: above black")
        if not self.raw and (self.black_level, self.white_level) != (None, None):
            raise InputError("--black-level and --white-level are of raw files; give --raw too")
        if self.raw and (self.depths or self.scale or self.diffraction or self.save_raw):
            raise InputError(
                "--raw: the files are images already; leave out --depth, --scale, --diffraction "
                "and --save-raw"
            )


@dataclass(frozen=True, kw_only=True)
class LensOptions(PictureOptions):
    """How a lens is applied to pictures, and the sensor behind it.

    Attributes:
        light: electrons of a white pixel on the axis.
        read_noise: electrons, standard deviation.
        bayer: whether a pixel has one of the colour filters RGGB, else it sees all three colours.
        sensor: width and height, mm; None: the largest in the lens's image circle.
        pitch: of the pixels, micrometres; None: as many pixels as the picture has.

    Raises:
        InputError: a value that is not allowed.
    """

    light: float = 100.0
    read_noise: float = 3.0
    bayer: bool = False
    sensor: tuple[float, float] | None = None
    pitch: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.pitch is not None and not 0.0 < self.pitch <= _LARGEST_PITCH:
            raise InputError(
                f"--pitch: {self.pitch:g}; allowed: above 0, to {_LARGEST_PITCH:g} micrometres"
            )
        if self.pitch is not None and self.scale is not None:
            raise InputError("--pitch and --scale both say how many pixels there are; give one")


def _listed(depths: Sequence[float]) -> str:
    return ", ".join(f"{depth:g}" for depth in depths)
