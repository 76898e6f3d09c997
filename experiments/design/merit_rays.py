"""Spots, contrast and RMS curves are computed over the very rays of `rms_spot_um`.

A figure beside a headline number shows that number's rays.  A grid of rays is shown as it is.  Where
the number is a Gaussian quadrature of the whole stop, a figure shows more rays of the same pupil,
and its RMS radii are those of the quadrature.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from dolens.analysis.modulation_transfer import Modulation, modulation, modulation_transfer
from dolens.analysis.ray_intercepts import field_unit
from dolens.analysis.rms_curves import RMSCurves
from dolens.analysis.spot_diagram import (
    AIRY,
    SpotDiagram,
    moments,
    spot_diagram,
    working_f_numbers,
)
from dolens.errors import InputError
from dolens.experiments.design.tables import SQUARE_GRID_COUNT, spot_table
from dolens.optics.lens import Lens
from dolens.optics.paraxial import first_order
from dolens.optimize import MeritSettings
from dolens.optimize.image_quality import ImageQuality, QualityValues

_CURVE_POINTS = 15
# Rays along each side of a grid for transfer functions.
_DENSE_GRID = 121
# A quadrature of the whole stop that holds for large aberrations too.
_WHOLE_STOP = {"rings": 20, "arms": 24}


def is_grid(settings: MeritSettings) -> bool:
    """Return whether the rays are a grid, which need not fill the stop."""
    return settings.sampling == "square_grid"


def pupil_text(settings: MeritSettings) -> str:
    """Return the pupil of `rms_spot_um`, as `±15 mm` or `the whole stop`."""
    half_width = settings.sampling_options.get("half_width") if is_grid(settings) else None
    return "the whole stop" if half_width is None else f"a square of ±{half_width:g} mm"


def rays_text(settings: MeritSettings) -> str:
    """Return which rays `rms_spot_um` is of, as `31×31 rays over ±15 mm`."""
    if not is_grid(settings):
        return "rays over the whole stop"
    options = settings.sampling_options
    count = options.get("count") or SQUARE_GRID_COUNT
    half_width = options.get("half_width")
    width = "the first surface" if half_width is None else f"±{half_width:g} mm"
    return f"{count}×{count} rays over {width}"


def reference_text(settings: MeritSettings) -> str:
    """Return what radii count from, where that is not each spot's own centroid; else nothing."""
    point = "chief ray" if settings.reference == "chief" else "centroid"
    if settings.reference_spectrum == "polychromatic":
        return f"about one {point} for all wavelengths"
    return "about the chief rays" if settings.reference == "chief" else ""


def pupil_share(lens: Lens, settings: MeritSettings) -> float:
    """Return how far the grid reaches over the entrance pupil's semi-diameter; 1 for all of it."""
    half_width = settings.sampling_options.get("half_width") if is_grid(settings) else None
    if half_width is None:
        return 1.0
    pupil = first_order(lens.system(), lens.primary_wavelength).entrance_pupil
    return min(2.0 * half_width / abs(float(pupil.diameter)), 1.0)


def whole_stop_rms(lens: Lens, settings: MeritSettings) -> float | None:
    """Return the mean RMS radius (µm) over the whole stop; None where the rays fill it anyway."""
    if pupil_share(lens, settings) >= 1.0:
        return None
    whole = {"sampling": "gaussian_quadrature", "sampling_options": _WHOLE_STOP}
    return spot_table(lens, replace(settings, **whole)).mean


@torch.no_grad()
def merit_spots(lens: Lens, settings: MeritSettings) -> SpotDiagram:
    """Return the spots of a lens, with the RMS radii of `rms_spot_um` (mm)."""
    fields, waves = settings.fields_of(lens), settings.wavelengths_of(lens)
    quality, values, hits = _traced(lens, settings)
    shape = (len(fields), len(waves))
    rms = values.rms.double().cpu().reshape(shape)
    if not is_grid(settings):
        found = spot_diagram(lens, fields, waves, object_distance=lens.object_distance)
        return replace(found, rms=rms)
    spot = quality.spots.spot.cpu()
    points = _padded(hits, spot, quality.spots.count).unflatten(0, shape)
    valid = points.isfinite().all(-1)
    light = valid.double()
    extent = values.deviations.double().cpu().norm(dim=1, keepdim=True)
    geo = _padded(extent, spot, quality.spots.count).nan_to_num(0.0).amax((1, 2))
    common, square = moments(points.flatten(1, 2), light.flatten(1, 2))
    wavelengths = torch.tensor(list(waves), dtype=torch.float64)
    chief = lens.chief_ray(
        torch.tensor(list(fields), dtype=lens.dtype, device=lens.device), lens.primary_wavelength
    )
    return SpotDiagram(
        fields=torch.tensor(list(fields), dtype=torch.float64),
        field_unit=field_unit(lens.object_distance),
        wavelengths=wavelengths,
        reference_wavelength=lens.primary_wavelength,
        intercepts=points,
        valid=valid,
        weight=torch.full((points.shape[2],), 1.0 / points.shape[2], dtype=torch.float64),
        wavelength_weight=torch.full((len(wavelengths),), 1.0 / len(wavelengths)).double(),
        chief=lens.trace(chief).position[..., :2].double().cpu(),
        centroid=moments(points, light)[0],
        rms=rms,
        geo=geo.reshape(shape),
        polychromatic_centroid=common,
        polychromatic_rms=square.sqrt(),
        airy_radius=AIRY * wavelengths * 1e-6 * _f_numbers(lens, settings, wavelengths),
    )


