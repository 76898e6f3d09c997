"""What a lens file holds changes what its lens computes, or is refused, or listed as passed over.

Each key of the rich files is changed, one after the other.  A key that does none of the three is
one that nothing reads, and fails the test, unless it has no optical meaning and is named here.
"""

import json
import re
from pathlib import Path

import pytest

from dolens import load_lens
from dolens.errors import InputError
from dolens.optics.elements import POSE
from dolens.optics.fields import Vignetting
from dolens.optics.surfaces import PHASES, SURFACES
from dolens.prescriptions.apertures import _BLOCKING, _OUTLINES
from dolens.prescriptions.build import (
    _LENS_KEYS,
    _SURFACE_KEYS,
    lens_from_prescription,
    prescription_of,
)
from dolens.prescriptions.lens_formats import read_json, read_lens
from dolens.prescriptions.other_programs import ReadPrescription
from dolens.prescriptions.plain_values import plain_values
from dolens.prescriptions.row_data import SENSOR_KEYS
from dolens.prescriptions.system_data import _FIELD_KINDS
from tests.prescriptions.judged_keys import (
    changed_data,
    changed_text,
    judge,
    leaves,
    text_with_commas,
)

FILES = Path(__file__).parent / "rich_files"
PEERS = Path(__file__).parent / "peer_files"

# Places of prescriptions without optical meaning, with dots between the keys.
YAML_NAMED = (
    # Names, and numbers that a source prints beside a lens.
    r"name|source|surfaces\.\d+\.note",
    r"(states\.\w+\.)?published\..*",
    # The outermost knot of a spline bounds none of its pieces.
    r"surfaces\.\d+\.knots_[xy]\.7",
    # It says where the image of the stop is, which is checked.
    r"telecentric_object",
    # The share of light in a grating's order scales an image, and moves no ray.
    r"surfaces\.\d+\.phase\.efficiency",
)
# Lines of .zmx, with the number of the word behind #.
ZEMAX_NAMED = (
    # Settings of the program: its version, units of other analyses, files that it uses.
    r"(VERS|PFIL|LANG|SDMA|OMMA|ROPD|HYPR|PICB|GLRS|GSTD|NSCD|COFN) .*",
    r"UNIT .* #[2-7]",
    # Names, remarks, and numbers for drawing.
    r"(NAME|NOTE|COMM|SLAB|MEMA) .*",
    r"UDAD 0 .* #2|UDAD [1-9] .* #1",
    # nd and Vd beside the name of a glass: the name decides, and the log says where they differ.
    r"GLAS [A-Z].* #[2456]",
    r"GLAS ___BLANK .* #1",
    # Where the pupil or another aperture sizes a surface, DIAM draws it, and FLAP follows DIAM.
    r"DIAM (0|0.8|2|3|6.5|7.5|8.2) .* #1|DIAM .* #2|FLAP .* #2",
    # A gap behind the image.
    r"DISZ 0 #1",
    # Lists are filled up beyond the numbers of fields and wavelengths that FTYP gives.
    r"(XFLN|YFLN|FWGN|VDXN|VDYN|VCXN|VCYN|VANN) .* #([4-9]|1[0-2])",
    r"WAVM 4 .*|FTYP .* #4",
    # Any order but 0 is the same, and the status says that the numbers are as they are.
    r"SCBD 1 .* #3|SCBD 2 .* #[23]|PARM 6 1 #2",
    # A scale of pick-ups, which older programs write as 1.
    r"THIC .* #9",
    # Zeros, and a count of terms of which the last is not given.
    r"PARM 2 0 #1|XDAT 1 2 .* #2",
    # Nothing is switched on: no tolerances, and one configuration; of two, the current one stands
    # in the surfaces.
    r"TOL TOFF .*|(MNUM|MOFF) .*|[A-Z]+ +[0-9] +1 .* #2",
)
CODEV_NAMED = (
    # Remarks and names.
    r"(!|RDM;LEN|TITLE|INI|UID|SLB) .*",
    # Any word that begins with N says no.
    r"RDM N .*",
    # What RDY and THI say afterwards counts.
    r"S     0.0 -1.0 #[12]",
)
OSLO_NAMED = (
    # Remarks, names, and counts.
    r"(//|LEN NEW|NXT|END|SNO1) .*",
    # Where the beam sizes the stop, its aperture draws it, or is larger; so does the object's.
    r"AP   3.6e\+19 .*|AP   3.86 .*|AP CHK 1.0 .*",
    # The target of a solve, whose result is written.
    r"PY .*",
)
JSON_NAMED = (
    # Names, and classes of a program's own objects.
    r"info|name|.*\.title|.*__instance_type__.*",
    # It is compared with the focal length of the surfaces, and refused where it is 5 % off.
    r"foclen",
    # The direction of an axis has no length.
    r"surfaces\.\d+\.vec_local\.2",
    # The only surface of type Aperture is the stop without it.
    r"surfaces\.2\.is_aperture",
    # Where the beam sizes the stop, and is smaller.
    r"surface_group\.surfaces\.1\.aperture\.r_max",
    r".*\.ifcs\.1\..*\.clear_apertures\.0\.attributes\.radius",
)
YAMLS = ("shapes", "system", "apertures", "far", "telecentric", "beyond")
TEXTS = {
    "system.zmx": ZEMAX_NAMED,
    "configurations.zmx": ZEMAX_NAMED,
    "axes.zmx": ZEMAX_NAMED,
    "system.seq": CODEV_NAMED,
    "axes.seq": CODEV_NAMED,
    "system.len": OSLO_NAMED,
    "near.len": OSLO_NAMED,
}
# Lines whose entry in the list has other words.
SAID_OTHERWISE = {"TOL": "tolerances", "EFFL": "the merit function"}


