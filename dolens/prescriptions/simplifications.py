"""A prescription is simplified for a format that cannot hold it, and what changes is said."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import PurePath
from typing import Any

from dolens.errors import InputError
from dolens.files import without_controls
from dolens.optics.materials import NO_GLASS, Medium, abbe_number, index_d, parse_material
from dolens.optics.materials import index_model as find_index_model
from dolens.prescriptions.codev.glass import glass_word
from dolens.prescriptions.media import canonical

Prescription = dict[str, Any]
# Indices are compared at these wavelengths, nm.
COMPARED_WAVELENGTHS = (400.0, 450.0, 486.1327, 546.074, 587.5618, 656.2725, 700.0)


def _dfc_indices(prescription: Prescription, new: str) -> list[str]:
    """Take the only index model that the files of other programs know."""
    model = str(prescription.get("index_model", "dfc"))
    if not of_other_program(new) or model == "dfc":
        return []
    prescription["index_model"] = "dfc"
    return [
        f"the index model '{model}' became 'dfc', the only one that a {_suffix(new)} file knows: "
        "nd and Vd are those of the lines C, d and F, and air has index 1"
    ]


def _glass_by_numbers(prescription: Prescription, new: str) -> list[str]:
    """Write glass as nd/Vd: of a catalogue for dO's text, which no name of CODE V means for its
    files, where nd has six and Vd four decimals.
    """
    if _suffix(new) not in (".txt", ".seq"):
        return []
    model = find_index_model(str(prescription.get("index_model", "dfc")))
    said: dict[str, tuple[str, float, Sequence[float], list[str]]] = {}
    for n, row in prescription["surfaces"].items():
        name = str(row.get("material")).strip()
        if row.get("material") is None or not _needs_numbers(name, new):
            continue
        medium = parse_material(name, model)
        pair = f"{index_d(medium):.6f}/{abbe_number(medium):.4f}"
        try:
            near = parse_material(pair, model)
        except InputError:
            continue
        waves = compared_wavelengths(medium)
        error = max(abs(float(medium.index(w)) - float(near.index(w))) for w in waves)
        said.setdefault(name, (pair, error, waves, []))[3].append(str(n))
        row["material"] = pair
    return [
        f"the glass {name} behind {surfaces_text(numbers)} became {pair} (nd/Vd): its index "
        f"differs by up to {error:.1g} from {waves[0]:g} to {waves[-1]:g} nm"
        for name, (pair, error, waves, numbers) in said.items()
    ]


def compared_wavelengths(medium: Medium) -> Sequence[float]:
    """Return where the indices of a medium are compared, nm: as far as its data go.

    Args:
        medium: glass of a catalogue has a range; other media are known everywhere.
    """
    shortest, longest = getattr(medium, "wavelengths", (0.0, math.inf))
    inside = [wave for wave in COMPARED_WAVELENGTHS if shortest <= wave <= longest]
    return inside or (shortest, longest)


def _needs_numbers(name: str, new: str) -> bool:
    """Return whether a medium has no name in a format, and needs nd and Vd there."""
    if name.lower() in NO_GLASS or (name[:1].isdigit() and "/" not in name):
        return False
    if _suffix(new) == ".txt":
        # nd/Vd/ΔPgF has a number too many.
        return not name[:1].isdigit() or name.count("/") > 1
    try:
        glass_word(name, new)
    except InputError:
        return True
    return False


def _aperture_planes(prescription: Prescription, new: str) -> list[str]:
    """Write aperture planes as other programs know them: the stop is one, any other is a plane."""
    if not of_other_program(new):
        return []
    said = []
    stop = str(prescription.get("stop", 1))
    before = prescription.get("object_material", "air")
    for n, row in prescription["surfaces"].items():
        flat = row.get("type", "sphere") in ("plane", "sphere") and _is_flat(row)
        flat = flat and row.get("phase") is None
        empty = canonical(str(row.get("material"))) == canonical(str(before))
        # A mirror and a coordinate break leave the medium as it is.
        if str(row.get("material", "mirror")).strip().lower() != "mirror":
            before = row["material"]
        if row.get("type") == "aperture" and str(n) != stop:
            row["type"] = "plane"
            said.append(
                f"surface {n}, an aperture, became a plane of the same size, which clips the same "
                f"rays: the one aperture of a {_suffix(new)} file is the stop"
            )
        elif flat and empty and str(n) == stop:
            row["type"] = "aperture"
            row.pop("radius", None)
            row.pop("curvature", None)
            said.append(f"surface {n}, a plane in one medium, became an aperture: it is the stop")
    return said


def _without_poses(prescription: Prescription, new: str) -> list[str]:
    """Drop elements that stand where they were designed to."""
    elements = prescription.get("elements")
    if not isinstance(elements, Mapping) or not elements:
        return []
    for row in elements.values():
        if any(key not in ("surfaces", "pivot") and float(value) for key, value in row.items()):
            return []
    del prescription["elements"]
    return [f"lost: the names of the elements {', '.join(map(str, elements))} (none has a pose)"]


def _without_notes(prescription: Prescription, new: str) -> list[str]:
    """Drop remarks about surfaces."""
    noted = [str(n) for n, row in prescription["surfaces"].items() if row.pop("note", None)]
    if not noted:
        return []
    return [f"lost: {'remarks' if len(noted) > 1 else 'the remark'} on {surfaces_text(noted)}"]


def _without_source(prescription: Prescription, new: str) -> list[str]:
    """Drop where the lens comes from."""
    source = prescription.pop("source", None)
    return [f"lost: source {str(source)!r}"] if source else []


def _without_published(prescription: Prescription, new: str) -> list[str]:
    """Drop the numbers that the source publishes."""
    states = prescription.get("states") or {}
    found = [part.pop("published", None) for part in (prescription, *states.values()) if part]
    return ["lost: the published numbers"] if any(found) else []


def _without_states(prescription: Prescription, new: str) -> list[str]:
    """Drop the states: the lens itself stays."""
    found = prescription.pop("states", None)
    return [f"lost: the states {', '.join(map(str, found))}"] if found else []


def _one_line_name(prescription: Prescription, new: str) -> list[str]:
    """Put a name on one line, without control characters."""
    name = str(prescription.get("name") or "")
    line = " ".join(without_controls(name).split())
    if line == name:
        return []
    prescription["name"] = line
    return [f"the name {name!r} became {line!r}"]


SIMPLIFICATIONS: tuple[Callable[[Prescription, str], list[str]], ...] = (
    _one_line_name,
    _without_notes,
    _without_source,
    _without_published,
    _without_poses,
    _aperture_planes,
    _glass_by_numbers,
    _dfc_indices,
    _without_states,
)


def of_other_program(path: str) -> bool:
    """Return whether a file is named as one of Zemax or CODE V."""
    return _suffix(path) in (".zmx", ".seq")


def _suffix(path: str) -> str:
    return PurePath(path).suffix.lower()


def _is_flat(row: Mapping[str, Any]) -> bool:
    if row.get("type") == "plane":
        return True
    if row.get("curvature") is not None:
        return float(row["curvature"]) == 0.0
    return abs(float(row.get("radius", 0.0))) == float("inf")


def surfaces_text(numbers: list[str]) -> str:
    """Return `surface 3`, or `surfaces 1, 2 and 3`."""
    if len(numbers) == 1:
        return f"surface {numbers[0]}"
    return f"surfaces {', '.join(numbers[:-1])} and {numbers[-1]}"
