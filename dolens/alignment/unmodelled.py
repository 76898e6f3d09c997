"""Effects of a real measurement that the model of a pose fit has not, diffraction among them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.propagation import fourier_field
from dolens.diffraction.pupil_fit import fit_pupil, regular_pupil
from dolens.diffraction.wavefront import MM_PER_NM, Wavefront, pupil_wavefront
from dolens.errors import InputError
from dolens.optics.crystals import Uniaxial
from dolens.optics.gradients import Gradient
from dolens.optics.lens import Lens
from dolens.optics.materials import Medium, is_glass
from dolens.sensor.pixels import Sensor
from dolens.typed_values import call_with_settings


@dataclass(frozen=True)
class Unmodelled:
    """Describes effects of a real measurement that a pose fit does not model; all are absent by
    default.

    Attributes:
        radius: tolerance of every surface's radius of curvature, relative; the error is uniform
            within ± this share.
        index: tolerance of every glass's refractive index; the error is uniform within ± this
            number, and the same at all wavelengths.
        source_diameter: of a disc that radiates evenly, normal to the z axis and about the place of
            the source, mm; 0: a point.
        background: mean of the light besides the source's, photo-electrons a pixel, with its shot
            noise.
        diffraction: photons land as the irradiance of wave optics has it, not as rays do.

    Raises:
        InputError: a number out of range.
    """

    radius: float = 0.0
    index: float = 0.0
    source_diameter: float = 0.0
    background: float = 0.0
    diffraction: bool = False

    def __post_init__(self) -> None:
        for name, high in (("radius", 0.5), ("index", 0.2)):
            if not 0.0 <= getattr(self, name) <= high:
                raise InputError(
                    f"unmodelled.{name}: {getattr(self, name)}; allowed: from 0 to {high:g}"
                )
        for name in ("source_diameter", "background"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise InputError(f"unmodelled.{name}: {getattr(self, name)}; allowed: 0 or more")
        if not isinstance(self.diffraction, bool):
            raise InputError(
                f"unmodelled.diffraction: {self.diffraction!r}; allowed: true or false"
            )

    @property
    def of_the_lens(self) -> bool:
        """Return whether the lens differs from its design."""
        return self.radius > 0.0 or self.index > 0.0

    def made(self, lens: Lens, generator: torch.Generator) -> Lens:
        """Return a copy of a lens with radii and indices as they might be made.

        A radius R becomes R·(1 + ε), a plane stays plane; the index n of a glass becomes n + δ.
        Surfaces that have the same glass have the same error of its index.  The generator gives
        one number for each surface and one for each glass, whatever the tolerances are, so that
        equal states of it give errors in proportion to the tolerances.

        Args:
            lens: as designed; it stays as it is.
            generator: on the CPU.
        """
        found = lens.storing_its_values()
        glasses = [m for m in dict.fromkeys(lens.materials) if is_glass(m)]
        count = len(found.surfaces) + len(glasses)
        shares = 2.0 * torch.rand(count, generator=generator, dtype=torch.float64) - 1.0
        own, melts = shares[: len(found.surfaces)], shares[len(found.surfaces) :]
        with torch.no_grad():
            for surface, share in zip(found.surfaces.values(), own.tolist(), strict=True):
                curvature = getattr(surface, "curvature", None)
                if curvature is not None:
                    curvature.div_(1.0 + self.radius * share)
        shifted = {
            glass: shifted_medium(glass, self.index * share)
            for glass, share in zip(glasses, melts.tolist(), strict=True)
        }
        media: list[Any] = [shifted.get(medium, medium) for medium in lens.materials]
        found.materials = tuple(media)
        return found


def shifted_medium(medium: Medium, shift: float) -> Any:
    """Return a medium whose index is larger by a number, of a crystal both indices, of a gradient
    everywhere.
    """
    if isinstance(medium, Uniaxial):
        return medium.of(lambda own: ShiftedMedium(own, shift))
    if isinstance(medium, Gradient):
        return replace(medium, base=ShiftedMedium(medium.base, shift))
    return ShiftedMedium(medium, shift)


@dataclass(frozen=True)
class ShiftedMedium:
    """Shifts the index of a medium by the same number at every wavelength."""

    medium: Medium
    shift: float

    @property
    def name(self) -> str:
        """Return the medium's name, and by how much it is off."""
        return f"{self.medium.name}{self.shift:+g}"

    def index(self, wavelength: float | Tensor) -> float | Tensor:
        """Return the refractive index at a wavelength in nm."""
        return self.medium.index(wavelength) + self.shift


