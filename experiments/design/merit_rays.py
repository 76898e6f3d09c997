"""Spots, contrast and RMS curves are computed over the very rays of `rms_spot_um`.

A figure beside a headline number shows that number's rays.  A grid of rays is shown as it is.
Where the number is a Gaussian quadrature of the whole stop, a figure shows more rays of the same
pupil, and its RMS radii are those of the quadrature.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from dolens.analysis.conditions import Conditions
from dolens.analysis.modulation_transfer import (
    Modulation,
    diffraction_limited_transfer,
    field_directions,
    modulation,
    modulation_transfer,
)
from dolens.analysis.spot_diagram import (
    AIRY,
    RMSCurves,
    SpotDiagram,
    moments,
    spot_diagram,
    working_f_numbers,
)
from dolens.diffraction.modulation_transfer import diffraction_modulation
from dolens.errors import InputError
from dolens.experiments.design.states import SQUARE_GRID_COUNT, spot_table
from dolens.optics.fields import field_label
from dolens.optics.lens import Lens
from dolens.optics.paraxial import first_order
from dolens.optimize import MeritSettings
from dolens.optimize.image_quality import ImageQuality, QualityValues

# Of an RMS curve; an odd number, so that the middle of the interval is among them.
_CURVE_POINTS = 31
# Rays along each side of a grid for transfer functions.
_DENSE_GRID = 121
# Airy radii beyond which a mean RMS radius leaves diffraction without a say.
_STEEP = 10.0


@torch.no_grad()
def merit_spots(lens: Lens, settings: MeritSettings) -> SpotDiagram:
    """Return the spots of a lens, with the RMS radii of `rms_spot_um` (mm)."""
    where = settings.conditions_of(lens)
    quality, values, hits = _traced(lens, settings)
    shape = (len(where.fields), len(where.wavelengths))
    rms = values.rms.double().cpu().reshape(shape)
    if not is_grid(settings):
        return replace(spot_diagram(lens, where), rms=rms)
    spot = quality.spots.spot.cpu()
    points = _padded(hits, spot, quality.spots.count).unflatten(0, shape)
    valid = points.isfinite().all(-1)
    light = valid.double()
    extent = values.deviations.double().cpu().norm(dim=1, keepdim=True)
    geo = _padded(extent, spot, quality.spots.count).nan_to_num(0.0).amax((1, 2))
    every = light * where.weights[:, None]
    common, square = moments(points.flatten(1, 2), every.flatten(1, 2))
    places = where.fields.to(dtype=lens.dtype, device=lens.device)
    chief = lens.chief_ray(places, where.reference_wavelength)
    return SpotDiagram(
        where=where,
        intercepts=points,
        valid=valid,
        weight=torch.full((points.shape[2],), 1.0 / points.shape[2], dtype=torch.float64),
        chief=lens.trace(chief).position[..., :2].double().cpu(),
        centroid=moments(points, light)[0],
        rms=rms,
        geo=geo.reshape(shape),
        polychromatic_centroid=common,
        polychromatic_rms=square.sqrt(),
        airy_radius=_airy_radii(lens, settings, where),
    )


@torch.no_grad()
def merit_modulation(
    lens: Lens, settings: MeritSettings, frequencies: Tensor
) -> tuple[Modulation, list[str]]:
    """Return the MTF with diffraction of the pupil of `rms_spot_um`.

    Over the whole stop it is the pupil's autocorrelation.  Over a grid within the stop, and where
    spots are many Airy discs large, it is the contrast of the rays times the diffraction limit.
    The product is right where aberrations are far below a wavelength, and where they are many
    wavelengths (see `dolens.diffraction.pixel_psf`).

    Returns:
        The MTF, and labels of the fields that are such products.
    """
    where = settings.conditions_of(lens)
    wavelengths, shares = where.wavelengths, where.weights
    if pupil_share(lens, settings) < 1.0:
        found = _grid_modulation(lens, settings, frequencies)
        return found, [field_label(field, found.field_unit) for field in found.fields]
    numbers = working_f_numbers(lens, where)
    limit = shares @ diffraction_limited_transfer(
        frequencies, wavelengths[:, None], numbers[:, None]
    )
    airy = float(AIRY * 1e-3 * shares @ (wavelengths * numbers))
    if spot_table(lens, settings).mean > _STEEP * airy:
        # Diffraction changes next to nothing, and a wave calculation takes long.
        rays = modulation(lens, where, frequencies)
        products = {"tangential": rays.tangential * limit, "sagittal": rays.sagittal * limit}
        labels = [field_label(field, rays.field_unit) for field in rays.fields]
        return replace(rays, **products, diffraction_limit=limit), labels
    whole = diffraction_modulation(lens, where, frequencies)
    by_rays = [not done for done in whole.diffraction]
    factor = torch.where(torch.tensor(by_rays)[:, None], limit, 1.0)
    found = Modulation(
        whole.where,
        whole.frequencies,
        whole.tangential * factor,
        whole.sagittal * factor,
        limit,
    )
    steep = zip(whole.fields, by_rays, strict=True)
    return found, [field_label(field, whole.field_unit) for field, by_ray in steep if by_ray]


def _grid_modulation(lens: Lens, settings: MeritSettings, frequencies: Tensor) -> Modulation:
    """Return the contrast of the rays of a grid within the stop, times its diffraction limit.

    The grid is denser than that of `rms_spot_um`, and as large.
    """
    where = settings.conditions_of(lens)
    dense = {**settings.sampling_options, "count": _DENSE_GRID}
    quality, _, hits = _traced(lens, replace(settings, sampling_options=dense))
    points = _padded(hits, quality.spots.spot.cpu(), quality.spots.count)
    points = points.unflatten(0, (len(where.fields), len(where.wavelengths)))
    light = (points.isfinite().all(-1) * where.weights[:, None]).flatten(1, 2)
    points = points.flatten(1, 2).nan_to_num(0.0)
    along = field_directions(where)
    across = torch.stack((along[:, 1], -along[:, 0]), -1)
    tangential, sagittal = (
        torch.stack(
            [
                modulation_transfer(p, w, frequencies, direction)
                for p, w, direction in zip(points, light, way, strict=True)
            ]
        )
        for way in (along, across)
    )
    numbers = pupil_f_numbers(lens, settings, where)
    limit = where.weights @ _square_limits(numbers, where.wavelengths, frequencies)
    return Modulation(
        where,
        frequencies,
        tangential * limit,
        sagittal * limit,
        limit,
    )


def merit_rms_against_field(
    lens: Lens,
    settings: MeritSettings,
    edge: Sequence[float],
    start: Sequence[float] = (0.0, 0.0),
) -> RMSCurves:
    """Return RMS radii between two fields, by the sampling and reference of `rms_spot_um`.

    Args:
        lens: the lens.
        settings: the rays, and what radii count from.
        edge: the last field, (x, y) in degrees or mm.
        start: the first one; the axis, or the field opposite to the edge.
    """
    steps = torch.linspace(0.0, 1.0, _CURVE_POINTS, dtype=torch.float64).tolist()
    fields = [tuple(a + s * (b - a) for a, b in zip(start, edge, strict=True)) for s in steps]
    return _curves(lens, settings, settings.conditions_of(lens).at(fields))


def merit_rms_against_wavelength(
    lens: Lens, settings: MeritSettings, interval: tuple[float, float]
) -> RMSCurves:
    """Return RMS radii over wavelengths, each about its own centroid or chief ray."""
    waves = torch.linspace(*interval, _CURVE_POINTS, dtype=torch.float64)
    own = replace(settings, reference_spectrum="monochromatic")
    return _curves(lens, own, settings.conditions_of(lens).at(wavelengths=waves))


@torch.no_grad()
def _curves(lens: Lens, settings: MeritSettings, where: Conditions) -> RMSCurves:
    fields, waves = where.fields.tolist(), where.wavelengths.tolist()
    own = replace(settings, wavelengths=waves, wavelength_weights=where.weights.tolist())
    try:
        rms, together = _radii(lens, own, fields)
    except InputError:  # no light of some field passes
        rows = [_radii_or_none(lens, own, field) for field in fields]
        rms, together = (torch.cat(part) for part in zip(*rows, strict=True))
    return RMSCurves(
        where=where,
        rms=rms,
        polychromatic=together,
        airy_radius=_airy_radii(lens, settings, where),
    )


def _airy_radii(lens: Lens, settings: MeritSettings, where: Conditions) -> Tensor:
    """Return 1.22·λ·N (W,), mm, of the pupil that the rays fill."""
    return AIRY * where.wavelengths * 1e-6 * pupil_f_numbers(lens, settings, where)


def _radii(
    lens: Lens, settings: MeritSettings, fields: Sequence[Sequence[float]]
) -> tuple[Tensor, Tensor]:
    """Return RMS radii (F, W), and those of all wavelengths about their common reference, (F,)."""
    alike = [1.0] * len(fields)
    settings = replace(settings, fields=[tuple(field) for field in fields], field_weights=alike)
    quality = settings.image_quality(lens)
    shares = settings.conditions_of(lens).weights
    shape = (len(fields), len(shares))
    rms = quality.values(lens).rms.double().cpu().reshape(shape)
    common = replace(quality, reference_spectrum="polychromatic").values(lens)
    return rms, (common.mean_squares.double().cpu().reshape(shape) @ shares).sqrt()


def _radii_or_none(
    lens: Lens, settings: MeritSettings, field: Sequence[float]
) -> tuple[Tensor, Tensor]:
    """Return the same of one field; NaN where none of its light passes."""
    try:
        return _radii(lens, settings, [field])
    except InputError:
        count = len(settings.conditions_of(lens).wavelengths)
        dark = torch.full((1, count), math.nan, dtype=torch.float64)
        return dark, dark[:, 0]


def _traced(lens: Lens, settings: MeritSettings) -> tuple[ImageQuality, QualityValues, Tensor]:
    """Return the rays of `rms_spot_um`, their values, and where they land (N, 2), mm."""
    quality = settings.image_quality(lens)
    hits = lens.trace(quality.spots.rays).position[..., :2].detach().double().cpu()
    return quality, quality.values(lens), hits


def _padded(hits: Tensor, spot: Tensor, count: int) -> Tensor:
    """Return (spots, most rays of one, K) of (N, K); NaN where a spot has fewer."""
    of_spot = [hits[spot == number] for number in range(count)]
    return torch.nn.utils.rnn.pad_sequence(of_spot, batch_first=True, padding_value=math.nan)


def _square_limits(f_numbers: Tensor, wavelengths: Tensor, frequencies: Tensor) -> Tensor:
    """Return the diffraction limits (W, Q) of a square pupil, 1 - ν·λ·N with N over its whole
    width.

    Goodman, Introduction to Fourier Optics, section 6.4.
    """
    s = frequencies * (wavelengths * 1e-6 * f_numbers)[:, None]
    return (1.0 - s).clamp(min=0.0)


COMMON_CENTROID = "about one centroid for all wavelengths"
COMMON_CHIEF_RAY = "about one chief ray for all wavelengths"

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
    if settings.reference_spectrum == "polychromatic":
        return COMMON_CHIEF_RAY if settings.reference == "chief" else COMMON_CENTROID
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


def pupil_f_numbers(lens: Lens, settings: MeritSettings, where: Conditions) -> Tensor:
    """Return working F-numbers of the pupil that the rays fill."""
    return working_f_numbers(lens, where) / pupil_share(lens, settings)
