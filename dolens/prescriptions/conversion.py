"""A lens file is converted to another format, and what that changes is said in words.

A format that cannot hold a lens as it is gets the nearest that it can hold, as long as light takes
the same way or nearly: remarks are dropped, glass by catalogue becomes nd and Vd, another model of
indices is taken.  Each of these is listed.  Shapes, poses and apertures are never changed: a format
that cannot hold them is refused.
"""

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import torch

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.materials import abbe_number, index_d, parse_material
from dolens.optics.materials import index_model as find_index_model
from dolens.prescriptions.build import lens_from_prescription
from dolens.prescriptions.compare import Difference, differences
from dolens.prescriptions.files import decode_prescription, encode_prescription
from dolens.prescriptions.zemax_glass import canonical

Prescription = dict[str, Any]
# Indices are compared at these wavelengths, nm.
_WAVELENGTHS = (400.0, 450.0, 486.1327, 546.074, 587.5618, 656.2725, 700.0)
_KNOWN_MEDIA = ("air", "occluder")


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
    steps = [step for step in _SIMPLIFICATIONS if step(copy.deepcopy(prescription), new)]
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


def _dfc_indices(prescription: Prescription, new: str) -> list[str]:
    """Take the only index model that a .zmx file knows."""
    model = str(prescription.get("index_model", "dfc"))
    if not _is_zemax(new) or model == "dfc":
        return []
    prescription["index_model"] = "dfc"
    return [
        f"the index model '{model}' became 'dfc', the only one that a .zmx file knows: nd and Vd "
        "are those of the lines C, d and F, and air has index 1"
    ]


def _glass_by_numbers(prescription: Prescription, new: str) -> list[str]:
    """Write glass of a catalogue as nd/Vd."""
    if not new.lower().endswith(".txt"):
        return []
    model = find_index_model(str(prescription.get("index_model", "dfc")))
    said: dict[str, tuple[str, float, list[str]]] = {}
    for n, row in prescription["surfaces"].items():
        name = str(row.get("material")).strip()
        if name.lower() in _KNOWN_MEDIA or name[:1].isdigit():
            continue
        medium = parse_material(name, model)
        pair = f"{index_d(medium):.6f}/{abbe_number(medium):.4f}"
        try:
            near = parse_material(pair, model)
        except InputError:
            continue
        error = max(abs(medium.index(w) - near.index(w)) for w in _WAVELENGTHS)
        said.setdefault(name, (pair, error, []))[2].append(str(n))
        row["material"] = pair
    return [
        f"the glass {name} behind {_surfaces(numbers)} became {pair} (nd/Vd): its index differs by "
        f"up to {error:.1g} from 400 to 700 nm"
        for name, (pair, error, numbers) in said.items()
    ]


def _aperture_planes(prescription: Prescription, new: str) -> list[str]:
    """Write aperture planes as a .zmx file knows them: the stop is one, any other is a plane."""
    if not _is_zemax(new):
        return []
    said = []
    stop = str(prescription.get("stop", 1))
    before = prescription.get("object_material", "air")
    for n, row in prescription["surfaces"].items():
        flat = row.get("type", "sphere") in ("plane", "sphere") and _is_flat(row)
        empty = canonical(str(row.get("material"))) == canonical(str(before))
        before = row.get("material")
        if row.get("type") == "aperture" and str(n) != stop:
            row["type"] = "plane"
            said.append(
                f"surface {n}, an aperture, became a plane of the same size, which clips the same "
                "rays: the one aperture of a .zmx file is the stop"
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
    return [f"lost: {'remarks' if len(noted) > 1 else 'the remark'} on {_surfaces(noted)}"]


def _without_source(prescription: Prescription, new: str) -> list[str]:
    """Drop where the lens comes from."""
    source = prescription.pop("source", None)
    return [f"lost: source {str(source)!r}"] if source else []


def _one_line_name(prescription: Prescription, new: str) -> list[str]:
    """Put a name on one line."""
    name = str(prescription.get("name") or "")
    line = " ".join(name.split())
    if line == name:
        return []
    prescription["name"] = line
    return [f"the name {name!r} became {line!r}"]


_SIMPLIFICATIONS: tuple[Callable[[Prescription, str], list[str]], ...] = (
    _one_line_name,
    _without_notes,
    _without_source,
    _without_poses,
    _aperture_planes,
    _glass_by_numbers,
    _dfc_indices,
)


def _told(difference: Difference, said: list[str]) -> bool:
    """Return whether a simplification has spoken of a difference already."""
    place = " ".join(difference.place)
    words = {
        "name": "the name",
        "note": "remark",
        "source": "lost: source",
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
                ", which a .zmx file always has" if _is_zemax(new) else ""
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
            where = f"{_surfaces([place.partition(' ')[2] for place in places])}: "
        sentences.append(where + what)
    return sentences


def _same_numbers(before: Lens, after: Lens) -> bool:
    first, second = _parameters(before), _parameters(after)
    return (
        first.keys() == second.keys()
        and all(torch.equal(value, second[name]) for name, value in first.items())
        and before.stop == after.stop
        and _indices(before) == _indices(after)
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
    return [[float(m.index(wave)) for wave in _WAVELENGTHS] for m in lens.materials]


@torch.no_grad()
def _effect(before: Lens, after: Lens) -> str:
    """Say what the changes do to the focal length and to the place of the image."""
    wavelength = before.primary_wavelength
    first, second = before.first_order(wavelength), after.first_order(wavelength)
    return (
        f"the focal length at {wavelength:g} nm is {float(second.efl):.6g} mm and was "
        f"{float(first.efl):.6g} mm; the back focal distance is {float(second.bfd):.6g} mm and was "
        f"{float(first.bfd):.6g} mm"
    )


def _is_zemax(path: str) -> bool:
    return path.lower().endswith(".zmx")


def _is_flat(row: Mapping[str, Any]) -> bool:
    if row.get("type") == "plane":
        return True
    if row.get("curvature") is not None:
        return float(row["curvature"]) == 0.0
    return abs(float(row.get("radius", 0.0))) == float("inf")


def _medium_name(material: str) -> str:
    """Return one name for a medium, however it is written."""
    return "occluder" if material.strip().lower() == "occluder" else canonical(material)


def _shown(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_shown(entry)}" for key, entry in value.items())
    return f"{value:.10g}" if isinstance(value, float) else repr(value)


def _surfaces(numbers: list[str]) -> str:
    if len(numbers) == 1:
        return f"surface {numbers[0]}"
    return f"surfaces {', '.join(numbers[:-1])} and {numbers[-1]}"