def unmodelled_of(settings: Mapping[str, Any] | None, key: str = "unmodelled") -> Unmodelled:
    """Return the effects that a configuration describes; none of them where there are no settings.

    Args:
        settings: of `Unmodelled`.
        key: of the configuration that an error names.

    Raises:
        InputError: an unknown key, or a number out of range.
    """
    return call_with_settings(Unmodelled, settings or {}, key)


_RAYS, _DEGREE = 48, 16
# Light that diffraction spreads farther beyond the ray intercepts is lost: widths of the
# fringes at an edge, and pixels.
_FRINGES, _PIXELS = 8.0, 2.0
# Copies of the image meet the window at 1.
_OVERSAMPLING = 1.15
# Samples across a pupil: so that its edge is where it belongs, and what memory is meant for.
_FEWEST, _MOST = 256, 3000
# By how much the source moves, over its distance, to find the image's movement.
_STEP = 1e-4


@dataclass(frozen=True)
class DiffractedLight:
    """Holds the light of a point source on a fine grid of the sensor.

    Attributes:
        shares: (Y, X), of the light behind the lens, in each cell of the grid.
        x: (X,), mm, middles of the cells' columns.
        y: (Y,), mm, of the rows.
        movement: (2, 2), ∂(x, y)/∂(source x, source y) of the image's centroid.
    """

    shares: Tensor
    x: Tensor
    y: Tensor
    movement: Tensor

    def photons(
        self, count: int, source_diameter: float, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Return the places of detected photons, x and y in mm.

        Their number is that of a Poisson process, evenly spread within a cell.  A source of finite
        size is a disc of points whose images differ in their places only.

        Args:
            count: mean of the photons behind the lens, those beyond the grid included.
            source_diameter: mm.
            generator: on the CPU.
        """
        counts = torch.poisson(count * self.shares, generator).long().flatten()
        cells = torch.repeat_interleave(torch.arange(len(counts)), counts)
        columns = len(self.x)
        points = torch.stack([self.x[cells % columns], self.y[cells // columns]])
        step = torch.stack([self.x[1] - self.x[0], self.y[1] - self.y[0]])
        jitter = torch.rand(points.shape, generator=generator, dtype=torch.float64) - 0.5
        points = points + step[:, None] * jitter
        if source_diameter > 0.0:
            u, v = torch.rand(points.shape, generator=generator, dtype=torch.float64)
            points = points + self.movement @ on_disc(u, v, 0.5 * source_diameter)
        return points[0], points[1]


def on_disc(u: Tensor, v: Tensor, radius: float) -> Tensor:
    """Return points (2, N) of even density on a disc, from even numbers (N,) between 0 and 1."""
    rho, angle = radius * u.sqrt(), 2.0 * torch.pi * v
    return torch.stack([rho * angle.cos(), rho * angle.sin()])


@torch.no_grad()
def diffracted_light(
    lens: Lens, source: Tensor, wavelength: float, sensor: Sensor, source_diameter: float = 0.0
) -> DiffractedLight:
    """Return the irradiance of a point source by the angular spectrum of the light behind the lens.

    With the root A of the flux per area in direction cosines α of the rays, and their optical path
    to the sensor's axes,

        U(ρ) = 1/λ · ∫ A(α)·exp(ik·(OPD(α) + α·ρ)) d²α,

    which is a Fourier transform without approximation in ρ (Goodman, Introduction to Fourier
    Optics, 3.10): the reference sphere is a plane far away.  Its rays (stationary phase) land where
    geometrical optics has them.  The pupil's edge is sharp in direction, as that of a stop in the
    front focal plane is.  For a stop at the distance R from the focus, seen at δ from it, fringes
    at the rim are wider in truth, or narrower, by the factor √(R/(R + δ)) at most: 3 % for Section
    VI's bench, whose image differs by 1.3 % of its light from that about the exit pupil.

    Args:
        lens: as it stands.
        source: (3,), mm, in front of the lens.
        wavelength: nm.
        sensor: the pixels; light beyond them is not followed.
        source_diameter: mm; light beyond the pixels is followed as far as a source of this size
            brings it back.

    Raises:
        InputError: the light is spread so far that the transform needs more than 3000 samples
            across the pupil, or none reaches the sensor.
    """
    moved = _STEP * float(source[2].abs())
    points = source.double() + moved * torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    system = lens.system()
    beams = pupil_wavefront(system, ObjectPoints.at(points), wavelength, None, _RAYS, math.inf)
    middles = beams.centre + _mean_intercept(beams)
    movement = ((middles[1:] - middles[0]) / moved).mT
    front = pupil_wavefront(
        system, ObjectPoints.at(points[:1]), wavelength, beams.centre[:1], _RAYS, math.inf
    )
    fit = fit_pupil(front, _DEGREE)
    wave = MM_PER_NM * float(front.wavelength) / float(front.index)
    width = (fit.high - fit.low)[0]
    intercepts = front.intercept[0][front.coverage[0] > 0.0]
    if not len(intercepts):
        raise InputError("unmodelled.diffraction: no light from the source reaches the sensor")
    low, high = intercepts.amin(0), intercepts.amax(0)
    # An edge's first fringe is as wide as √(λ·d), d the way to the focus: the spot over its cone;
    # in the focus as λ over the cone.
    fringe = torch.maximum((wave * (high - low) / width).sqrt(), wave / width).amax()
    reach = _FRINGES * fringe + _PIXELS * sensor.pixel_pitch
    margin = 0.5 * source_diameter * float(torch.linalg.matrix_norm(movement, 2))
    first, last = _on_sensor(sensor, low - reach, high + reach, front.centre[0], margin)
    period = _OVERSAMPLING * torch.maximum(last - low + reach, high + reach - first)
    samples = max(_FEWEST, 4 * math.ceil(float((period * width).amax()) / wave / 4.0))
    if samples > _MOST:
        raise InputError(
            f"unmodelled.diffraction: light is spread over {float((high - low).amax()):.2g} mm, "
            f"which needs {samples} samples across the pupil, more than {_MOST}; leave diffraction "
            "out of this fit"
        )
    step = sensor.pixel_pitch / math.ceil(float(width.amax()) / wave * sensor.pixel_pitch + 2.0)
    pupil = regular_pupil(fit, samples)
    x, y = (
        first[axis] + step * (0.5 + torch.arange(max(2, int((last - first)[axis] / step))))
        for axis in (0, 1)
    )
    field = fourier_field(pupil, x, y, torch.float32)[0]
    shares = step**2 * field.abs().double().square() / pupil.flux
    return DiffractedLight(
        shares, x + front.centre[0, 0], y + front.centre[0, 1], movement.contiguous()
    )


def _mean_intercept(front: Wavefront) -> Tensor:
    """Return the mean ray intercept (N, 2), mm from the spheres' centres."""
    flux = (front.amplitude * front.weight)[..., None]
    return (flux * front.intercept).sum((1, 2)) / flux.sum((1, 2)).clamp(min=1e-300)


def _on_sensor(
    sensor: Sensor, low: Tensor, high: Tensor, centre: Tensor, margin: float
) -> tuple[Tensor, Tensor]:
    """Return the part of a box (mm from a centre) that lies on the sensor, or a margin beyond
    it.
    """
    corners = torch.tensor([[-0.5, -0.5], [sensor.height - 0.5, sensor.width - 0.5]])
    ends = torch.stack(sensor.positions(*corners.double().unbind(-1)), -1) - centre
    first = torch.maximum(low, ends.amin(0) - margin)
    last = torch.minimum(high, ends.amax(0) + margin)
    if not bool((first < last).all()):
        raise InputError("unmodelled.diffraction: no light from the source reaches the sensor")
    return first, last
