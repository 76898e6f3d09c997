"""The readout converts irradiance on the pixels to digital numbers, and those to colours."""

import math
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
from torch import Tensor

from dolens.errors import InputError, check_choice
from dolens.sensor.colour import PATTERNS, demosaic, mosaic
from dolens.sensor.noise import BatchShare, add_read_noise, add_shot_noise

_MOST_BITS = 16


@dataclass(frozen=True)
class Readout:
    """A `Readout` applies exposure, colour filters, noise, saturation and quantisation to an image.

    In this order, s being the irradiance relative to that of a white plane on the axis:

    1. exposure: s becomes E·(N₀/N)²·s, where 1 is full scale, N the lens's F-number and N₀ the
       reference F-number that the exposure is stated for; without one it becomes E·s;
    2. colour filters: each pixel keeps one colour;
    3. shot noise of N electrons at full scale: variance E·s/N (`add_shot_noise`);
    4. read noise: variance σ²;
    5. analogue-to-digital conversion: with black level b, the code is (b + (1 - b)·signal)·(2ⁿ - 1)
       to the nearest whole number from 0 to 2ⁿ - 1, and b is subtracted again after it.

    Off saturation the mean is E·s and the variance is E·s/N + σ² + Δ²/12, the photon transfer
    curve, with the step Δ = 1/((1 - b)·(2ⁿ - 1)) as long as the noise is not small against Δ.  The
    converter saturates at full scale, before the pixel does.

    With a reference F-number the exposure time is the same for all apertures: a lens stopped down
    by one stop gives half the electrons, so the share of shot noise grows by √2 and that of read
    noise by 2, as `develop` divides the exposure out.

    Gradients pass the rounding as if it were not there (straight-through).  Where a value is
    clipped, beyond the ends of the range, they are zero, which is the derivative: a saturated pixel
    says nothing about the lens.  An overexposed image teaches nothing, so lower the exposure.

    Attributes:
        exposure: E, factor on the irradiance; at 1 a white plane on the axis just saturates.
        full_well: N, electrons at full scale; None for no shot noise.
        read_noise: σ, standard deviation as a share of full scale.
        bits: n, of the converter, 1 to 16; None for no quantisation.
        saturate: clip to what the converter can give, -b/(1 - b) to 1, without `bits` too; with
            `bits` values are clipped in any case, there being no other codes.
        black_level: b, the code of no light as a share of the codes' range, at least 0 and below
            1.  It keeps negative noise; at 0 a dark pixel's noise loses its lower half, and its
            mean is too high.  Where nothing is clipped or quantised it has no effect.
        pattern: colour filters, `RGGB`, `GRBG`, `GBRG` or `BGGR`; None where a pixel sees all
            channels.
        reference_f_number: N₀, that `exposure` is stated for; None: any lens has this exposure.
        f_number: N, of the lens in front; None: the reference.  `at_f_number` sets it.
    """

    exposure: float = 1.0
    full_well: float | None = None
    read_noise: float = 0.0
    bits: int | None = None
    saturate: bool = False
    black_level: float = 0.0
    pattern: str | None = None
    reference_f_number: float | None = None
    f_number: float | None = None

    @classmethod
    def at_light(cls, light: float, full_well: float, **others: Any) -> Self:
        """Return a readout in which a white plane, imaged on the axis, gives `light` electrons a
        pixel.

        Args:
            light: electrons of a white pixel behind the lens at the reference F-number.
            full_well: electrons at full scale.
            **others: of `Readout`; `read_noise` is a share of full scale.

        Raises:
            InputError: white lies beyond full scale, or a number is not positive.
        """
        good = _is_number(light, above=0.0)
        _require("light", light, good, "electrons above 0")
        well = _is_number(full_well, above=0.0)
        _require("full_well", full_well, well, "electrons above 0")
        _require("light", light, light <= full_well, f"at most the full well, {full_well:g}")
        return cls(exposure=light / full_well, full_well=full_well, **others)

    def __post_init__(self) -> None:
        _require("exposure", self.exposure, _is_number(self.exposure, above=0.0), "above 0")
        well = self.full_well is None or _is_number(self.full_well, above=0.0)
        _require("full_well", self.full_well, well, "null, or electrons above 0")
        read = self.read_noise == 0.0 or _is_number(self.read_noise, above=0.0)
        _require("read_noise", self.read_noise, read, "0 or above")
        bits = self.bits is None or self.bits in range(1, _MOST_BITS + 1)
        _require("bits", self.bits, bits, f"null, or a whole number from 1 to {_MOST_BITS}")
        _require("saturate", self.saturate, isinstance(self.saturate, bool), "true or false")
        black = self.black_level == 0.0 or _is_number(self.black_level, above=0.0, below=1.0)
        _require("black_level", self.black_level, black, "at least 0 and below 1")
        for key in ("reference_f_number", "f_number"):
            value = getattr(self, key)
            good = value is None or _is_number(value, above=0.0)
            _require(key, value, good, "null, or a number above 0")
        if self.pattern is not None:
            check_choice(self.pattern, PATTERNS, "pattern")

    def at_f_number(self, f_number: float) -> Self:
        """Return the same readout, with the same exposure time, at another F-number of the lens."""
        return replace(self, f_number=f_number)

    @property
    def relative_exposure(self) -> float:
        """Return E·(N₀/N)², the signal of a white plane on the axis; 1 is full scale."""
        if self.reference_f_number is None or self.f_number is None:
            return self.exposure
        return self.exposure * (self.reference_f_number / self.f_number) ** 2

    @property
    def noise(self) -> tuple[float, float]:
        """Return a and b: the variance a·x + b of a developed image at light x, off saturation.

        Interpolated colours of a pattern of filters have less, and neighbours share it.
        """
        exposure = self.relative_exposure
        shot = 0.0 if self.full_well is None else 1.0 / (self.full_well * exposure)
        step = 0.0
        if self.bits is not None:
            step = 1.0 / ((1.0 - self.black_level) * (2**self.bits - 1))
        return shot, (self.read_noise**2 + step**2 / 12.0) / exposure**2

    def __call__(
        self, image: Tensor, generator: torch.Generator, share: BatchShare | None = None
    ) -> Tensor:
        """Read an image out.

        Args:
            image: (..., C, H, W) linear light, 1 for a white plane on the axis; with a pattern C
                is 3, red, green, blue.
            generator: of the noise, on the image's device.  Shot noise is drawn first and read
                noise second, each for every value of the raw image, and neither where it is off.
            share: of a batch whose images these are (B, ...); None: they are all of it.

        Returns:
            (..., C, H, W), with a pattern (..., 1, H, W): the raw image, 1 at full scale, black
            level subtracted; by default the image itself.

        Raises:
            InputError: a pattern and not three channels.
        """
        exposure = self.relative_exposure
        raw = image if exposure == 1.0 else exposure * image
        if self.pattern is not None:
            raw = mosaic(raw, self.pattern)
        if self.full_well is not None:
            raw = add_shot_noise(raw, self.full_well, generator, share)
        raw = add_read_noise(raw, self.read_noise, generator, share)
        if self.bits is None and not self.saturate:
            return raw
        black, gain = self.black_level, 1.0 - self.black_level
        code = _clip(black + gain * raw)
        if self.bits is not None:
            code = quantise(code, self.bits)
        return (code - black) / gain

    def develop(self, raw: Tensor) -> Tensor:
        """Return the linear light of a raw image: interpolate colours and divide by the exposure.

        Args:
            raw: (..., C, H, W), with a pattern (..., 1, H, W), as `__call__` gives it.

        Returns:
            (..., C, H, W), with a pattern (..., 3, H, W): 1 for a white plane on the axis,
            whatever the exposure; for display, `linear_to_srgb` follows.

        Raises:
            InputError: with a pattern, not one channel, or fewer than 3×3 pixels.
        """
        linear = raw if self.pattern is None else demosaic(raw, self.pattern)
        exposure = self.relative_exposure
        return linear if exposure == 1.0 else linear / exposure


def quantise(signal: Tensor, bits: int) -> Tensor:
    """Round to the nearest of 2ⁿ evenly spaced values from 0 to 1, with the gradient of the signal
    itself.

    Rounding has no useful derivative, zero almost everywhere; the straight-through estimator
    (Bengio, Léonard and Courville, arXiv:1308.3432) takes 1 for it.

    Args:
        signal: from 0 to 1; values outside are rounded to the same grid, not clipped.
        bits: n.
    """
    steps = 2**bits - 1
    # The difference is zero to the bit, and carries the gradient.
    return (signal * steps).round().detach() / steps + (signal - signal.detach())


def _clip(signal: Tensor) -> Tensor:
    """Limit to 0 … 1; the ends themselves keep their gradient (clamp's varies with the version)."""
    return torch.where(signal < 0.0, 0.0, torch.where(signal > 1.0, 1.0, signal))


def _is_number(value: object, above: float, below: float = math.inf) -> bool:
    return isinstance(value, int | float) and above < value < below


def _require(key: str, value: object, holds: bool, allowed: str) -> None:
    if not holds:
        raise InputError(f"readout: {key} is {value}; allowed: {allowed}")
