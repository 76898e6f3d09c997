"""From the wavefront to the sensor: Fourier transform where it holds, direct integration where not.

With the root A of the flux per area in direction cosines α, the field at ρ from the centre of the
reference sphere is

    U(ρ) = n'/λ · ∫ A(α)·exp(ik·(OPD(α) + n'·(D - R)))·R/D d²α,    k = 2π/λ,

D being the distance from the sphere's point to that of the sensor (Huygens and Fresnel; Born and
Wolf, section 8.2).  |U|² is the flux per area of the sensor.  Where D - R = α·ρ to within a small
part of a wavelength this is a Fourier transform, whose total flux is the pupil's (Parseval).
"""

from typing import Any

import torch
from torch import Tensor

from dolens.diffraction.pupil_fit import RegularPupil
from dolens.diffraction.reference_sphere import path_beyond
from dolens.diffraction.wavefront import MM_PER_NM, Wavefront
from dolens.errors import InputError
from dolens.optics.replay import replay

# Pairs of ray and sensor point at a time in direct integration: some 100 bytes each.
_CHUNK = 1 << 16


def fourier_field(
    pupil: RegularPupil, x: Tensor, y: Tensor, dtype: torch.dtype = torch.float64
) -> Tensor:
    """The field on a regular grid of the sensor, by the matrix Fourier transform.

    U = E_y·P·E_xᵀ with E = exp(ik·n'·ρ·α), for any grids of pupil and sensor (Soummer, Pueyo,
    Sivaramakrishnan and Vanderbei, Opt. Express 15, 15935, 2007).

    Args:
        pupil: of N points.
        x: (X,), mm from the centre of the reference sphere.
        y: (Y,), mm.
        dtype: of the sums.  Phases are formed in double precision and reduced to one turn.

    Returns:
        (N, Y, X), complex; |U|² is flux per mm².  A phase common to all of the pupil and one that
        is linear in ρ are left out.
    """
    wavelength = MM_PER_NM * pupil.wavelength
    centred = pupil.cosines - pupil.cosines.mean(-1, keepdim=True)
    cell = (pupil.cosines[..., 1] - pupil.cosines[..., 0]).prod(-1)
    cycles = (pupil.index / wavelength)[:, None, None] * centred
    along_x, along_y = (
        _phasor(rho[:, None].to(cycles) * cycles[:, axis, None], dtype)
        for axis, rho in enumerate((x, y))
    )
    scale = (cell * pupil.index / wavelength)[:, None, None]
    function = _phasor(pupil.opd / wavelength[:, None, None], dtype, scale * pupil.amplitude)
    if x.numel() < y.numel():
        return along_y @ (function @ along_x.mT)
    return (along_y @ function) @ along_x.mT


def direct_field(
    wavefront: Wavefront, x: Tensor, y: Tensor, dtype: torch.dtype = torch.float64
) -> Tensor:
    """The field at points of the sensor, by adding up all rays with their exact distances.

    Args:
        wavefront: of N points, with rays enough that neighbours' phases differ by less than half
            a turn (see `direct_samples`).
        x: (M,), mm from the centre of the reference sphere.
        y: (M,), mm.
        dtype: of the sums; phases are in double precision.

    Returns:
        (N, M), complex; |U|² is flux per mm².  A phase common to all rays is left out.
        Memory is bounded, in the gradient too: pieces of the sum are computed again there.
    """
    if x.shape != y.shape or x.ndim != 1:
        raise InputError(f"points are x and y (M,), not {tuple(x.shape)} and {tuple(y.shape)}")
    options: dict[str, Any] = {"dtype": wavefront.opd.dtype, "device": wavefront.opd.device}
    x, y = x.to(**options), y.to(**options)
    fields = [_added(wavefront, n, x, y, dtype) for n in range(len(wavefront.wavelength))]
    return torch.stack(fields)


def _added(wavefront: Wavefront, n: int, x: Tensor, y: Tensor, dtype: torch.dtype) -> Tensor:
    """(M,), complex, of one of the points."""
    lit = wavefront.coverage[n] > 0.0
    wavelength = MM_PER_NM * wavefront.wavelength[n]
    sphere = (wavefront.curvature[n], wavefront.index[n], wavelength)
    weight = wavefront.weight[n][lit] * (wavefront.index[n] / wavelength)
    tensors = (wavefront.direction[n][lit], wavefront.opd[n][lit], weight)
    size = max(1, _CHUNK // max(1, len(weight)))
    parts = list(zip(x.split(size), y.split(size), strict=True))

    def piece(i: int, *rays: Tensor) -> Tensor:
        return _summed(*parts[i], rays, sphere, dtype)

    return replay(piece, [len(part) for part, _ in parts], tensors)


def _summed(
    x: Tensor,
    y: Tensor,
    rays: tuple[Tensor, ...],
    sphere: tuple[Tensor, ...],
    dtype: torch.dtype,
) -> Tensor:
    """Σ over rays (R,) at points (M,), complex."""
    direction, opd, weight = rays
    curvature, index, wavelength = sphere
    along = torch.stack((x, y), -1) @ direction.mT
    beyond, ratio = path_beyond(along, (x * x + y * y)[:, None], curvature)
    turns = (opd + index * beyond) / wavelength
    return _phasor(turns, dtype, weight / ratio).sum(-1)


def _phasor(turns: Tensor, dtype: torch.dtype, modulus: Tensor | None = None) -> Tensor:
    """modulus·exp(2πi·turns), the phase reduced to one turn before its precision is."""
    phase = (2.0 * torch.pi) * (turns - turns.detach().round()).to(dtype)
    modulus = torch.ones_like(phase) if modulus is None else modulus.to(dtype)
    return torch.polar(modulus, phase)
