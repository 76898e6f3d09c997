"""Point spread functions and MTF by Huygens's principle: a sum of wavelets from the exit pupil.

Every ray of the pupil stands for a cell of the reference sphere, and sends a spherical wavelet to
every point of the image, over the exact distance.  Nothing is expanded in small angles, so that the
sum holds at low F-numbers, far out of focus, off the axis, for tilted images, behind mirrors, and
where the edge of the pupil has no simple form.  It takes a hundred times as long as a Fourier
transform.

A wavelet's amplitude is A·dα·dβ, dα·dβ being the cell in direction cosines along the image plane
and A² the flux per area there: by radiometry the flux through a point of the image is the radiance
times the projected solid angle dα·dβ = cos θ·dΩ, which is what Parseval's theorem makes the sum
conserve, on a plane of any tilt.  Cells of equal solid angle, or rays of equal weight, would not.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from dolens.analysis.conditions import Conditions
from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.field_pupil import COARSER, FieldPupil
from dolens.diffraction.field_wavefronts import field_wavefronts, object_points, part_of
from dolens.diffraction.modulation_transfer import (
    DiffractionModulation,
    modulation_of_windows,
)
from dolens.diffraction.point_spread import (
    FieldPointSpread,
    PointSpread,
    airy_radius_um,
    of_all_fields,
)
from dolens.diffraction.propagation import direct_field, turns_across
from dolens.diffraction.wavefront import MM_PER_NM, Wavefront, pupil_wavefront
from dolens.errors import InputError
from dolens.optics.lens import Lens

# Neighbouring wavelets differ by half a turn at most.
_HALF_TURNS = 2.0
# Fewest rays along each side, unless a number is given.
_FEWEST = 128
# Steps of the search for the peak to an Airy radius, and how often it looks three times closer.
_PEAK_STEPS, _PEAK_ROUNDS = 2.5, 4
# Pairs of ray and image point that one field may take: some minutes of one core.
_MOST_PAIRS = 4e9
_REASON = "sum of Huygens's wavelets"


def huygens_irradiance(
    wavefront: Wavefront, x: Tensor, y: Tensor, dtype: torch.dtype = torch.float64
) -> Tensor:
    """Return the irradiance of N wavefronts at points of the image; differentiable in the lens.

    Memory is bounded, in the gradient too.

    Args:
        wavefront: of N points, by `pupil_wavefront`.
        x: (M,), mm from the centre of the reference sphere.
        y: (M,), mm.
        dtype: of the sums; phases are in double precision.

    Returns:
        (N, M), 1/mm², with the flux as `Wavefront.flux` has it as unit of light.
    """
    field = direct_field(wavefront, x, y, dtype)
    return field.real.double().square() + field.imag.double().square()


@torch.no_grad()
def huygens_point_spread(
    lens: Lens,
    where: Conditions,
    cells: int = 64,
    half_width_um: float | None = None,
    rays: int | None = None,
) -> PointSpread:
    """Compute the point spread function of every field by adding up wavelets from the exit pupil.

    The sampling error is estimated by a second sum over half of the rays.

    Args:
        lens: the lens.
        where: fields, wavelengths with their weights, and object distance.
        cells: M, along each side of the window; the irradiance is that at their centres.
        half_width_um: µm, of all windows; None: each holds 99 % of its rays and some rings around.
        rays: along each side of a box about each beam; None: so many that the phases of neighbours
            differ by half a turn at most, 128 or more.

    Raises:
        InputError: fewer than two cells, too few rays for the phases of neighbours to differ by
            less than half a turn, or more than can be added up.
    """
    if cells < 2 or (half_width_um is not None and not half_width_um > 0.0):
        raise InputError(f"a window needs two cells and a positive width, not {cells}")
    if lens.system().diffractive:
        raise InputError("kind huygens: the lens has a diffractive element; allowed: fourier")
    where = where.that_count()
    found = field_wavefronts(lens, where)
    weights = where.weights.to(lens.device)
    rows = []
    for number, lit in enumerate(found.lit.any(1).tolist()):
        if not lit:
            rows.append(FieldPointSpread.dark(cells))
            continue
        which = number * len(weights) + torch.arange(len(weights), device=lens.device)
        front = part_of(found.wavefront, which)
        half = 1e-3 * half_width_um if half_width_um else half_width_of(front, weights)
        field = where.fields[number].to(weights).expand(len(weights), 2)
        points = object_points(field, where.object_distance)
        sums = _Wavelets(lens, points, front, weights, half)
        finer = rays_for(front, half, rays, cells)
        grid = (torch.arange(cells).to(weights) + 0.5) * (2.0 * half / cells) - half
        irradiance, perfect = sums.added(finer, grid, grid)
        coarser = sums.added(max(8, round(COARSER * finer)), grid, grid)[0]
        highest = sums.highest(finer, grid, irradiance)
        error = float((irradiance - coarser).abs().amax() / irradiance.amax())
        held = float(irradiance.sum()) * (2.0 * half / cells) ** 2
        reason = f"{_REASON}, {finer} × {finer} rays"
        strehl = highest / float(perfect)
        window = 1e-6 * irradiance
        rows.append(FieldPointSpread(1e3 * half, window, held, strehl, True, reason, error))
    return of_all_fields(found.where, found.centre, airy_radius_um(lens, where), rows)


@torch.no_grad()
def huygens_window(lens: Lens, where: Conditions) -> tuple[float, float]:
    """Return the half width of the window of one field, and the Airy radius, both in µm.

    Arguments are those of `huygens_point_spread`.  Without light both are those of a perfect lens.
    """
    where = where.that_count()
    found = field_wavefronts(lens, where)
    airy = airy_radius_um(lens, where)
    if not bool(found.lit.any()):
        return airy, airy
    return 1e3 * half_width_of(found.wavefront, where.weights.to(lens.device)), airy


def half_width_of(front: Wavefront, weights: Tensor) -> float:
    """Return the half width (mm) of a window that holds the light of W wavefronts of a field."""
    return FieldPupil(front, weights, None, "").window_half_width


def rays_for(front: Wavefront, half: float, given: int | None, cells: int) -> int:
    """Return the rays along each side of a box about each beam, for a window of one field.

    Args:
        front: of W wavelengths.
        half: half width of the window, mm.
        given: by a user; None: so many that the phases of neighbours differ by half a turn at most.
        cells: along each side of the window.

    Raises:
        InputError: too few are given, or more are needed than can be added up.
    """
    needed = math.ceil(_HALF_TURNS * turns_across(front, half))
    chosen = given or max(_FEWEST, 4 * math.ceil(needed / 4.0))
    if chosen < needed:
        raise InputError(
            f"{chosen} rays along each side are too few for this window: phases of neighbours "
            f"differ by more than half a turn; give {needed} or more, or a smaller window"
        )
    if len(front.wavelength) * chosen**2 * cells**2 > _MOST_PAIRS:
        raise InputError(
            f"{chosen} × {chosen} rays to {cells} × {cells} points are too many to add up; "
            "give fewer cells or a smaller window, or look at the rays alone"
        )
    return chosen


class _Wavelets:
    """The wavelets of one field, W wavelengths, about one point of the image."""

    def __init__(
        self,
        lens: Lens,
        points: ObjectPoints,
        front: Wavefront,
        weights: Tensor,
        half: float,
    ) -> None:
        self.system, self.points, self.front = lens.system(), points, front
        self.weights, self.half = weights, half

    def highest(self, rays: int, grid: Tensor, irradiance: Tensor) -> float:
        """Return the highest irradiance, 1/mm²: on a grid of steps that no peak slips through, and
        then closer and closer about the highest point.
        """
        airy = FieldPupil(self.front, self.weights, None, "").airy_radius
        count = math.ceil(2.0 * self.half * _PEAK_STEPS / airy)
        if count > len(grid):
            grid = (torch.arange(count).to(grid) + 0.5) * (2.0 * self.half / count) - self.half
            irradiance = self.added(round(COARSER * rays), grid, grid)[0]
        row, column = divmod(int(irradiance.argmax()), len(grid))
        x, y, reach = grid[column], grid[row], 2.0 * self.half / len(grid)
        for _ in range(_PEAK_ROUNDS):
            near = torch.linspace(-reach, reach, 7).to(grid)
            found = self.added(rays, x + near, y + near)[0]
            row, column = divmod(int(found.argmax()), 7)
            x, y, reach = x + near[column], y + near[row], reach / 3.0
        return float(found.amax())

    def added(self, rays: int, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return irradiance (Y, X), 1/mm², with the light of the field as unit, and that of the
        same pupil without aberrations at the centre.
        """
        front = pupil_wavefront(
            self.system,
            self.points,
            self.front.wavelength,
            self.front.centre,
            rays,
            1.0 / self.front.curvature,
        )
        total = self.weights @ front.flux
        rows, columns = torch.meshgrid(y, x, indexing="ij")
        # Sums in single precision err by 1e-6.
        values = huygens_irradiance(front, columns.flatten(), rows.flatten(), torch.float32)
        mixed = (self.weights @ values).unflatten(0, (len(y), len(x))) / total
        wave = MM_PER_NM * front.wavelength / front.index
        perfect = (front.weight.sum((-2, -1)) / wave).square()
        return mixed, self.weights @ perfect / total


@torch.no_grad()
def huygens_modulation(
    lens: Lens, where: Conditions, frequencies: Sequence[float] | Tensor
) -> DiffractionModulation:
    """Compute the polychromatic MTF from sums of Huygens's wavelets.

    It needs no Fourier transform of the pupil, and so holds where that does not (see
    `dolens.diffraction.huygens`).  The modulation is that of all light: what falls outside of the
    window, a hundredth or two, is missing at frequencies below one over the window's width, and
    `sampling_error` counts it.

    Args:
        lens: the lens.
        where: fields, wavelengths with their weights, and object distance.
        frequencies: (Q,), cycles/mm.

    Returns:
        The curves; the limits, which need a second pupil, are NaN.

    Raises:
        InputError: as `huygens_point_spread`.
    """
    return modulation_of_windows(
        where,
        frequencies,
        lambda here: huygens_window(lens, here),
        lambda here, cells, half_um: huygens_point_spread(lens, here, cells, half_um),
    )