def name_of(place):
    if isinstance(place[0], str) and len(place) == 3 and " " in place[0]:
        return f"{place[0]} #{place[1]}"
    return ".".join(map(str, place))


def is_named_by(patterns):
    return lambda place: any(re.fullmatch(pattern, name_of(place)) for pattern in patterns)


def line_is_listed(place, listed):
    """Of .zmx the operand, of others a command in the line, but `CIR` has more uses than one."""
    words = re.findall(r"[A-Z][A-Z0-9]+", place[0])
    words = [SAID_OTHERWISE.get(word, word) for word in words if word != "CIR"]
    return any(re.search(rf"\b({'|'.join(words) or '-'})\b", entry) for entry in listed)


def key_is_listed(place, listed):
    named = ".".join(key for key in place if isinstance(key, str) and key != "attributes")
    return any(
        f"{named}.".startswith(f"{path}.") for path in (entry.strip("'") for entry in listed)
    )


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("name", YAMLS)
def test_each_key_of_yaml(name):
    content = plain_values((FILES / f"{name}.yaml").read_text(), name)
    verdict = judge(
        content,
        changed_data(content),
        lambda changed: ReadPrescription(changed, []),
        is_named_by(YAML_NAMED),
        lambda place, listed: False,
    )
    assert verdict.missed == []
    assert len(verdict.used) > 15


def test_the_files_have_every_key_and_type():
    """Of prescriptions: what a later key or shape needs is a line in one of them."""
    texts = "".join((FILES / f"{name}.yaml").read_text() for name in YAMLS)
    words = set(re.findall(r"\w+", texts))
    keys = {*_LENS_KEYS, *_SURFACE_KEYS, *SENSOR_KEYS, *SURFACES, *PHASES, *Vignetting._fields}
    keys |= {*POSE, "pivot", *_FIELD_KINDS, "weights", "vignetting", "order", "efficiency"}
    keys |= {key for table in (_OUTLINES, _BLOCKING) for names, _ in table for key in names}
    assert keys - words == set()


@pytest.mark.parametrize("name", TEXTS)
def test_each_word_of_a_text(name):
    text = (FILES / name).read_text()
    verdict = judge(
        text,
        changed_text(text),
        lambda changed: read_lens(changed.encode(), name),
        is_named_by(TEXTS[name]),
        line_is_listed,
    )
    assert verdict.missed == []
    for place, changed in text_with_commas(text):
        if place in verdict.used:
            with pytest.raises(InputError, match="decimal comma"):
                read_lens(changed.encode(), name)


