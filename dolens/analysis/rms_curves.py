"""RMS spot radii are computed against field and against wavelength."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.spot_diagram import spot_diagram
from dolens.errors import InputError
from dolens.optics.lens import Lens


@dataclass(frozen=True)
class RMSCurves:
    """An `RMSCurves` holds RMS spot radii of F fields and W wavelengths; NaN where no light passes.

    Attributes:
        fields: (F, 2), degrees or mm.
        field_unit: `°` for an object at infinity, else `mm`.
        wavelengths: (W,), nm.
        rms: (F, W), mm, about each spot's own centroid.
        polychromatic: (F,), mm, of all wavelengths together about their common centroid.
        airy_radius: (W,), mm.
    """

    fields: Tensor
    field_unit: str
    wavelengths: Tensor
    rms: Tensor
    polychromatic: Tensor
    airy_radius: Tensor


def rms_against_field(
    lens: Lens,
    wavelengths: Sequence[float] | Tensor,
    field: Sequence[float] | Tensor | None = None,
    count: int = 15,
    rays: int = 4000,
    object_distance: float | None = None,
    wavelength_weights: Sequence[float] | None = None,
) -> RMSCurves:
    """Compute RMS spot radii at evenly spaced fields from the axis to an edge.

    Args:
        lens: the lens.
        wavelengths: (W,), nm.
        field: the edge, (x, y) in degrees or mm; None for the largest of the lens's own fields.
        count: fields, with the axis and the edge.
        rays: of each spot, a multiple of four, before apertures clip any.
        object_distance: mm in front of the first vertex; None for an object at infinity.
        wavelength_weights: (W,), of the polychromatic spot, of any sum; None: see
            `spectral_shares`.

    Raises:
        InputError: no field is given and the lens has none of that kind, or fewer than two are
            asked for.
    """
    if count < 2:
        raise InputError(f"count must be at least 2 fields, not {count}")
    edge = torch.tensor(_largest(lens, object_distance) if field is None else tuple(field))
    fields = torch.linspace(0.0, 1.0, count, dtype=torch.float64)[:, None] * edge.double()
    return _curves(lens, fields, wavelengths, rays, object_distance, wavelength_weights)


def rms_against_wavelength(
    lens: Lens,
    fields: Sequence[Sequence[float]] | Tensor,
    interval: tuple[float, float] | None = None,
    count: int = 15,
    rays: int = 4000,
    object_distance: float | None = None,
) -> RMSCurves:
    """Compute RMS spot radii at evenly spaced wavelengths.

    Args:
        lens: the lens.
        fields: (F, 2), degrees or mm, as `Lens.aim` takes them.
        interval: shortest and longest wavelength, nm; None for those of the lens.
        count: wavelengths, with both ends.
        rays: of each spot, a multiple of four, before apertures clip any.
        object_distance: mm in front of the first vertex; None for an object at infinity.

    Raises:
        InputError: no interval is given and the lens has no wavelengths, or fewer than two are
            asked for.
    """
    if count < 2:
        raise InputError(f"count must be at least 2 wavelengths, not {count}")
    if interval is None:
        if not lens.wavelengths:
            raise InputError(f"lens '{lens.name}' names no wavelengths: give an interval")
        interval = min(lens.wavelengths), max(lens.wavelengths)
    wavelengths = torch.linspace(*interval, count, dtype=torch.float64)
    return _curves(lens, fields, wavelengths, rays, object_distance, None)


def _curves(
    lens: Lens,
    fields: Sequence[Sequence[float]] | Tensor,
    wavelengths: Sequence[float] | Tensor,
    rays: int,
    object_distance: float | None,
    wavelength_weights: Sequence[float] | None,
) -> RMSCurves:
    spots = spot_diagram(lens, fields, wavelengths, rays, object_distance, wavelength_weights)
    return RMSCurves(
        spots.fields,
        spots.field_unit,
        spots.wavelengths,
        spots.rms,
        spots.polychromatic_rms,
        spots.airy_radius,
    )


def _largest(lens: Lens, object_distance: float | None) -> tuple[float, float]:
    kind = "angles" if object_distance is None else "heights"
    if lens.fields is None or lens.fields.kind != kind:
        raise InputError(f"lens '{lens.name}' has no fields that are {kind}: give the field's edge")
    return max(lens.fields.points, key=lambda point: point[0] ** 2 + point[1] ** 2)
