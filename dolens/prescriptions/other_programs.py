"""Readers and writers of other programs' lens files share what is here."""

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

from dolens.errors import InputError
from dolens.prescriptions.numbers import as_number, nearest, number_in_text, power_of, scaled

ALWAYS = "always"
# Coefficients of rotational powers, Forbes's and Zernike's polynomials, phases, and monomials.
_TERM = re.compile(r"[apqz]\d+|(?=[xy])(x\d*)?(y\d*)?")
# The wavelength (nm) of a file that cannot do without one.
D_LINE = 587.5618
_DEFAULTS = {"index_model": "dfc", "stop": 1, "object_material": "air"}


class ReadPrescription(NamedTuple):
    """A `ReadPrescription` is the content of a lens file as plain data.

    Attributes:
        prescription: as `lens_from_prescription` takes it.
        passed_over: what the file says that bends no ray and is not held, in words, such as
            `coatings (COAT)`; nothing that changes a ray's way is among it.
    """

    prescription: Any
    passed_over: list[str]


class Number(NamedTuple):
    """A `Number` is what stands in one slot of a file: a key of a surface's row, and its unit.

    Tables of them, slot → number, drive readers and writers: `{"PARM 2": Number("a4", -3)}` is the
    coefficient of r⁴, in units of a length to the power of -3, behind the words `PARM 2`.

    Attributes:
        key: in a prescription's row.
        power: of the file's unit of length; the row has mm to that power.
        rule: which texts count: "" all but zeros that nobody named, `ALWAYS` a number that every
            surface has, or another rule of the format's own.
        default: what the row means where it does not have the key; None where it must.
        shift: of the decimal point, from the file to the row.
    """

    key: str
    power: int = 0
    rule: str = ""
    default: float | None = None
    shift: int = 0


Table = Mapping[str, Number]


def powers_of_r(slots: Iterable[str], powers: Iterable[int]) -> dict[str, Number]:
    """Return the slots of the coefficients of powers of r."""
    return {slot: Number(f"a{n}", 1 - n) for slot, n in zip(slots, powers, strict=True)}


def monomials(degree: int) -> dict[str, int]:
    """Return the monomials of x and y, and the degree of each, in the order that programs number
    them in: x, y, x2, xy, y2, ...

    Args:
        degree: the highest.
    """

    def power(letter: str, n: int) -> str:
        return f"{letter}{n if n > 1 else ''}" if n else ""

    degrees = range(1, degree + 1)
    return {power("x", d - j) + power("y", j): d for d in degrees for j in range(d + 1)}


def row_numbers(
    table: Table,
    words: Mapping[str, str],
    factor: Fraction,
    place: str,
    counts: Callable[[str], bool] = bool,
    divided: Mapping[str, Fraction] | None = None,
) -> dict[str, float]:
    """Return the numbers of a surface's row that a file has in its slots, in mm.

    Args:
        table: of the slots.
        words: slot → number as it is written; what is missing counts as 0 where there is a rule.
        factor: mm in a unit of the file.
        place: name of the surface in messages.
        counts: whether a text says anything where there is no rule: no zero that nobody named.
        divided: slot → radius, in the file's unit, of terms that are lengths, of coordinates
            divided by that radius.

    Raises:
        InputError: a text is no number, or one out of range.
    """
    found: dict[str, float] = {}
    exact: dict[str, Fraction] = {}
    for slot, number in table.items():
        what = f"{place}: {slot}"
        word = words.get(slot, "0" if number.rule else None)
        if word is None:
            continue
        number_in_text(word, what)
        if not (number.rule or counts(word)):
            continue
        unit = factor**number.power * Fraction(10) ** number.shift
        if divided and slot in divided:
            unit /= divided[slot] ** (1 - number.power)
        value = scaled(word, unit, what)
        if number.key in exact:
            # A coefficient in two slots.
            value = nearest(exact[number.key] + Fraction(word) * unit, what)
        elif value:
            exact[number.key] = Fraction(word) * unit
        found[number.key] = value
    return found