@pytest.mark.parametrize(
    "name", ["optiland_rich.json", "ray_optics_rich.roa", "deeplens_rich.json"]
)
def test_each_key_of_another_program(name):
    content = json.loads((PEERS / name).read_text())
    verdict = judge(
        content,
        changed_data(content),
        lambda changed: read_json(json.dumps(changed), name),
        is_named_by(JSON_NAMED),
        key_is_listed,
    )
    assert verdict.missed == []
    assert len(verdict.used) > 30


def test_what_is_named_is_there():
    """An expression that no key matches any more names nothing."""
    texts = {name: (FILES / name).read_text() for name in TEXTS}
    places = {id(YAML_NAMED): [], id(JSON_NAMED): []}
    for name, text in texts.items():
        found = places.setdefault(id(TEXTS[name]), [])
        found += [place for place, _ in changed_text(text)]
    for file in FILES.glob("*.yaml"):
        found = plain_values(file.read_text(), file.name)
        places[id(YAML_NAMED)] += [place for place, _ in leaves(found)]
    for name in ("optiland_rich.json", "ray_optics_rich.roa", "deeplens_rich.json"):
        found = json.loads((PEERS / name).read_text())
        places[id(JSON_NAMED)] += [place for place, _ in leaves(found)]
    for patterns in (YAML_NAMED, ZEMAX_NAMED, CODEV_NAMED, OSLO_NAMED, JSON_NAMED):
        for pattern in patterns:
            for one in pattern.split("|") if "(" not in pattern else [pattern]:
                assert any(is_named_by([one])(place) for place in places[id(patterns)]), one


def test_a_key_that_nothing_reads_is_found():
    """Of a reader that forgets the weights of wavelengths."""
    content = plain_values((FILES / "system.yaml").read_text(), "system")
    weights = {"wavelength_weights": content.pop("wavelength_weights"), "lens": content}
    verdict = judge(
        weights,
        ((place, c) for place, c in changed_data(weights) if place[0] != "lens"),
        lambda changed: ReadPrescription(changed["lens"], []),
        lambda place: False,
        lambda place, listed: False,
    )
    assert verdict.missed == [("wavelength_weights", n) for n in range(3)]


@pytest.mark.parametrize("name", YAMLS)
def test_a_decimal_comma_in_yaml_is_named(name):
    content = plain_values((FILES / f"{name}.yaml").read_text(), name)
    for place, value in list(leaves(content)):
        if isinstance(value, float) and not is_named_by(YAML_NAMED)(place):
            inside = content
            for key in place[:-1]:
                inside = inside[key]
            inside[place[-1]] = f"{value}".replace(".", ",") if "e" not in f"{value}" else "1,5"
            with pytest.raises(InputError, match="decimal comma"):
                lens_from_prescription(content)
            inside[place[-1]] = value


def test_a_mirror_of_optiland_reflects():
    """Optiland 0.6 says so in the interaction of the surface."""
    surfaces = prescription_of(load_lens(PEERS / "optiland_mirror.json"))["surfaces"]
    assert surfaces["2"]["material"] == "mirror"


def test_an_ideal_lens_of_optiland_has_its_focal_length():
    rows = prescription_of(load_lens(PEERS / "optiland_thin_lens.json"))["surfaces"]
    assert rows["2"]["type"] == "paraxial_lens"
    assert rows["2"]["focal_length"] == 50.0


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("phase", "PhaseInteractionModel"),
        ("grating", "DiffractiveInteractionModel"),
        ("grating2", "DiffractiveInteractionModel"),
        ("tilt", "tilted"),
        ("zernike", "shape 'Zernike"),
        ("toroidal", "shape 'Toroidal"),
    ],
)
def test_what_bends_light_otherwise_is_refused(name, says):
    with pytest.raises(InputError, match=says):
        load_lens(PEERS / f"optiland_{name}.json")


@pytest.mark.parametrize("key", ["coating", "bsdf"])
def test_coatings_and_scatter_are_listed(key):
    listed = read_json((PEERS / f"optiland_{key}.json").read_text(), "lens").passed_over
    assert any(key in entry for entry in listed)
