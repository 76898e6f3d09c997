"""Random pupils: given by formulas, or traced through the packaged lenses."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.pupil_fit import PupilFit, RegularPupil, fit_pupil, regular_pupil
from dolens.diffraction.reference_sphere import chief_ray_intercepts
from dolens.diffraction.wavefront import MM_PER_NM, pupil_wavefront
from dolens.errors import InputError
from dolens.experiments.pretraining.pixel_functions import pupil_rays
from dolens.files import packaged_configuration
from dolens.optics.lens import Lens
from dolens.prescriptions.files import load_lens
from dolens.tolerancing.tolerances import tolerances_from, usual_tolerances, with_glass_elements

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


# The restorer is judged by these lenses, so that none of its training functions come from them.
HELD_OUT = (
    # A triplet, and three more of nearly its curvatures.
    "cooke_triplet",
    "published/cooke_triplet_oslo",
    "published/cooke_triplet_sasian",
    "published/uv_triplet_jps42_9417",
    "double_gauss",
    "large_fov_doublet",
    "large_fov_doublet_designed",
    # Singlets.
    "la1131",
    "la1509",
    "lb1757",
    # Lenses of telephones.
    "phone",
    "phone_insensitive",
    "published/mobile_us7535658_odd",
    # Telephoto lenses.
    "published/doe_telephoto_jp2015102852_ex1",
    "published/doe_telephoto_jp2020173349_ex1",
    "published/internal_focus_jp2008145584_ex1",
    "published/internal_focus_jph04294310_ex1",
    "published/mangin_reflex_us3507556_e1",
    "published/mangin_reflex_us4666259_ex1",
    "published/mangin_reflex_us4951078_t1",
    "published/telephoto_laikin_p91",
    "published/telephoto_smith_p175_sigler",
    "published/telephoto_us3942876_ex4",
    "published/telephoto_us4154508_ex2",
    # A Tessar, to be read as another program's file.
    "published/tessar_us2573511_ex1",
    # The default experiment's own plate.
    "wavefront_coding",
)
# These make no image of a point in all colours.
_NO_CAMERAS = (
    "published/axicon_ring_focus",
    "published/cylinder_thorlabs_lj1567",
    "published/spectrometer_czerny_turner",
    "published/spectrometer_dyson_montero_orille",
    "published/spectrometer_prism",
    "published/spectrometer_toroidal_grating",
)
# The share of a lens's flux that its fit may miss.
_FLUX = 0.03
# mm, stands for the focal length of a lens without power.
_NO_LENGTH = 100.0


class TracedField(NamedTuple):
    """Pupils of a lens's field.

    Attributes:
        fit: of two wavelengths for each of red, green and blue.
        focal_length: mm.
        name: of the lens.
    """

    fit: PupilFit
    focal_length: float
    name: str


class Prescriptions:
    """The packaged prescriptions, less those that are held out; each is read when it is drawn."""

    def __init__(self) -> None:
        folder = packaged_configuration() / "lens"
        files = sorted([*folder.glob("*.yaml"), *folder.glob("published/*.yaml")])
        named = {file.relative_to(folder).with_suffix("").as_posix(): file for file in files}
        self.files: dict[str, Path] = {
            name: file for name, file in named.items() if name not in HELD_OUT + _NO_CAMERAS
        }
        self.kept: dict[str, Lens] = {}
        self.again: TracedField | None = None

    @torch.no_grad()
    def traced(self, draw: Draw) -> TracedField | None:
        """Draw a field; None where the lens drawn has no light or no smooth wavefront there.

        Tracing takes the most time, and so a field is drawn twice on average.
        """
        found, self.again = self.again or self._trace(draw), None
        if found is not None and draw.chance(0.5):
            self.again = found
        return found

    def _trace(self, draw: Draw) -> TracedField | None:
        name = draw.one_of(list(self.files))
        if name not in self.kept:
            self.kept[name] = load_lens(self.files[name], dtype=torch.float64)
        lens, what = self.kept[name], f"lens {name}"
        field = random_field(lens, draw)
        if draw.chance(0.5):
            what += ", within tolerances"
            lens = within_tolerances(lens, draw, draw.log_uniform(0.5, 4.0))
        lateral_colour, waves = draw.chance(0.3), draw.bands()
        try:
            fit = fitted_pupils(lens, field, waves, lateral_colour)
            length = abs(float(lens.first_order(GREEN).efl))
        except InputError:
            return None
        if fit is None:
            return None
        return TracedField(fit, length if 0.0 < length < math.inf else _NO_LENGTH, what)


def random_field(lens: Lens, draw: Draw) -> tuple[float, float]:
    """Return a field (degrees or mm) within a lens's, evenly drawn from the field's area."""
    points = lens.fields.points if lens.fields else ((0.0, 0.0),)
    farthest = max(math.hypot(*point) for point in points)
    if lens.system().rotationally_symmetric:
        radius, angle = farthest * math.sqrt(draw.uniform()), draw.uniform(0.0, 2.0 * math.pi)
        return radius * math.cos(angle), radius * math.sin(angle)
    shares = [-math.log(max(draw.uniform(), 1e-12)) for _ in points]
    x, y = (sum(s * p[axis] for s, p in zip(shares, points, strict=True)) for axis in (0, 1))
    return x / sum(shares), y / sum(shares)


def within_tolerances(lens: Lens, draw: Draw, factor: float) -> Lens:
    """Return a copy of a lens with random errors within so many times the usual tolerances."""
    made = with_glass_elements(lens)
    settings = usual_tolerances(made)
    if not settings:
        return lens
    tolerances = tolerances_from(made, settings, factor)
    errors = tolerances.draw(1, draw.generator)[0]
    parameters = dict(made.named_parameters())
    for name, error in zip(tolerances.names, errors, strict=True):
        parameters[name].data.add_(error)
    return made


def fitted_pupils(
    lens: Lens, field: tuple[float, float], waves: Sequence[float], lateral_colour: bool
) -> PupilFit | None:
    """Return pupils about each colour's chief ray, or about green's; None without a fit."""
    system, distance = lens.system(), lens.object_distance
    if distance is None or distance == math.inf:
        points = ObjectPoints.at_infinity([field] * len(waves))
    else:
        points = ObjectPoints.at([(*field, -distance)] * len(waves))
    wavelengths = torch.tensor(waves, dtype=torch.float64)
    middles = wavelengths.unflatten(0, (3, -1)).mean(1)
    if lateral_colour:
        middles = middles[1].expand(3)
    centres = chief_ray_intercepts(system.double(), points, middles.repeat_interleave(2))
    front = pupil_wavefront(system, points, wavelengths, centres, 28)
    # Where rays that miss a surface make the edge, no aperture describes it.
    if bool(front.ended.any()) or not bool((front.flux > 1e-4).all()):
        return None
    fit = fit_pupil(front, 12)
    error = regular_pupil(fit, 2 * COARSE).flux / front.flux - 1.0
    return fit if bool((error.abs() <= _FLUX).all()) else None
