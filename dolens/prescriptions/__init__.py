"""Prescriptions describe lenses as plain data, and are read from and written to files."""

from dolens.prescriptions.build import lens_from_prescription, prescription_of
from dolens.prescriptions.files import (
    find_lens,
    lens_names,
    load_lens,
    load_prescription,
    published_lens_names,
    save_lens,
)
from dolens.prescriptions.spline_fit import fit_b_spline

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