def slot_values(
    table: Table, row: Mapping[str, Any], place: str, suffix: str, what: str = ""
) -> dict[str, float]:
    """Return slot → number of what a row has, for a writer: coefficients in their order in the row,
    and then the others; lengths are in mm.

    Args:
        table: of the slots.
        row: of a surface, or its phase.
        place: name of the surface in messages.
        suffix: of the format, for messages.
        what: kind of surface in messages, where the same key is held of others.

    Raises:
        InputError: the row has a coefficient without a slot, or lacks what it must have.
    """
    slots = {number.key: slot for slot, number in table.items()}
    given = [key for key in row if _TERM.fullmatch(key)]
    for key in given:
        if key not in slots:
            held = [name for name in slots if _TERM.fullmatch(name)] or ["none"]
            first = "x, y" if held[0] == "x" else held[0]
            allowed = f"{first} to {held[-1]}" if len(held) > 1 else first
            raise InputError(
                f"{place}: a {suffix} file cannot hold '{key}'{what} (allowed: {allowed})"
            )
    found = {}
    for key in dict.fromkeys((*given, *slots)):
        number = table[slots[key]]
        if key in row or number.rule:
            found[slots[key]] = as_number(row.get(key, number.default), f"{place}: '{key}'")
    return found


def require_dfc(prescription: Mapping[str, Any], suffix: str, where: str) -> None:
    """Refuse to write a lens whose indices other programs' files cannot mean."""
    model = str(prescription.get("index_model", "dfc"))
    if model != "dfc":
        raise InputError(
            f"{where}: a {suffix} file cannot hold index_model '{model}' (allowed: dfc; its nd and "
            "Vd are those of the lines C, d, F, and its air has index 1)"
        )


def written_wavelengths(prescription: Mapping[str, Any], where: str) -> tuple[list[float], int]:
    """Return the wavelengths (nm) that a file gets, and the number of the reference from 1.

    Raises:
        InputError: the reference is none of them.
    """
    waves = prescription.get("wavelengths") or [D_LINE]
    waves = [as_number(wave, f"{where}: 'wavelengths'") for wave in waves]
    reference = float(prescription.get("reference_wavelength") or waves[0])
    if reference not in waves:
        raise InputError(f"{where}: 'reference_wavelength' {reference!r} is none of 'wavelengths'")
    return waves, waves.index(reference) + 1


def require_same(
    wanted: Mapping[str, Any],
    found: Mapping[str, Any],
    kind: str,
    where: str,
    medium: Callable[[str], str] = str,
    assumed: tuple[str, ...] = (),
) -> None:
    """Raise `InputError` where a file would not give back the prescription.

    Numbers must agree to the last bit, a radius through its curvature.  A key that the format's
    writer does not know is missing from what comes back, so it is refused here and never lost.

    Args:
        wanted: the prescription to be written.
        found: the same, read again from what would be written.
        kind: name of the format in messages, for example `.zmx`.
        where: name of the prescription in messages.
        medium: names that mean the same medium in this format become one.
        assumed: keys that the format never leaves out; allowed to appear where none was wanted.

    Raises:
        InputError: one line that names the surface and key which the format cannot hold.
    """
    before, after = _flat(wanted, medium), _flat(found, medium)
    for key, value in before.items():
        if key not in after or after[key] != value:
            back = f" (it would come back as {after[key]!r})" if key in after else ""
            shown = "" if isinstance(value, list | dict) else f" {value!r}"
            place = "".join(f"{part}: " for part in key[:-1])
            raise InputError(f"{where}: {place}a {kind} file cannot hold '{key[-1]}'{shown}{back}")
    for key in after:
        if key not in before and key[0] not in assumed:
            place = "".join(f"{part}: " for part in key[:-1])
            raise InputError(f"{where}: {place}a {kind} file always has '{key[-1]}'; give it")


class Difference(NamedTuple):
    """A `Difference` is a key of a prescription that another one lacks, adds or says otherwise.

    Attributes:
        place: (`surface 3`,), (`sensor`,) or () for the lens.
        key: as a prescription writes it.
        before: None where the first prescription has no such key.
        after: None where the second has none.
    """

    place: tuple[str, ...]
    key: str
    before: Any
    after: Any


