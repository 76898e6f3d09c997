"""Prescriptions describe lenses as plain data, and are read from and written to files."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dolens.optics.surfaces.spline_fit import fit_b_spline
    from dolens.prescriptions.build import lens_from_prescription, prescription_of
    from dolens.prescriptions.files import (
        find_lens,
        lens_names,
        load_lens,
        load_prescription,
        published_lens_names,
        save_lens,
    )

__all__ = [
    "find_lens",
    "fit_b_spline",
    "lens_from_prescription",
    "lens_names",
    "load_lens",
    "load_prescription",
    "prescription_of",
    "published_lens_names",
    "save_lens",
]

# All others are in `files`.  Each is imported when it is first used: a run's files are plain values
# too, and who reads them need not wait for PyTorch.
_HOMES = {
    "fit_b_spline": "dolens.optics.surfaces.spline_fit",
    "lens_from_prescription": "dolens.prescriptions.build",
    "prescription_of": "dolens.prescriptions.build",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in __all__:
        raise AttributeError(f"module 'dolens.prescriptions' has no attribute '{name}'")
    home = importlib.import_module(_HOMES.get(name, "dolens.prescriptions.files"))
    globals()[name] = found = getattr(home, name)
    return found
