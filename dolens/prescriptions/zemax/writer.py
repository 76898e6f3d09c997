"""A prescription is written as the text of a Zemax `.zmx` file, and its states as configurations.

Each state is written as a file of its own, and the numbers in which these files differ become the
operands behind MNUM, one configuration a state, with its name as the title (LTTL).  Where the lens
itself is none of its states, it has a configuration besides, which is the current one.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from dolens.errors import InputError
from dolens.prescriptions.numbers import as_integer, as_number, number_text, shifted
from dolens.prescriptions.other_programs import require_dfc, require_same, written_wavelengths
from dolens.prescriptions.row_data import canonical
from dolens.prescriptions.states import STATES_KEY, merged_prescription
from dolens.prescriptions.zemax.apertures import aperture_lines
from dolens.prescriptions.zemax.configurations import (
    TITLE,
    Setting,
    own_title,
    settings_between,
    settings_of,
)
from dolens.prescriptions.zemax.file import parse_zemax
from dolens.prescriptions.zemax.glass import catalogue_line, glass_line
from dolens.prescriptions.zemax.gradients import gradient_lines
from dolens.prescriptions.zemax.reader import prescription_from_zemax
from dolens.prescriptions.zemax.shapes import shape_of_row
from dolens.prescriptions.zemax.system import FIELD_KINDS, PUPIL_ANGLES, VIGNETTING_OPERANDS
from dolens.prescriptions.zemax.table import conic_line, curvature_line

# Fields in the lists; further ones have lines of their own.
_LISTED = 12
_ALWAYS = ("wavelengths", "reference_wavelength", "fields")
_PUPILS = {
    "entrance_pupil_diameter": "ENPD {}",
    "f_number": "FNUM {} 0",
    "working_f_number": "FNUM {} 1",
    "object_na": "OBNA {} 0",
}


def _configurations_of(
    prescription: Mapping[str, Any], write: Callable[[Mapping[str, Any]], str], where: str
) -> list[str]:
    """Return MNUM and the lines behind it, for a prescription with states.

    Args:
        prescription: with its states.
        write: returns the text of a file for a prescription without states.
        where: name in messages.

    Raises:
        InputError: a state has a temperature or pressure, or changes what no configuration can.
    """
    states = prescription["states"]
    files = {own_title(prescription): parse_zemax(write(prescription), where)}
    for name, overlay in states.items():
        place = f"{where}: state '{name}'"
        for key in ("temperature", "pressure"):
            if overlay.get(key) is not None:
                raise InputError(
                    f"{place}: a .zmx file cannot hold '{key}' of a state: the numbers of its "
                    "configurations are those at their temperature"
                )
        files[str(name)] = parse_zemax(
            write(merged_prescription(prescription, overlay, place)), place
        )
    settings: dict[Setting, None] = {}
    found = []
    base = next(iter(files.values()))
    for name, file in files.items():
        found.append(settings_between(base, file, f"{where}: state '{name}'"))
        settings |= dict.fromkeys(found[-1])
    first = settings_of(base)
    same = [n for n, changes in enumerate(found[1:], 1) if not changes]
    names, values = list(files), [first | changes for changes in found]
    if same:
        # The lens itself is one of its states.
        names, values = names[1:], values[1:]
        current = same[0]
    else:
        current = 1
    lines = [f"MNUM {len(names)} {current}"]
    for n, name in enumerate(names, 1):
        lines.append(f'{TITLE} 0 {n} "{name}" 0 0 0 1 1 0 0.0 "" 0')
    for setting in settings:
        for n, of_state in enumerate(values, 1):
            lines.append(
                f"{setting.operand} {setting.number} {n} {of_state.get(setting, '0.0')} 0 "
                f'{setting.parameter} 0 1 1 1 0 0 "" 0'
            )
    return lines


def zemax_of(prescription: Mapping[str, Any], where: str = "lens") -> str:
    """Write a prescription as the text of a `.zmx` file (see `encode_zemax`).

    A semi-diameter that clips is written as an aperture, any other as a size alone.  Where the
    prescription gives no pupil, the system's aperture floats by the stop.  Zemax cannot do without
    a wavelength and a field: where the prescription has none, the d line and the axis are written.
    A glass's maker goes into GCAT, its nd and Vd beside its name; a constant index is a model glass
    whose Vd is 0.  `occluder` is written as air, which it is in the index models that a file can
    hold.  States are written as configurations (see the head of this file).

    Raises:
        InputError: one line that names the surface and key which the format cannot hold.
    """
    if not prescription.get(STATES_KEY):
        return _without_states(prescription, where)
    alone = {key: value for key, value in prescription.items() if key != STATES_KEY}
    text = _without_states(alone, where)
    lines = _configurations_of(prescription, partial(_written, where=where), where)
    text += "\n".join((*lines, ""))
    found = prescription_from_zemax(text, where)
    for name, state in prescription[STATES_KEY].items():
        place = f"{where}: state '{name}'"
        back = found.get(STATES_KEY, {}).get(name)
        if back is None:
            raise InputError(f"{place}: a .zmx file cannot hold it")
        both = (
            merged_prescription(prescription, state, place),
            merged_prescription(found, back, place),
        )
        require_same(*both, ".zmx", place, canonical, _ALWAYS)
    return text


def _without_states(prescription: Mapping[str, Any], where: str) -> str:
    text = _written(prescription, where)
    found = prescription_from_zemax(text, where)
    require_same(prescription, found, ".zmx", where, canonical, _ALWAYS)
    return text


def _written(prescription: Mapping[str, Any], where: str) -> str:
    """Write a prescription without its states; nothing is read back."""
    require_dfc(prescription, ".zmx", where)
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
        f"  DISZ {'INFINITY' if distance is None else number_text(distance, where)}",
        '  DIAM 0 0 0 0 1 ""',
    ]
    for n, row in surfaces.items():
        place = f"{where}: surface {n}"
        gap = row.get("thickness", sensor["distance"])
        lines += [f"SURF {n}", *(["  STOP"] if str(stop) == n else [])]
        lines += _surface(row, place)
        lines.append(f"  DISZ {number_text(gap, place)}")
    diameter = as_number(sensor.get("diameter") or 0.0, f"{where}: 'sensor.diameter'")
    lines += [
        f"SURF {len(surfaces) + 1}",
        "  TYPE STANDARD",
        *_image_shape(sensor, where),
        "  DISZ 0",
        f'  DIAM {diameter / 2.0!r} {int(diameter > 0.0)} 0 0 1 ""',
    ]
    return "\n".join((*lines, ""))


def _image_shape(sensor: Mapping[str, Any], where: str) -> list[str]:
    """Write the curvature of the image, and its conic constant."""
    if sensor.get("radius") is None and sensor.get("curvature") is None:
        return ["  CURV 0.0"]
    conic = [f"  {conic_line(sensor, f'{where}: sensor')}"] if sensor.get("conic") else []
    return [f"  {curvature_line(sensor, f'{where}: sensor')}", *conic]


def _system(prescription: Mapping[str, Any], surfaces: Mapping[str, Any], where: str) -> list[str]:
    waves, reference = written_wavelengths(prescription, where)
    weights = prescription.get("wavelength_weights") or [1.0] * len(waves)
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
        _air(prescription, where),
        "GFAC 0 0",
        *catalogue_line(materials, where),
        *(["RAIM 0 2 1 1 0 0 0 0 0"] if prescription.get("real_pupil") else []),
        *_fields(prescription, len(waves), where),
        *(
            f"WAVM {i} {shifted(wave, -3)} {number_text(weight, where)}"
            for i, (wave, weight) in enumerate(zip(waves, weights, strict=False), 1)
        ),
        f"PWAV {reference}",
    ]


def _fields(prescription: Mapping[str, Any], waves: int, where: str) -> list[str]:
    """Write FTYP and the lists of fields; those beyond the twelfth have a line each.

    A file's angles to a finite object are angles at the entrance pupil.
    """
    fields = prescription.get("fields") or {"angles": [[0.0, 0.0]]}
    finite = prescription.get("object_distance") is not None
    kinds = {name: number for number, name in FIELD_KINDS.items()} | {PUPIL_ANGLES: 0}
    kind = next((key for key in fields if key in kinds), None)
    if kind is None:
        raise InputError(f"{where}: fields: give one of {', '.join(kinds)}")
    points = fields[kind]
    if kind == "angles" and finite:
        if any(as_number(x, f"{where}: fields") for point in points for x in point):
            raise InputError(
                f"{where}: a .zmx file cannot hold 'fields.angles' of a finite object (allowed: "
                "heights, pupil_angles)"
            )
        kind = "heights"
    weights = fields.get("weights") or [1.0] * len(points)
    vignetting = fields.get("vignetting") or [{}] * len(points)
    columns = [[point[0] for point in points], [point[1] for point in points], weights]
    columns += [[row.get(name, 0.0) for row in vignetting] for name, *_ in VIGNETTING_OPERANDS]
    texts = [[number_text(value, f"{where}: fields") for value in column] for column in columns]
    operands = ("XFLN", "YFLN", "FWGN", *(operand for _, operand, _ in VIGNETTING_OPERANDS))
    telecentric = int(bool(prescription.get("telecentric_object")))
    lines = [f"FTYP {kinds[kind]} {telecentric} {len(points)} {waves} 0 0 0"]
    lines += [
        f"{operand} {' '.join(column[:_LISTED])}"
        for operand, column in zip(operands, texts, strict=True)
    ]
    return [*lines, *(f"FEFD {' '.join(row)}" for row in list(zip(*texts, strict=True))[_LISTED:])]


def _pupil(prescription: Mapping[str, Any], where: str) -> list[str]:
    for key, form in _PUPILS.items():
        if prescription.get(key) is not None:
            return [form.format(number_text(prescription[key], where))]
    return ["FLOA"]


def _air(prescription: Mapping[str, Any], where: str) -> str:
    if prescription.get("temperature") is None and prescription.get("pressure") is None:
        return "ENVD 20 1 0"
    temperature = number_text(prescription.get("temperature", 20.0), where)
    return f"ENVD {temperature} {number_text(prescription.get('pressure', 1.0), where)} 1"


def _surface(row: Mapping[str, Any], place: str) -> list[str]:
    """Write a surface's block, without its number, stop and distance."""
    shape, gradient = shape_of_row(row, place), gradient_lines(row, place)
    kind, medium = gradient or (shape.type, [])
    lines = [f"  TYPE {kind}"]
    if row.get("note"):
        lines.append(f"  COMM {row['note']}")
    lines += [f"  {line}" for line in shape.write(row, place)]
    if not shape.surface:
        return lines
    medium = glass_line(row.get("material"), place) if gradient is None else medium
    return [*lines, *(f"  {line.strip()}" for line in medium), *aperture_lines(row, place)]
