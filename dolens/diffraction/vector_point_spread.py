"""Vectorial point spread functions at high aperture, after Richards and Wolf.

Every ray of the pupil sends a plane wave whose electric field is that of polarisation ray tracing,
so that fields of steep rays add up as vectors (Richards and Wolf, Proc. R. Soc. A 253, 358 (1959)).
With the root A of the flux per area in direction cosines α, and a unit vector's field e behind the
lens,

    E(ρ) = n'/λ · ∫ A(α)/√(cos θ) · e(α) · exp(ik·(OPD(α) + n'·(D - R)))·R/D d²α,

since a wave of electric field E carries |E|²·cos θ through the sensor.  |E|² is the density of
electric energy, what a molecule or a thin layer of silver halide absorbs; at low aperture it is the
scalar irradiance.  Each wavelet keeps the field of its ray, also where it meets the image beside
the ray: an error of the order of ρ/R.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.conditions import AtConditions, Conditions
from dolens.diffraction.entrance_beam import ObjectPoints, find_beam
from dolens.diffraction.field_pupil import COARSER
from dolens.diffraction.field_wavefronts import field_wavefronts, object_points, part_of
from dolens.diffraction.huygens import half_width_of, rays_for
from dolens.diffraction.jones_pupils import polarised_pupil
from dolens.diffraction.propagation import wavelets
from dolens.diffraction.wavefront import MM_PER_NM, Wavefront, pupil_wavefront
from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.system import OpticalSystem

# Pairs of ray and image point that are summed at once.
_CHUNK = 2_000_000


@dataclass(frozen=True)
class VectorPointSpread(AtConditions):
    """Vectorial point spread functions of F fields, of all wavelengths together; on the CPU.

    Attributes:
        centre: (F, 2), mm on the sensor, of the windows: the centroids of the light.
        half_width_um: (F,), µm, from the centre to the sides of the window.
        parts: (F, 3, M, M), |E_x|², |E_y|² and |E_z|² in the sensor's axes, at the centres of
            cells, per µm² with the light that apertures pass as unit; rows run along +y and columns
            along +x.  NaN where no light passes.
        scalar: (F, M, M), irradiance of the same rays whose fields are added up as numbers.
        sampling_error: (F,), largest change by a second sum over half of the rays, over the peak.
    """

    centre: Tensor
    half_width_um: Tensor
    parts: Tensor
    scalar: Tensor
    sampling_error: Tensor

    @property
    def irradiance(self) -> Tensor:
        """(F, M, M), |E|², per µm²."""
        return self.parts.sum(1)

    @property
    def scalar_error(self) -> Tensor:
        """(F,), largest difference of the scalar irradiance, over the vectorial peak."""
        difference = (self.scalar - self.irradiance).abs().amax((-2, -1))
        return difference / self.irradiance.amax((-2, -1))


@torch.no_grad()
def vector_point_spread(
    lens: Lens,
    where: Conditions,
    cells: int = 64,
    half_width_um: float | None = None,
    rays: int | None = None,
    light: Sequence[complex] | None = None,
) -> VectorPointSpread:
    """Compute the vectorial point spread function of every field.

    Args:
        lens: the lens.
        where: fields, wavelengths with their weights, and object distance.
        cells: M, along each side of the window.
        half_width_um: µm, of all windows; None: each holds 99 % of its rays and some rings around.
        rays: along each side of a box about each beam; None: as `huygens_point_spread` has it.
        light: E_x and E_y in front of the lens, in the double-pole axes there (see
            `dolens.diffraction.jones_pupils`); None: unpolarised.

    Raises:
        InputError: fewer than two cells, a window without width, too few rays, no light, or a
            coating that is a table of shares.
    """
    if cells < 2 or (half_width_um is not None and not half_width_um > 0.0):
        raise InputError(f"a window needs two cells and a positive width, not {cells}")
    states = _states(light)
    where = where.that_count()
    found = field_wavefronts(lens, where)
    weights = where.weights.to(lens.device)
    system = lens.system().double()
    unknown = torch.full((4, cells, cells), math.nan, dtype=torch.float64)
    rows: list[tuple[float, Tensor, float]] = []
    for number, lit in enumerate(found.lit.any(1).tolist()):
        if not lit:
            rows.append((math.nan, unknown, math.nan))
            continue
        which = number * len(weights) + torch.arange(len(weights), device=lens.device)
        coarse = part_of(found.wavefront, which)
        half = 1e-3 * half_width_um if half_width_um else half_width_of(coarse, weights)
        field = where.fields[number].to(weights).expand(len(weights), 2)
        points = object_points(field, where.object_distance)
        side = rays_for(coarse, half, rays, cells)
        fine, half_as_many = (
            _added(system, points, coarse, weights, count, half, cells, states)
            for count in (side, max(8, round(COARSER * side)))
        )
        peak = fine[:3].sum(0).amax()
        change = (fine[:3] - half_as_many[:3]).sum(0).abs().amax() / peak
        rows.append((1e3 * half, 1e-6 * fine.cpu(), float(change)))
    halves, maps, errors = zip(*rows, strict=True)
    stacked = torch.stack(maps)
    return VectorPointSpread(
        where,
        found.centre,
        torch.tensor(halves, dtype=torch.float64),
        stacked[:, :3],
        stacked[:, 3],
        torch.tensor(errors, dtype=torch.float64),
    )


def _states(light: Sequence[complex] | None) -> Tensor:
    """Return the states (2, K) whose images add up: of unpolarised light two."""
    if light is None:
        return math.sqrt(0.5) * torch.eye(2, dtype=torch.complex128)
    state = torch.as_tensor(light, dtype=torch.complex128).reshape(-1)
    if len(state) != 2 or not bool(state.abs().isfinite().all()) or not float(state.norm()) > 0.0:
        raise InputError(f"light: must be E_x and E_y, not both zero, not {light!r}")
    return (state / state.norm())[:, None]


def _added(
    system: OpticalSystem,
    points: ObjectPoints,
    coarse: Wavefront,
    weights: Tensor,
    side: int,
    half: float,
    cells: int,
    states: Tensor,
) -> Tensor:
    """Return |E_x|², |E_y|², |E_z|² and the scalar irradiance, (4, M, M), 1/mm²."""
    beam = find_beam(system, points, coarse.wavelength)
    given = (coarse.wavelength, coarse.centre, side, 1.0 / coarse.curvature, beam)
    # What a ray loses is in its field.
    front = pupil_wavefront(system.uncoated(), points, *given)
    flux = front.amplitude * front.weight
    pupil = polarised_pupil(system, points, front.wavelength, beam, flux)
    traced, (ahead, _) = pupil.traced, pupil.axes
    entering = (traced.front[..., :2].mT @ ahead).to(states) @ states.to(traced.jones)
    across = traced.jones @ entering
    vectors = (pupil.sensor.mT @ traced.behind[..., :2]).to(states) @ across
    modulus = torch.view_as_real(across).square().sum((-1, -2, -3)).sqrt()
    columns = torch.cat([vectors.flatten(1), modulus[:, None].to(vectors)], 1)
    fields = columns.new_zeros(*flux.shape, columns.shape[1])
    fields[pupil.lit] = columns
    steep = front.direction.square().sum(-1)
    fields[..., :-1] /= (1.0 - steep).clamp(min=1e-9).pow(0.25)[..., None]
    grid = (torch.arange(cells).to(weights) + 0.5) * (2.0 * half / cells) - half
    y, x = torch.meshgrid(grid, grid, indexing="ij")
    found = added_fields(front, fields, x.flatten(), y.flatten())
    energy = torch.view_as_real(found).square().sum(-1)
    parts = energy[..., :-1].unflatten(-1, (3, -1)).sum(-1)
    whole = torch.cat([parts, energy[..., -1:]], -1)
    mixed = torch.einsum("n,nma->am", weights, whole) / (weights @ front.flux)
    return mixed.unflatten(-1, (cells, cells))


def added_fields(wavefront: Wavefront, fields: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Add up wavelets that each carry several numbers, as the components of a field.

    Args:
        wavefront: of N points, with rays enough that neighbours' phases differ by less than half a
            turn.
        fields: (N, S, S, C), complex, of the rays; one of them 1 gives `propagation.direct_field`.
        x: (M,), mm from the centre of the reference sphere.
        y: (M,), mm.

    Returns:
        (N, M, C), complex.
    """
    found = []
    for n, wavelength in enumerate(MM_PER_NM * wavefront.wavelength):
        lit = wavefront.coverage[n] > 0.0
        sphere = (wavefront.curvature[n], wavefront.index[n], wavelength)
        weight = wavefront.weight[n][lit] * (wavefront.index[n] / wavelength)
        rays = (wavefront.direction[n][lit], wavefront.opd[n][lit], weight)
        parts, size = [], max(1, _CHUNK // max(1, len(weight)))
        for points in zip(x.split(size), y.split(size), strict=True):
            parts.append(wavelets(*points, rays, sphere, weight.dtype) @ fields[n][lit])
        found.append(torch.cat(parts))
    return torch.stack(found)
