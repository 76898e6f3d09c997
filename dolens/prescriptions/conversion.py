"""A lens file is converted to another format, and what that changes is said in words.

A format that cannot hold a lens as it is gets the nearest that it can hold, as long as light takes
the same way or nearly: remarks are dropped, glass by catalogue becomes nd and Vd, another model of
indices is taken.  Each of these is listed.  Shapes, poses and apertures are never changed: a format
that cannot hold them is refused.
"""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import PurePath
from typing import Any

import torch

from dolens.errors import InputError
from dolens.files import without_controls
from dolens.optics.lens import Lens
from dolens.optics.materials import NO_GLASS, Medium, abbe_number, index_d, parse_material
from dolens.optics.materials import index_model as find_index_model
from dolens.prescriptions.build import lens_from_prescription
from dolens.prescriptions.codev.glass import glass_word
from dolens.prescriptions.files import decode_prescription, encode_prescription
from dolens.prescriptions.other_programs import Difference, differences
from dolens.prescriptions.row_data import canonical, canonical_digits

Prescription = dict[str, Any]
# Indices are compared at these wavelengths, nm.
COMPARED_WAVELENGTHS = (400.0, 450.0, 486.1327, 546.074, 587.5618, 656.2725, 700.0)


def _dfc_indices(prescription: Prescription, new: str) -> list[str]:
    """Take the only index model that the files of other programs know."""
    model = str(prescription.get("index_model", "dfc"))
    if not _of_other_program(new) or model == "dfc":
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
        waves = _compared_wavelengths(medium)
        error = max(abs(float(medium.index(w)) - float(near.index(w))) for w in waves)
        said.setdefault(name, (pair, error, waves, []))[3].append(str(n))
        row["material"] = pair
    return [
        f"the glass {name} behind {_surfaces_text(numbers)} became {pair} (nd/Vd): its index "
        f"differs by up to {error:.1g} from {waves[0]:g} to {waves[-1]:g} nm"
        for name, (pair, error, waves, numbers) in said.items()
    ]


def _compared_wavelengths(medium: Medium) -> Sequence[float]:
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
    if not _of_other_program(new):
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
    return [f"lost: {'remarks' if len(noted) > 1 else 'the remark'} on {_surfaces_text(noted)}"]


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


def _of_other_program(path: str) -> bool:
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


def _surfaces_text(numbers: list[str]) -> str:
    """Return `surface 3`, or `surfaces 1, 2 and 3`."""
    if len(numbers) == 1:
        return f"surface {numbers[0]}"
    return f"surfaces {', '.join(numbers[:-1])} and {numbers[-1]}"


@dataclass(frozen=True)
class Conversion:
    """A `Conversion` holds a lens file in another format, not yet written.

    Attributes:
        data: what the new file holds.
        changes: what it says otherwise than the old one, a sentence each; empty where a lens read
            from it is the same in every key.
        same_numbers: whether both files give lenses with the same parameters and media, to the
            last bit.
        before: the lens of the old file.
        after: the lens of the new one.
    """

    data: bytes
    changes: list[str]
    same_numbers: bool
    before: Lens
    after: Lens


def converted(
    prescription: Mapping[str, Any], old: str, new: str, index_model: str | None = None
) -> Conversion:
    """Convert a prescription into the format that the new file's suffix names.

    Args:
        prescription: as `load_prescription` reads it from the old file.
        old: the old file, for messages.
        new: the new file.
        index_model: dfc, do or paper, which the new file gets instead of the old one's.

    Raises:
        InputError: the prescription is no lens, or the format cannot hold it; the message is one
            line that names the surface and key.
    """
    before = lens_from_prescription(prescription, where=old)
    wanted = dict(prescription)
    if index_model is not None:
        wanted["index_model"] = find_index_model(index_model).name
    written, said = _nearest(wanted, new)
    data = encode_prescription(written, new)
    back = decode_prescription(data, new)
    after = lens_from_prescription(back, where=new)
    found = differences(prescription, back, _medium_name)
    changes = [*said, *_sentences([d for d in found if not _told(d, said)], new)]
    same = _same_numbers(before, after)
    if not same:
        changes.append(_effect(before, after))
    return Conversion(data, changes, same, before, after)


