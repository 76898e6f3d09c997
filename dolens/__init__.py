"""dolens: end-to-end co-design of optics and reconstruction."""

import importlib
from typing import TYPE_CHECKING, Any

from dolens.errors import InputError
from dolens.optics import LENS_METHODS

if TYPE_CHECKING:
    from dolens.lens_search.short_search import search
    from dolens.optics.lens import Lens
    from dolens.optics.rays import Rays, Status
    from dolens.optics.surfaces import register_surface
    from dolens.prescriptions import load_lens, save_lens
    from dolens.reconstruction import restore

__version__ = "0.1.0"

__all__ = [
    "InputError",
    "Lens",
    "Rays",
    "Status",
    "load_lens",
    "register_surface",
    "restore",
    "save_lens",
    "search",
]

# Imported when they are first used, so that `dolens --help` need not wait for PyTorch.
_HOMES = {
    "Lens": "dolens.optics.lens",
    "Rays": "dolens.optics.rays",
    "Status": "dolens.optics.rays",
    "load_lens": "dolens.prescriptions",
    "register_surface": "dolens.optics.surfaces",
    "restore": "dolens.reconstruction",
    "save_lens": "dolens.prescriptions",
    "search": "dolens.lens_search.short_search",
}
_PACKAGES = (
    *("kernels", "optics", "optimize", "prescriptions", "reconstruction", "rendering"),
    "tolerancing",
)
_VIEWS = (
    *(
        "coated",
        "crystal_rays",
        "draw",
        "encircled_energy",
        "explain",
        "fibre_coupling",
        "field_curves",
        "footprint",
        "gaussian_beam",
        "ghosts",
        "lateral_colour",
        "mtf",
        "photograph",
        "photograph_polarised",
        "polarisation",
        "psf",
    ),
    *(
        "optimize",
        "ray_fans",
        "relative_illumination",
        "transmission",
        "rms",
        "spots",
        "strehl",
        "summary",
        "wavefront",
    ),
    *("with_iris", "zernike"),
)
LENS_METHODS.update(dict.fromkeys(_VIEWS, "dolens.views.LensViews"))
# What needs a part that nothing below it imports.
LENS_METHODS["draw_3d"] = "dolens.lens_page.in_space.SpaceViews"
LENS_METHODS["search_neighbours"] = "dolens.lens_search.neighbours.SearchMethods"
LENS_METHODS["tolerances"] = "dolens.lens_page.lens_tolerances.ToleranceMethods"


def __getattr__(name: str) -> Any:
    """Import a public name, or a package of the library, when it is first used."""
    if name in _PACKAGES:
        return importlib.import_module(f"dolens.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module 'dolens' has no attribute '{name}'")
    found = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """Return the public names, loaded or not."""
    return sorted({*__all__, *_PACKAGES, "__version__"})
