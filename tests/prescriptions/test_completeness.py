"""What a lens file holds changes what its lens computes, or is refused, or listed as passed over.

Each key of the rich files is changed, one after the other.  A key that does none of the three is
one that nothing reads, and fails the test, unless it has no optical meaning and is named here.
"""

import json
import re
from pathlib import Path

import pytest

from dolens.prescriptions.json_lenses import read_json
from dolens.prescriptions.lens_formats import read_lens
from dolens.prescriptions.yaml_text import plain_values
from dolens.prescriptions.read_file import ReadPrescription
from tests.prescriptions.judged_keys import Verdict, changed_data, changed_text, judge

FILES = Path(__file__).parent / "rich_files"
PEERS = Path(__file__).parent / "peer_files"


def named_by(patterns):
    """Return what tells whether one of some expressions matches a place, and those that did."""
    matched = set()

    def is_named(place):
        text = (
            place[0] + f" #{place[1]}"
            if isinstance(place[0], str)
            and len(place) == 3
            and isinstance(place[1], int)
            and isinstance(place[2], str)
            else ".".join(map(str, place))
        )
        found = [pattern for pattern in patterns if re.fullmatch(pattern, text)]
        matched.update(found)
        return bool(found)

    return is_named, matched


def require_complete(verdict: Verdict, patterns, matched):
    assert verdict.missed == []
    assert matched == set(patterns), "a key that is named is not there"


# Keys of a prescription without optical meaning: names, and numbers that are printed beside a lens.
YAML_NAMED = (
    r"(states\.\w+\.)?published\..*",
    r"name|source|surfaces\.\d+\.note",
    # The outermost knot of a spline bounds none of its pieces.
    r"surfaces\.\d+\.knots_[xy]\.7",
    # The share of light in a grating's order scales an image, and moves no ray.
    r"surfaces\.\d+\.phase\.efficiency",
)


@pytest.mark.parametrize("name", ["shapes", "system", "apertures"])
def test_each_key_of_yaml(name):
    content = plain_values((FILES / f"{name}.yaml").read_text(), name)
    is_named, _ = named_by(YAML_NAMED)
    verdict = judge(
        content,
        changed_data(content),
        lambda changed: ReadPrescription(json.loads(json.dumps(changed)), []),
        is_named,
        lambda place, listed: False,
    )
    print(name, {k: len(v) for k, v in vars(verdict).items()})
    assert verdict.missed == []


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
    r"SCBD 1 .* #3|SCBD 2 .* #[23]",
    # Nothing is switched on: no tolerances, and one configuration; of two, the current one stands
    # in the surfaces.
    r"TOL TOFF .*|(MNUM|MOFF) .*|[A-Z]+ +[0-9] +1 .* #2",
)


def zemax_listed(place, listed):
    operand = place[0].split()[0]
    words = {"TOL": "tolerances", "EFFL": "the merit function"}
    return any(re.search(rf"\b{words.get(operand, operand)}\b", entry) for entry in listed)


def require_complete_text(name, patterns, is_listed):
    text = (FILES / name).read_text()
    verdict = judge(
        text,
        changed_text(text),
        lambda changed: read_lens(changed.encode(), Path(name)),
        named_by(patterns)[0],
        is_listed,
    )
    print(name, {k: len(v) for k, v in vars(verdict).items()})
    assert verdict.missed == []


@pytest.mark.parametrize("name", ["system.zmx", "configurations.zmx", "axes.zmx"])
def test_each_number_of_zmx(name):
    require_complete_text(name, ZEMAX_NAMED, zemax_listed)


# Lines of .seq and .len without optical meaning: names, remarks, counts.
CODEV_NAMED = (
    r"(!|RDM;LEN|TITLE|INI|UID|SLB) .*",
    # Any word that begins with N says no.
    r"RDM N .*",
    # What RDY and THI say afterwards counts.
    r"S     0.0 -1.0 #[12]",
)
OSLO_NAMED = (
    r"(//|LEN NEW|NXT|END|SNO1) .*",
    # Where the beam sizes the stop, its aperture draws it, or is larger; so does the object's.
    r"AP   3.6e\+19 .*|AP   3.86 .*|AP CHK 1.0 .*",
    # The target of a solve, whose result is written.
    r"PY .*",
)


def word_listed(place, listed):
    words = [word for word in re.findall(r"[A-Z][A-Z0-9]+", place[0]) if word != "CIR"]
    return any(re.search(rf"\b({'|'.join(words) or '-'})\b", entry) for entry in listed)


@pytest.mark.parametrize("name", ["system.seq", "axes.seq", "system.len", "near.len"])
def test_each_word_of_code_v_and_oslo(name):
    require_complete_text(name, CODEV_NAMED if name.endswith(".seq") else OSLO_NAMED, word_listed)


# Of JSON by other programs: classes of a program's own objects, versions, names.
JSON_NAMED = (
    r".*__instance_type__.*",
    # It is compared with the focal length of the surfaces: five per cent more is refused.
    r"foclen",
    r"info|name",
)


def json_listed(place, listed):
    named = ".".join(k for k in place if isinstance(k, str) and k != "attributes")
    return any(named == path or named.startswith(f"{path}.") for path in (e.strip("'") for e in listed))


@pytest.mark.parametrize("name", ["optiland_rich.json", "ray_optics_rich.roa", "deeplens_rich.json"])
def test_each_key_of_another_program(name):
    content = json.loads((PEERS / name).read_text())
    verdict = judge(
        content,
        changed_data(content),
        lambda changed: read_json(json.dumps(changed), name),
        named_by(JSON_NAMED)[0],
        json_listed,
    )
    print(name, {k: len(v) for k, v in vars(verdict).items()})
    assert verdict.missed == []