def _nearest(prescription: Prescription, new: str) -> tuple[Prescription, list[str]]:
    """Return the prescription with as few simplifications as the format needs, and what they
    say.
    """
    try:
        encode_prescription(prescription, new)
        return prescription, []
    except InputError as error:
        refusal = error
    steps = [step for step in SIMPLIFICATIONS if step(copy.deepcopy(prescription), new)]
    for count in range(1, len(steps) + 1):
        for some in combinations(steps, count):
            simpler = copy.deepcopy(prescription)
            said = [sentence for step in some for sentence in step(simpler, new)]
            try:
                encode_prescription(simpler, new)
            except InputError as error:
                if count == len(steps):
                    refusal = error
            else:
                return simpler, said
    raise refusal


def _told(difference: Difference, said: list[str]) -> bool:
    """Return whether a simplification has spoken of a difference already."""
    place = " ".join(difference.place)
    words = {
        "name": "the name",
        "note": "remark",
        "source": "lost: source",
        "published": "lost: the published numbers",
        "states": "lost: the states",
        "elements": "lost: the names",
        "index_model": "the index model",
        "material": "the glass",
        "type": f"{place}, a",
    }
    begin = words.get(difference.key)
    return begin is not None and any(begin in sentence for sentence in said)


def _sentences(found: list[Difference], new: str) -> list[str]:
    """Say differences in words; the same one at several surfaces takes one sentence."""
    groups: dict[tuple[str, str], list[str]] = {}
    for place, key, before, after in found:
        if before is None:
            what = f"added: {key} {_shown(after)}" + (
                f", which a {PurePath(new).suffix} file always has"
                if _of_other_program(new)
                else ""
            )
        elif after is None:
            what = f"lost: {key} {_shown(before)}"
        else:
            what = f"{key} {_shown(before)} became {_shown(after)}"
        groups.setdefault((what, place[0].partition(" ")[0] if place else ""), []).append(
            " ".join(place)
        )
    sentences = []
    for (what, kind), places in groups.items():
        where = {"": "", "sensor": "sensor: "}.get(kind)
        if where is None:
            where = f"{_surfaces_text([place.partition(' ')[2] for place in places])}: "
        sentences.append(where + what)
    return sentences


def _same_numbers(before: Lens, after: Lens) -> bool:
    first, second = _parameters(before), _parameters(after)
    return (
        first.keys() == second.keys()
        and all(torch.equal(value, second[name]) for name, value in first.items())
        and before.stop == after.stop
        and _indices(before) == _indices(after)
        and before.system().mirrors == after.system().mirrors
        and [s.aperture for s in before.surfaces.values()]
        == [s.aperture for s in after.surfaces.values()]
    )


def _parameters(lens: Lens) -> dict[str, torch.Tensor]:
    """Return the parameters, but for those of a pose that are zero: they move nothing."""
    return {
        name: value
        for name, value in lens.named_parameters()
        if not name.startswith("elements.") or float(value.detach()) != 0.0
    }


def _indices(lens: Lens) -> list[list[float]]:
    media = lens.system().materials
    return [[float(m.index(wave)) for wave in _compared_wavelengths(m)] for m in media]


@torch.no_grad()
def _effect(before: Lens, after: Lens) -> str:
    """Say what the changes do to the focal length and to the place of the image."""
    wavelength = before.primary_wavelength
    first, second = (lens.first_order(wavelength, meridian="y") for lens in (before, after))
    return (
        f"the focal length at {wavelength:g} nm is {float(second.efl):.6g} mm and was "
        f"{float(first.efl):.6g} mm; the back focal distance is {float(second.bfd):.6g} mm and was "
        f"{float(first.bfd):.6g} mm"
    )


def _medium_name(material: str) -> str:
    """Return one name for a medium, however it is written."""
    if material.strip().lower() == "occluder":
        return "occluder"
    return canonical_digits(material)


def _shown(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_shown(entry)}" for key, entry in value.items())
    return f"{value:.10g}" if isinstance(value, float) else repr(value)
