"""A written lens file is read again and compared with its prescription."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from dolens.errors import InputError
from dolens.prescriptions.checks import as_number
from dolens.prescriptions.deflections import power_of

_DEFAULTS = {"index_model": "dfc", "stop": 1, "object_material": "air"}


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
