"""Parabasal rays run infinitely close to a chief ray.

Their intercepts and slopes are linear in where they enter the lens, with the derivatives of the
exact trace as coefficients.  They tell where a thin pencil about the chief ray has its two foci,
which Coddington's equations give for surfaces whose principal curvatures are known (Welford,
Aberrations of Optical Systems, section 9.2); these derivatives take any surface and any pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dolens.analysis.ray_intercepts import in_double_precision
from dolens.optics.fields import require_from_the_front
from dolens.optics.launching import field_line, launch
from dolens.optics.lens import Lens
from dolens.optics.paraxial import vergence
from dolens.optics.rays import Rays, Status


@dataclass(frozen=True)
class ParabasalRays:
    """Chief rays of F fields and W wavelengths, and the pencils about them; float64 on the CPU.

    Numbers are NaN where the chief ray does not reach the sensor.

    Attributes:
        position: (F, W, 2), mm, of the chief rays on the sensor.
        slope: (F, W, 2), dx/dz and dy/dz behind the last surface.
        position_rate: (F, W, 2, 2), ∂position/∂q, with q (mm) across the beam in the plane
            through the first vertex that faces the field (see `dolens.optics.launching`).  Of a
            curved sensor on the plane z = const. through the chief ray's point.
        slope_rate: (F, W, 2, 2), ∂slope/∂q, 1/mm.
        image_rate: (F, W, 2, 2), mm, ∂position/∂(tan x, tan y) for an object at infinity, else
            ∂position/∂(object height), without unit: how the chief ray moves with the field.
    """

    position: Tensor
    slope: Tensor
    position_rate: Tensor
    slope_rate: Tensor
    image_rate: Tensor


def parabasal_rays(
    lens: Lens,
    fields: Sequence[Sequence[float]] | Tensor,
    wavelengths: Sequence[float] | Tensor,
    object_distance: float | None = None,
) -> ParabasalRays:
    """Trace the chief rays of fields, and the rays infinitely close to them.

    Apertures clip nothing here: a chief ray counts wherever it reaches the sensor.

    Args:
        lens: the lens.
        fields: (F, 2), degrees or mm, as `Lens.aim` takes them.
        wavelengths: (W,), nm; each has its own chief ray.
        object_distance: mm in front of the first vertex; None for an object at infinity.
    """
    lens = in_double_precision(lens)
    options: dict[str, Any] = {"dtype": torch.float64, "device": lens.device}
    field = torch.as_tensor(fields, **options).reshape(-1, 2)
    waves = torch.as_tensor(wavelengths, **options).reshape(-1)
    near = vergence(object_distance)
    if near == 0.0:
        require_from_the_front(field, "a map of chief rays against the tangent of the field")
    with torch.enable_grad():
        # The coordinate in which an ideal lens's image is linear.
        linear = torch.deg2rad(field).tan() if near == 0.0 else field
        linear = linear[:, None].expand(-1, len(waves), 2).clone().requires_grad_()
        given = torch.rad2deg(linear.atan()) if near == 0.0 else linear
        aimed = lens.aim(given, (0.0, 0.0), waves, object_distance)
        chief = lens.trace(aimed)
        reached = aimed.converged & _arrives(chief.status)
        image_rate = _rates(chief.position[..., :2], linear)

        q = aimed.crossing.clone().requires_grad_()
        angles = torch.deg2rad(field) if near == 0.0 else field
        line, _ = field_line(angles, object_distance)
        ray = launch(line[:, None], near, q)
        hit = lens.trace(Rays.from_components(ray, waves))
        reached = reached & _arrives(hit.status)
        position = hit.position[..., :2]
        slope = hit.direction[..., :2] / hit.direction[..., 2:]
        if lens.sensor_curvature is not None:
            # On the plane through the chief ray's point, where the sag does not move.
            z = hit.position[..., 2:]
            position = position - slope * (z - z.detach())
        rates = _rates(position, q), _rates(slope, q)

    def found(values: Tensor) -> Tensor:
        there = reached.reshape(*reached.shape, *(1,) * (values.ndim - 2))
        return values.detach().where(there, torch.nan).cpu()

    return ParabasalRays(*map(found, (position, slope, *rates, image_rate)))


def _arrives(status: Tensor) -> Tensor:
    return (status == Status.OK) | (status == Status.VIGNETTED)


def _rates(values: Tensor, inputs: Tensor) -> Tensor:
    """Return ∂values/∂inputs (..., 2, 2) of values (..., 2), each of its own inputs (..., 2)."""
    rows = []
    for axis in range(2):
        (row,) = torch.autograd.grad(
            values[..., axis].sum(), inputs, retain_graph=True, allow_unused=True
        )
        rows.append(torch.zeros_like(inputs) if row is None else row)
    return torch.stack(rows, -2)
