"""The pupil that the rays of `rms_spot_um` fill, in numbers and in words."""

from dataclasses import replace

from torch import Tensor

from dolens.analysis.spot_diagram import (
    working_f_numbers,
)
from dolens.experiments.design.tables import SQUARE_GRID_COUNT, spot_table
from dolens.optics.lens import Lens
from dolens.optics.paraxial import first_order
from dolens.optimize import MeritSettings

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


def pupil_f_numbers(lens: Lens, settings: MeritSettings, wavelengths: Tensor) -> Tensor:
    """Return working F-numbers of the pupil that the rays fill."""
    whole = working_f_numbers(lens, wavelengths, lens.object_distance)
    return whole / pupil_share(lens, settings)
