"""Prescriptions describe lenses as plain data, and are read from and written to files."""

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
