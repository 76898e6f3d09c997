"""A prescription is written as the text of a Zemax `.zmx` file."""

from collections.abc import Mapping
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.checks import as_integer, as_number
from dolens.prescriptions.compare import require_same
from dolens.prescriptions.decimals import shifted
from dolens.prescriptions.zemax_apertures import aperture_lines
from dolens.prescriptions.zemax_glass import canonical, catalogue_line, glass_line
from dolens.prescriptions.zemax_reader import prescription_from_zemax
from dolens.prescriptions.zemax_shapes import shape_of_row

_D_LINE = 587.5618


def zemax_of(prescription: Mapping[str, Any], where: str = "lens") -> str:
    """Write a prescription as the text of a `.zmx` file (see `encode_zemax`).

    Every semi-diameter is written as an aperture, since it clips, and the system's
    aperture floats by the stop.  Zemax cannot do without a wavelength and a field: where the
    prescription has none, the d line and the axis are written.  A glass's maker goes into GCAT, its
    nd and Vd beside its name; a constant index is a model glass whose Vd is 0.  `occluder` is
    written as air, which it is in the index models that a file can hold.

    Raises:
        InputError: one line that names the surface and key which the format cannot hold.
    """
    model = str(prescription.get("index_model", "dfc"))
    if model != "dfc":
        raise InputError(
            f"{where}: a .zmx file cannot hold index_model '{model}' (allowed: dfc; its nd and Vd "
            "are those of the lines C, d, F, and its air has index 1)"
        )
    surfaces = {str(n): row for n, row in prescription["surfaces"].items()}
    sensor = prescription["sensor"]
    stop = as_integer(prescription.get("stop", 1), f"{where}: 'stop'")
    lines = _system(prescription, surfaces, where)
    distance = prescription.get("object_distance")
    lines += [
        "SURF 0",
        "  TYPE STANDARD",
        "  CURV 0.0",
        *glass_line(prescription.get("object_material", "air"), f"{where}: object"),
        f"  DISZ {'INFINITY' if distance is None else _text(distance, where)}",
        '  DIAM 0 0 0 0 1 ""',
    ]
    for n, row in surfaces.items():
        place = f"{where}: surface {n}"
        gap = row.get("thickness", sensor["distance"])
        lines += [f"SURF {n}", *(["  STOP"] if str(stop) == n else [])]
        lines += _surface(row, place)
        lines.append(f"  DISZ {_text(gap, place)}")
    diameter = as_number(sensor.get("diameter") or 0.0, f"{where}: 'sensor.diameter'")
    lines += [
        f"SURF {len(surfaces) + 1}",
        "  TYPE STANDARD",
        "  CURV 0.0",
        "  DISZ 0",
        f'  DIAM {diameter / 2.0!r} {int(diameter > 0.0)} 0 0 1 ""',
    ]
    text = "\n".join((*lines, ""))
    found = prescription_from_zemax(text, where)
    require_same(prescription, found, ".zmx", where, canonical, _ALWAYS)
    return text


_ALWAYS = ("wavelengths", "reference_wavelength", "fields")


def _system(prescription: Mapping[str, Any], surfaces: Mapping[str, Any], where: str) -> list[str]:
    waves = prescription.get("wavelengths") or [_D_LINE]
    waves = [as_number(wave, f"{where}: 'wavelengths'") for wave in waves]
    reference = float(prescription.get("reference_wavelength") or waves[0])
    if reference not in waves:
        raise InputError(f"{where}: 'reference_wavelength' {reference!r} is none of 'wavelengths'")
    kind, points = next(iter((prescription.get("fields") or {"angles": [[0.0, 0.0]]}).items()))
    x, y = ([_text(point[axis], f"{where}: fields") for point in points] for axis in (0, 1))
    materials = [row.get("material") for row in surfaces.values()]
    materials.append(prescription.get("object_material", "air"))
    notes = str(prescription.get("source") or "").splitlines()
    return [
        "VERS 170912 299 0",
        "MODE SEQ",
        f"NAME {prescription.get('name', '')}".rstrip(),
        *(f"NOTE 0 {note}" for note in notes),
        "UNIT MM X W X CM MR CPMM",
        *_pupil(prescription, where),
        "ENVD 20 1 0",
        "GFAC 0 0",
        *catalogue_line(materials, where),
        f"FTYP {int(kind == 'heights')} 0 {len(points)} {len(waves)} 0 0 0",
        f"XFLN {' '.join(x)}",
        f"YFLN {' '.join(y)}",
        f"FWGN {' '.join('1' for _ in points)}",
        *(f"WAVM {i} {shifted(wave, -3)} 1" for i, wave in enumerate(waves, 1)),
        f"PWAV {waves.index(reference) + 1}",
    ]


def _pupil(prescription: Mapping[str, Any], where: str) -> list[str]:
    if prescription.get("entrance_pupil_diameter") is not None:
        return [f"ENPD {_text(prescription['entrance_pupil_diameter'], where)}"]
    if prescription.get("f_number") is not None:
        return [f"FNUM {_text(prescription['f_number'], where)} 0"]
    return ["FLOA"]


def _surface(row: Mapping[str, Any], place: str) -> list[str]:
    """Write a surface's block, without its number, stop and distance."""
    shape = shape_of_row(row, place)
    lines = [f"  TYPE {shape.type}"]
    if row.get("note"):
        lines.append(f"  COMM {row['note']}")
    lines += [f"  {line}" for line in shape.write(row, place)]
    if not shape.surface:
        return lines
    return [*lines, *glass_line(row.get("material"), place), *aperture_lines(row, place)]


def _text(value: object, place: str) -> str:
    return repr(as_number(value, place))
