"""Tables of wavefront errors, of Zernike coefficients and of distortion, and notes on sampling."""

from collections.abc import Sequence

import torch
from torch import Tensor

from dolens.analysis.conditions import FieldScan
from dolens.analysis.field_curves import DISTORTION_REFERENCES, image_displacement
from dolens.diffraction.strehl import marechal
from dolens.diffraction.wavefront_error import WavefrontErrors
from dolens.diffraction.wavefront_map import WavefrontMaps
from dolens.lens_page.tables import Table, number
from dolens.optics.fields import field_label
from dolens.optics.lens import Lens

# Fringe terms up to secondary spherical, without piston.
_TERMS = 16
# Every so manieth field of a scan.
_SOME = 8


def errors_table(errors: WavefrontErrors) -> Table:
    """Return RMS, peak to valley and Strehl ratio of every field and wavelength."""
    columns = (
        *(errors.rms, errors.peak_to_valley, errors.strehl_ratio),
        marechal(errors.rms),
    )
    rows = [
        (
            field_label(point, errors.field_unit),
            f"{wave:g}",
            *(number(values[row, column], 3) for values in columns),
        )
        for row, point in enumerate(errors.fields)
        for column, wave in enumerate(errors.wavelengths.tolist())
    ]
    return Table(
        (
            *("field", "wavelength (nm)", "RMS (waves)", "peak to valley (waves)"),
            *("Strehl ratio", "by Maréchal"),
        ),
        rows,
        "On the sensor as it stands, tilt removed; Maréchal's ratio is exp(−(2π·RMS)²). – : no "
        "light passes.",
    )


def zernike_table(maps: WavefrontMaps) -> Table:
    """Return fringe coefficients of the maps' first wavelength, a column a field."""
    fit = maps.zernike("fringe")
    fields = [field_label(field, maps.field_unit) for field in maps.fields]
    rows = [
        (f"Z{n + 1}", fit.names[n], *(number(c, 3) for c in fit.coefficients[:, 0, n]))
        for n in range(1, _TERMS)
    ]
    rows.append(("", "RMS beyond 37 terms", *(number(r, 2) for r in fit.residual_rms[:, 0])))
    return Table(
        ("fringe", "term", *fields),
        rows,
        "Zernike coefficients in waves, over the disc of the stop; over a vignetted or obscured "
        "pupil they are a fit, whose terms are not orthogonal.",
        frozenset({0, 1}),
    )


def distortion_table(lens: Lens, scans: Sequence[FieldScan]) -> Table:
    """Return distortion from f·tan θ and from f·θ at some fields of the first scan."""
    scan = scans[0]
    some = torch.arange(len(scan.fields) - 1, 0, -_SOME).flip(0)
    some = some[scan.coordinate[some] != 0.0]
    columns = [
        image_displacement(lens, scan, [lens.primary_wavelength], None, name).distortion[some, 0]
        for name in DISTORTION_REFERENCES
    ]
    rows = [
        (field_label(scan.fields[at], scan.field_unit), *(number(c[row], 3) for c in columns))
        for row, at in enumerate(some.tolist())
    ]
    heads = [f"from {text} (%)" for text in DISTORTION_REFERENCES.values()]
    return Table(("field", *heads), rows, "Distortion of the reference wavelength's chief ray.")


def sampling_note(what: str, errors: Tensor) -> str:
    """Return a sentence about the largest sampling error; nothing where none is known."""
    known = errors[errors.isfinite()]
    if not len(known):
        return ""
    return f"Sampling error of the {what}: {number(known.max(), 2)} or less, by a second sampling."