def differences(
    before: Mapping[str, Any], after: Mapping[str, Any], medium: Callable[[str], str] = str
) -> list[Difference]:
    """Return the keys in which two prescriptions differ, in the order of the first.

    Numbers must agree to the last bit, a radius through its curvature; what both leave to a default
    is the same.

    Args:
        before: a prescription.
        after: another one.
        medium: names that mean the same medium become one.
    """
    first, second = _flat(before, medium), _flat(after, medium)
    return [
        Difference(key[:-1], key[-1], first.get(key), second.get(key))
        for key in dict.fromkeys((*first, *second))
        if first.get(key) != second.get(key)
    ]


def _flat(prescription: Mapping[str, Any], medium: Callable[[str], str]) -> dict[tuple, Any]:
    flat: dict[tuple, Any] = {(key,): value for key, value in _DEFAULTS.items()}
    for key, value in prescription.items():
        if key == "surfaces":
            for n, row in value.items():
                flat.update(
                    ((f"surface {n}", k), v) for k, v in _row({"type": "sphere"} | {**row}).items()
                )
        elif key == "sensor":
            flat.update(((key, k), v) for k, v in _sensor(value).items())
        elif key == "fields" and isinstance(value, Mapping):
            flat[(key,)] = _fields(value)
        elif value is not None and value not in ({}, [], ""):
            flat[(key,)] = _plain(value)
    if ("wavelengths",) in flat:
        flat.setdefault(("reference_wavelength",), flat[("wavelengths",)][0])
    # A constant index is a number in YAML and a name in a lens.
    return {k: medium(str(v)) if "material" in k[-1] else v for k, v in flat.items()}


