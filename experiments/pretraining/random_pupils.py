"""Random pupils that formulas give, and the numbers that they are drawn with."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.diffraction.pupil_fit import RegularPupil
from dolens.diffraction.wavefront import MM_PER_NM
from dolens.experiments.pretraining.pixel_functions import pupil_rays

# nm, where strengths in waves are meant.
GREEN = 540.0
_MIDDLES = (620.0, GREEN, 460.0)
# Samples of a pupil where rays give its moments.
COARSE = 48


class Draw:
    """Draws numbers from a generator."""

    def __init__(self, generator: torch.Generator) -> None:
        self.generator = generator

    def uniform(self, low: float = 0.0, high: float = 1.0) -> float:
        """Return a number, evenly distributed."""
        share = torch.rand((), generator=self.generator, dtype=torch.float64)
        return low + (high - low) * float(share)

    def log_uniform(self, low: float, high: float) -> float:
        """Return a number whose logarithm is evenly distributed."""
        return math.exp(self.uniform(math.log(low), math.log(high)))

    def normal(self, count: int) -> Tensor:
        """Return numbers (count,) of unit variance."""
        return torch.randn(count, generator=self.generator, dtype=torch.float64)

    def chance(self, share: float) -> bool:
        """Return true in this share of cases."""
        return self.uniform() < share

    def sign(self) -> float:
        """Return 1 or -1."""
        return 1.0 if self.chance(0.5) else -1.0

    def one_of(self, items: Sequence[str]) -> str:
        """Return one of several, all as likely."""
        return items[int(torch.randint(len(items), (), generator=self.generator))]

    def bands(self) -> list[float]:
        """Return two wavelengths (nm) for each of red, green and blue, a filter's band."""
        half = self.uniform(4.0, 25.0)
        middles = [middle + self.uniform(-10.0, 10.0) for middle in _MIDDLES]
        return [middle + side * half for middle in middles for side in (-1.0, 1.0)]


@dataclass(frozen=True)
class Aperture:
    """A pupil's outline on the unit disc.

    Attributes:
        inner: radius of a central obstruction, zero for none.
        offset: by which a second disc is displaced, that vignettes.
        direction: rad, of the displacement.
        other: radius of that disc.
        blades: of the iris; zero for a round one.
    """

    inner: float = 0.0
    offset: float = 0.0
    direction: float = 0.0
    other: float = 1.0
    blades: int = 0

    @classmethod
    def drawn(cls, draw: Draw) -> "Aperture":
        """Draw an outline: half are round and open."""
        kind = draw.uniform()
        angle = draw.uniform(0.0, 2.0 * math.pi)
        if kind < 0.5:
            return cls()
        if kind < 0.62:
            return cls(inner=draw.uniform(0.15, 0.5))
        if kind < 0.85:
            return cls(offset=draw.uniform(0.2, 0.9), direction=angle, other=draw.uniform(0.8, 1.3))
        return cls(direction=angle, blades=int(draw.uniform(5.0, 10.0)))

    def passed(self, x: Tensor, y: Tensor) -> Tensor:
        """Return the share of each cell that light passes, of cells at x and y."""
        step = float((x[0, 1] - x[0, 0]).abs())
        # Signed distances to the edges, positive inside.
        inside = 1.0 - torch.hypot(x, y)
        if self.inner > 0.0:
            inside = torch.minimum(inside, torch.hypot(x, y) - self.inner)
        if self.offset > 0.0:
            dx = x - self.offset * math.cos(self.direction)
            dy = y - self.offset * math.sin(self.direction)
            inside = torch.minimum(inside, self.other - torch.hypot(dx, dy))
        for blade in range(self.blades):
            angle = self.direction + 2.0 * math.pi * blade / self.blades
            apothem = math.cos(math.pi / self.blades)
            along = x * math.cos(angle) + y * math.sin(angle)
            inside = torch.minimum(inside, apothem - along)
        return (inside / step + 0.5).clamp(0.0, 1.0)


@dataclass(frozen=True)
class FormulaOptics:
    """A wavefront given by formulas over the unit disc.

    Attributes:
        f_number: N, the disc's radius is 1/(2N) in direction cosines.
        wavelengths: nm, two of each colour.
        shape: of x and y (G, G), gives the OPD in green, nm.
        colour: of the wavelength (nm), gives W20 besides, nm at the edge.
        aperture: its outline.
        dispersion: relative growth of the shape's OPD from green to a wavelength 100 nm shorter.
    """

    f_number: float
    wavelengths: Sequence[float]
    shape: Callable[[Tensor, Tensor], Tensor]
    colour: Callable[[float], float]
    aperture: Aperture = Aperture()
    dispersion: float = 0.0

    def at(self, samples: int) -> RegularPupil:
        """Return the pupils of all wavelengths."""
        unit = (torch.arange(samples, dtype=torch.float64) + 0.5) * (2.0 / samples) - 1.0
        y, x = torch.meshgrid(unit, unit, indexing="ij")
        passed = self.aperture.passed(x, y)
        waves = torch.tensor(self.wavelengths, dtype=torch.float64)
        colour = torch.tensor([self.colour(wave) for wave in self.wavelengths]).to(waves)
        strength = 1.0 + self.dispersion * (GREEN - waves) / 100.0
        square = x * x + y * y
        opd = strength[:, None, None] * self.shape(x, y) + colour[:, None, None] * square
        opd = MM_PER_NM * opd
        edge = 0.5 / self.f_number
        cosines = (edge * unit).expand(len(waves), 2, -1)
        flux = (passed.sum() * (2.0 * edge / samples) ** 2).expand(len(waves))
        whole = passed.expand_as(opd)
        return RegularPupil(whole, opd, cosines, flux, waves, torch.ones_like(waves))

    def blur(self) -> tuple[float, float, float]:
        """Return the spot radius squared (mm²), mean of the wavelengths, its derivative with
        respect to the focus shift, halved, and the spot radius of a shift by 1 mm.
        """
        variance, along, slope = pupil_rays(self.at(COARSE)).moments()
        return float(variance.mean()), float(along.mean()), math.sqrt(float(slope.mean()))

    def shift_of(self, waves: float) -> float:
        """Return the focus shift (mm) of so many waves of defocus W20 at the edge, in green."""
        edge = 0.5 / self.f_number
        return waves * GREEN * MM_PER_NM / (math.sqrt(1.0 - edge**2) - 1.0)


def longitudinal_colour(draw: Draw) -> Callable[[float], float]:
    """Return W20 (nm) at a wavelength: none, an achromat's parabola, or a singlet's slope."""
    kind = draw.uniform()
    size = GREEN * draw.log_uniform(0.05, 2.0) * draw.sign()
    if kind < 0.35:
        return lambda wave: 0.0
    if kind < 0.75:
        turn = draw.uniform(500.0, 580.0)
        return lambda wave: size * ((wave - turn) / 80.0) ** 2
    return lambda wave: 1.5 * size * (wave - GREEN) / 80.0
