"""A lens file is converted to another format, and what that changes is said in words.

A format that cannot hold a lens as it is gets the nearest that it can hold, as long as light takes
the same way or nearly: remarks are dropped, glass by catalogue becomes nd and Vd, another model of
indices is taken.  Each of these is listed.  Shapes, poses and apertures are never changed: a format
that cannot hold them is refused.
"""

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import PurePath
from typing import Any

import torch

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.materials import index_model as find_index_model
from dolens.prescriptions.build import lens_from_prescription
from dolens.prescriptions.compare import Difference, differences
from dolens.prescriptions.files import decode_prescription, encode_prescription
from dolens.prescriptions.media import canonical_digits
from dolens.prescriptions.simplifications import (
    SIMPLIFICATIONS,
    Prescription,
    compared_wavelengths,
    of_other_program,
    surfaces_text,
)


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
                f", which a {PurePath(new).suffix} file always has" if of_other_program(new) else ""
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
            where = f"{surfaces_text([place.partition(' ')[2] for place in places])}: "
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
    return [[float(m.index(wave)) for wave in compared_wavelengths(m)] for m in media]


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
