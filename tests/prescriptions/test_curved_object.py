"""A curved object is a plane to fields on the axis, or infinitely far away, in every format."""

import json
from pathlib import Path

import pytest

from dolens.errors import InputError
from dolens.prescriptions.lens_formats import read_json, read_lens
from tests.prescriptions.codev_samples import SINGLET, system
from tests.prescriptions.zemax_samples import singlet

PEERS = Path(__file__).parent / "peer_files"


def zmx(distance, height):
    kind = "0 0 1 1" if distance is None else "1 0 1 1"
    head = f"ENPD 6\nFTYP {kind}\nYFLN {height}\n"
    text = singlet("CURV 0.02", "DISZ 4", "GLAS ___BLANK 1 0 1.5 0 0", head=head)
    return text.replace("INFINITY", f"{distance or 'INFINITY'}\n  CURV -0.005")


def seq(distance, height):
    field = "YAN" if distance is None else "YOB"
    return system(
        *SINGLET,
        head=f"RDM\nEPD 8\nWL 587.6\n{field} {height}\n",
        target=f"SO -200 {distance or 1e13}",
    )


def oslo(distance, height):
    head = f"EBR 4\nANG {height}" if distance is None else f"NAO 0.01\nOBH {height}"
    ends = f"LEN NEW\n{head}\nAIR\nRD -200\nTH {distance or 1e20}\nNXT\n", "NXT\nAIR\nEND\n"
    return "GLA BK7\nRD 50\nTH 4\nAST\nNXT\nAIR\nRD -50\nTH 40\n".join(ends)


def optiland(distance, height):
    content = json.loads((PEERS / "optiland_rich.json").read_text())
    far = content["surface_group"]["surfaces"][0]["geometry"]
    far |= {"type": "StandardGeometry", "radius": -200.0, "conic": 0.0}
    if distance is not None:
        far["cs"]["z"] = -distance
        content["fields"]["field_definition"]["field_type"] = "ObjectHeightField"
    for field in content["fields"]["fields"]:
        field["y"] = height
    return json.dumps(content)


FORMATS = {"lens.zmx": zmx, "lens.seq": seq, "lens.len": oslo, "lens.json": optiland}
RADIUS = "radius -200 mm"


@pytest.mark.parametrize(("name", "write"), FORMATS.items())
@pytest.mark.parametrize(("distance", "height"), [(None, 0), (None, 3), (90, 0)])
def test_it_is_a_plane_and_listed(name, write, distance, height):
    found = read_lens(write(distance, height).encode(), name)
    assert found.prescription.get("object_distance") == distance
    assert [entry for entry in found.passed_over if RADIUS in entry] != []


@pytest.mark.parametrize(("name", "write"), FORMATS.items())
def test_off_the_axis_it_is_refused(name, write):
    with pytest.raises(InputError, match=rf"a curved object \({RADIUS}\) is not held for fields"):
        read_lens(write(90, 3).encode(), name)


def test_that_of_do_s_text_is_listed():
    rows = "O 0 -200 10 air\nS 0 20 10 1.5/60\nI 30 0 5 air\n"
    text = f"lens\ntype distance roc diameter material\n{rows}"
    assert any(RADIUS in entry for entry in read_lens(text.encode(), "lens.txt").passed_over)


def test_that_of_ray_optics_is_listed():
    content = json.loads((PEERS / "ray_optics_rich.roa").read_text())
    model = content["optical_model"]["attributes"]
    target = model["seq_model"]["attributes"]["ifcs"][0]["attributes"]
    model["profile_dict"][str(target["profile_id"])]["attributes"]["cv"] = -0.005
    assert any(RADIUS in entry for entry in read_json(json.dumps(content), "lens").passed_over)