def _sensor(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sensor; a plane one has neither curvature nor conic constant."""
    plain = _row({"type": "conic"} | {**row})
    if not plain.get("curvature"):
        plain = {key: value for key, value in plain.items() if key not in ("curvature", "conic")}
    if not plain.get("conic"):
        plain.pop("conic", None)
    del plain["type"]
    return plain


def _fields(value: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields; numbers of the vignetting that are zero may be left out."""
    plain = {str(key): _plain(entry) for key, entry in value.items() if key != "vignetting"}
    cut = [{key: v for key, v in row.items() if v} for row in _plain(value.get("vignetting") or [])]
    return plain | ({"vignetting": cut} if any(cut) else {})


def _row(row: Mapping[str, Any]) -> dict[str, Any]:
    plain = {key: _plain(value) for key, value in row.items() if value is not None}
    for key in ("radius", "radius_x", "radius_y"):
        if key in plain:
            radius = as_number(plain.pop(key), f"'{key}'", finite=False)
            if plain["type"] not in ("plane", "aperture"):
                plain[key.replace("radius", "curvature")] = 1.0 / radius
    if "focal_length" in plain:
        plain["power"] = power_of(plain.pop("focal_length"))
    return plain


def _plain(value: Any) -> Any:
    """Return numbers as floats, so that 25 and 25.0 are the same; rows as lists."""
    if isinstance(value, bool) or value is None:
        return value
    if isinstance(value, int | float):
        return float(value)
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    # YAML 1.1 reads 1e-6, without a point, as text; so does the builder of a lens read it.
    try:
        return as_number(str(value), "")
    except InputError:
        return str(value)


def curved_object(
    prescription: Mapping[str, Any], shape: Mapping[str, Any], place: str
) -> list[str]:
    """Return a sentence about the curvature of an object, for the list of what is passed over;
    nothing of a plane one.

    Args:
        prescription: with the fields and `object_distance` of its file.
        shape: of the object, as a row of a prescription has it.
        place: the object's name in messages.

    Raises:
        InputError: the object is at a finite distance, and fields are off its axis.
    """
    radius = shape.get("radius", math.inf)
    if shape.get("curvature"):
        radius = 1.0 / shape["curvature"]
    departs = any(value for key, value in shape.items() if key[:1] in "ab" and key[1:].isdecimal())
    if math.isinf(radius) and not departs:
        return []
    what = "aspheric" if math.isinf(radius) else f"radius {radius:.6g} mm"
    if prescription.get("object_distance") is not None and not _is_axial(prescription):
        raise InputError(
            f"{place}: a curved object ({what}) is not held for fields off the axis (allowed: a "
            "plane, fields on the axis, or an object at infinity)"
        )
    return [f"the curvature of the object ({what}), of which light meets the vertex alone"]


def _is_axial(prescription: Mapping[str, Any]) -> bool:
    fields = prescription.get("fields") or {}
    kinds = fields.keys() - {"weights", "vignetting"}
    return not any(part for kind in kinds for point in fields[kind] for part in point)


def catalogue_order(
    glasses: Iterable[tuple[str, str]], must_precede: Callable[[str, str, str], bool]
) -> list[str] | None:
    """Return the catalogues in an order where the first that has a name is the one meant.

    Args:
        glasses: catalogue and name of each glass.
        must_precede: whether a catalogue must stand before another one because of a name, which
            the other has as well: called with the catalogue, the name and the other.

    Returns:
        The order, by the alphabet where nothing else decides; None where there is none.
    """
    pairs = list(glasses)
    left = sorted({catalogue for catalogue, _ in pairs})
    before = {
        other: {
            catalogue
            for catalogue, name in pairs
            if catalogue != other and must_precede(catalogue, name, other)
        }
        for other in left
    }
    order: list[str] = []
    while left:
        free = next((c for c in left if before[c].isdisjoint(left)), None)
        if free is None:
            return None
        order.append(free)
        left.remove(free)
    return order


class ParaxialImage(NamedTuple):
    """A `ParaxialImage` is where an axial paraxial ray meets the axis behind the last surface.

    Attributes:
        distance: from the last vertex, mm along z.
        focal_length: of the surfaces for light from infinity, mm.
    """

    distance: float
    focal_length: float


def paraxial_image(
    curvatures: Sequence[float],
    gaps: Sequence[float],
    indices: Sequence[float],
    object_distance: float | None,
    place: str,
) -> ParaxialImage:
    """Trace the paraxial axial ray by n'u' = nu - y·c·(n' - n) and y' = y + t·u'.

    Args:
        curvatures: of the surfaces, 1/mm.
        gaps: behind all surfaces but the last, mm.
        indices: in front of the first surface and behind each; negative where light travels
            towards -z.
        object_distance: in front of the first surface, mm; None for infinity.
        place: name in messages.

    Raises:
        InputError: the light leaves the last surface parallel to the axis, or a number overflows.
    """
    height, reduced = _behind(curvatures, gaps, indices, 1.0, 0.0)
    power = -reduced
    if object_distance is not None:
        start = object_distance / indices[0]
        height, reduced = _behind(curvatures, gaps, indices, start, 1.0)
    if reduced == 0.0:
        raise InputError(f"{place}: the paraxial image is at infinity, and no solve can place it")
    distance = -height * indices[-1] / reduced
    if not math.isfinite(distance):
        raise InputError(f"{place}: numbers are too large to find the paraxial image")
    focal_length = indices[-1] / power if power else math.inf
    return ParaxialImage(distance, focal_length)


def _behind(
    curvatures: Sequence[float],
    gaps: Sequence[float],
    indices: Sequence[float],
    height: float,
    reduced: float,
) -> tuple[float, float]:
    """Return height and n·u of a ray behind the last surface."""
    for i, curvature in enumerate(curvatures):
        before, behind = indices[i], indices[i + 1]
        reduced -= height * curvature * (behind - before)
        if i < len(gaps):
            height += gaps[i] * reduced / behind
    return height, reduced


def image_shape(shape: Mapping[str, Any], place: str) -> dict[str, float]:
    """Return radius and conic constant of a curved image, given its shape as that of a row.

    Raises:
        InputError: it is no plane, sphere or conic.
    """
    if shape["type"] not in ("plane", "sphere", "conic"):
        raise InputError(
            f"{place}: an image of this shape is not held (allowed: a plane, sphere or conic)"
        )
    return {key: shape[key] for key in ("radius", "curvature", "conic") if key in shape}
