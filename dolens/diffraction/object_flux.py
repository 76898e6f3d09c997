"""The light that object points send into a lens, relative to a point on the axis.

The points belong to a Lambertian plane perpendicular to the axis, so that what a lens passes of
them falls off as cos⁴ of the field angle where nothing clips the light and the entrance pupil does
not change.
"""

import torch
from torch import Tensor

from dolens.diffraction.object_points import ObjectPoints
from dolens.optics.paraxial import matrix_to_stop
from dolens.optics.system import OpticalSystem


def flux_density(points: ObjectPoints, q: Tensor, n: Tensor) -> Tensor:
    """Flux per area of the plane through the first vertex that faces the point.

    A point at distance D = 1/w sends cos θ·dΩ into dΩ = D·d²q/(D² + q²)^(3/2).  Times the square of
    the object plane's distance, which makes it finite for a plane at infinity, this is

        c²·n·(1 + w²q²)^(-3/2) d²q,

    with c the cosine between the line to the first vertex and the axis, and n = cos θ the ray's.

    Args:
        points: N of them.
        q: (N, S, S, 2), mm.
        n: (N, S, S), cosine between the rays before the lens and the axis.

    Returns:
        (N, S, S).
    """
    cosine = torch.rsqrt(1.0 + points.slopes.square().sum(-1))
    w = (cosine * points.vergence)[:, None, None]
    spread = 1.0 + w * w * q.square().sum(-1)
    return cosine.square()[:, None, None] * n * spread.pow(-1.5)


def axial_flux(system: OpticalSystem, points: ObjectPoints, wavelength: Tensor) -> Tensor:
    """Flux of the axial point of each point's object plane through the paraxial entrance pupil.

    π·z²·sin²u in units of `flux_density`, with z the object's distance and u the slope of the
    marginal ray there: tan u = r/(A·z + n·B), r the stop's semi-diameter and [[A, B], [C, D]] the
    paraxial matrix to it.

    Args:
        system: the lens.
        points: N of them.
        wavelength: (N,), nm.

    Returns:
        (N,).
    """
    distinct, which = wavelength.unique(return_inverse=True)
    rows = []
    for w in distinct.tolist():
        (a, b), _ = matrix_to_stop(system, w)
        rows.append(torch.stack((a, b * system.signed_indices(w)[0])))
    a, b = torch.stack(rows)[which].unbind(-1)
    near, r = points.vergence, system.surfaces[system.stop - 1].edge_radius
    return torch.pi * r * r / ((a + near * b).square() + (near * r).square())


def path_before(points: ObjectPoints, q: Tensor) -> Tensor:
    """Return a ray's excess length over the line to the first vertex, to the plane that faces it.

    √(D² + q²) - D = q²·w/(1 + √(1 + w²q²)), mm, with D = 1/w the distance to the vertex.

    Args:
        points: N of them.
        q: (N, S, S, 2), mm.

    Returns:
        (N, S, S), zero for points at infinity: to them the plane is a wavefront.
    """
    cosine = torch.rsqrt(1.0 + points.slopes.square().sum(-1))
    w = (cosine * points.vergence)[:, None, None]
    square = q.square().sum(-1)
    return w * square / (1.0 + torch.sqrt(1.0 + w * w * square))