@torch.no_grad()
def merit_modulation(lens: Lens, settings: MeritSettings, frequencies: Tensor) -> Modulation:
    """Return the contrast of the spots times that of the pupil's diffraction.

    The rays fill the pupil of `rms_spot_um`, more densely than that number needs.  The product is right where aberrations are far below a wavelength, and where they are many
    wavelengths (Hopkins 1957; see `dolens.diffraction.diffraction_limit`).
    """
    fields, waves = settings.fields_of(lens), settings.wavelengths_of(lens)
    found = modulation(lens, fields, waves, frequencies, object_distance=lens.object_distance)
    tangential, sagittal, limit = found.tangential, found.sagittal, found.diffraction_limit
    if pupil_share(lens, settings) < 1.0:
        dense = {**settings.sampling_options, "count": _DENSE_GRID}
        quality, _, hits = _traced(lens, replace(settings, sampling_options=dense))
        points = _padded(hits, quality.spots.spot.cpu(), quality.spots.count)
        points = points.unflatten(0, (len(fields), len(waves))).flatten(1, 2)
        along = _along(found.fields)
        across = torch.stack((along[:, 1], -along[:, 0]), -1)
        light = points.isfinite().all(-1).double()
        points = points.nan_to_num(0.0)
        tangential, sagittal = (
            torch.stack(
                [
                    modulation_transfer(p, w, frequencies, direction)
                    for p, w, direction in zip(points, light, way, strict=True)
                ]
            )
            for way in (along, across)
        )
        limit = _grid_limit(lens, settings, found, frequencies)
    return replace(
        found,
        tangential=tangential * limit,
        sagittal=sagittal * limit,
        diffraction_limit=limit,
    )


def merit_rms_against_field(
    lens: Lens, settings: MeritSettings, edge: Sequence[float]
) -> RMSCurves:
    """Return RMS radii from the axis to a field, by the sampling and reference of `rms_spot_um`."""
    steps = torch.linspace(0.0, 1.0, _CURVE_POINTS, dtype=torch.float64)
    fields = [(float(s * edge[0]), float(s * edge[1])) for s in steps]
    return _curves(lens, settings, fields, settings.wavelengths_of(lens))


def merit_rms_against_wavelength(
    lens: Lens, settings: MeritSettings, interval: tuple[float, float]
) -> RMSCurves:
    """Return RMS radii over wavelengths, each about its own centroid or chief ray."""
    waves = torch.linspace(*interval, _CURVE_POINTS, dtype=torch.float64).tolist()
    own = replace(settings, reference_spectrum="monochromatic")
    return _curves(lens, own, list(settings.fields_of(lens)), waves)


@torch.no_grad()
def _curves(
    lens: Lens,
    settings: MeritSettings,
    fields: Sequence[Sequence[float]],
    waves: Sequence[float],
) -> RMSCurves:
    rows, together = [], []
    for field in fields:
        one = replace(
            settings,
            fields=[tuple(field)],
            wavelengths=list(waves),
            field_weights=None,
            wavelength_weights=None,
        )
        try:
            rows.append(_traced(lens, one)[1].rms)
            common = replace(one, reference_spectrum="polychromatic")
            together.append(_traced(lens, common)[1].mean_squares.mean().sqrt())
        except InputError:  # no light of the field passes
            rows.append(torch.full((len(waves),), math.nan))
            together.append(torch.tensor(math.nan))
    wavelengths = torch.tensor(list(waves), dtype=torch.float64)
    return RMSCurves(
        fields=torch.tensor([tuple(field) for field in fields], dtype=torch.float64),
        field_unit=field_unit(lens.object_distance),
        wavelengths=wavelengths,
        rms=torch.stack([row.double().cpu() for row in rows]),
        polychromatic=torch.stack([value.double().cpu() for value in together]),
        airy_radius=AIRY * wavelengths * 1e-6 * _f_numbers(lens, settings, wavelengths),
    )


def _traced(lens: Lens, settings: MeritSettings) -> tuple[ImageQuality, QualityValues, Tensor]:
    """Return the rays of `rms_spot_um`, their values, and where they land (N, 2), mm."""
    quality = settings.image_quality(lens)
    hits = lens.trace(quality.spots.rays).position[..., :2].detach().double().cpu()
    return quality, quality.values(lens), hits


def _padded(hits: Tensor, spot: Tensor, count: int) -> Tensor:
    """Return (spots, most rays of one, K) of (N, K); NaN where a spot has fewer."""
    of_spot = [hits[spot == number] for number in range(count)]
    return torch.nn.utils.rnn.pad_sequence(of_spot, batch_first=True, padding_value=math.nan)


def _f_numbers(lens: Lens, settings: MeritSettings, wavelengths: Tensor) -> Tensor:
    """Return working F-numbers of the pupil that the rays fill."""
    whole = working_f_numbers(lens, wavelengths, lens.object_distance)
    return whole / pupil_share(lens, settings)


def _grid_limit(
    lens: Lens, settings: MeritSettings, found: Modulation, frequencies: Tensor
) -> Tensor:
    """Return the diffraction limit of a square pupil, 1 - ν·λ·N with N over its whole width.

    Goodman, Introduction to Fourier Optics, section 6.4; the grid's corners lie within the stop.
    """
    number = _f_numbers(lens, settings, found.wavelengths)
    s = frequencies * found.wavelengths[:, None] * 1e-6 * number[:, None]
    return (1.0 - s).clamp(min=0.0).mean(0)


def _along(fields: Tensor) -> Tensor:
    """Return unit vectors along the fields, (F, 2); +y on the axis."""
    tangents = torch.tan(torch.deg2rad(fields))
    length = tangents.norm(dim=-1, keepdim=True)
    return torch.where(length > 0.0, tangents / length, tangents.new_tensor([0.0, 1.0]))
