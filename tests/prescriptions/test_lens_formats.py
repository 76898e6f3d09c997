"""A file counts by what it holds, in whatever program's words it says it."""

import codecs
import gzip
import io
import json
import zipfile
from pathlib import Path

import pytest
import torch

from dolens import InputError, Rays, Status, load_lens
from dolens.analysis.conditions import conditions
from dolens.analysis.spot_diagram import spot_diagram
from dolens.prescriptions.codev.reader import read_codev
from dolens.prescriptions.codev.writer import codev_of
from dolens.prescriptions.diffoptics_text import diffoptics_text_of
from dolens.prescriptions.files import load_prescription
from dolens.prescriptions.lens_formats import read_json, read_lens
from dolens.prescriptions.other_programs import differences
from dolens.prescriptions.zemax.reader import prescription_from_zemax
from dolens.prescriptions.zemax.writer import zemax_of
from tests.prescriptions.codev.samples import SINGLET as CODE_V_SINGLET
from tests.prescriptions.codev.samples import TRIPLET, system
from tests.prescriptions.samples import SINGLET, require_refused
from tests.prescriptions.test_oslo import TRIPLET as OSLO_TRIPLET
from tests.prescriptions.zemax.samples import GLASS, singlet, triplet

PEERS = Path(__file__).parent / "peer_files"


def numbers(rows):
    return torch.tensor([[float(v) for v in row] for row in rows], dtype=torch.float64)


TRIPLETS = {"triplet.ZMX": triplet().encode("utf-16"), "triplet.seq": TRIPLET.encode()}


@pytest.mark.parametrize("name", TRIPLETS)
def test_the_triplet_traces_as_the_reference(name, tmp_path, reference):
    """28-digit rays of the supplement's triplet through the same lens in each program's words."""
    path = tmp_path / name
    path.write_bytes(TRIPLETS[name])
    lens = load_lens(path)
    assert lens.stop == 4
    assert sorted(lens.wavelengths) == [486.1327, 587.5618, 656.2725]
    assert lens.reference_wavelength == 587.5618
    assert lens.fields.points == ((0.0, 0.0), (0.0, 14.0), (0.0, 20.0))
    assert lens.sensor_diameter == 36.346
    rays = reference("rays/rays_triplet__dfc.json")["rays"]
    wavelength = torch.tensor([float(r["wavelength"]) for r in rays], dtype=torch.float64)
    start, along = numbers(r["o"] for r in rays), numbers(r["d"] for r in rays)
    hit = lens.trace(Rays(start, along, wavelength))
    ok = torch.tensor([r["status"] == "ok" for r in rays])
    assert torch.equal(hit.valid, ok)
    assert torch.equal(hit.status == Status.OK, ok)
    assert int(ok.sum()) > 50
    expected = numbers(r["sensor"] for r in rays if r["status"] == "ok")
    assert (hit.position[ok][:, : expected.shape[1]] - expected).abs().max() < 1e-11


def in_zemax(unit):
    front = ("TYPE EVENASPH", "CURV 0.02", "CONI -0.5", "PARM 2 1E-6", "PARM 3 -2E-9", "DISZ 4")
    head = f"UNIT {unit}\nENPD 8\nFTYP 1 0 1 1\nYFLN 3\nWAVM 1 0.55 1\n"
    ends = {"head": head, "object_distance": "200", "image": "DIAM 7 1"}
    return prescription_from_zemax(singlet(*front, GLASS, "DIAM 5", **ends))


def in_code_v(unit):
    head = f"RDM\nDIM {unit}\nEPD 8\nWL 550\nYOB 3\n"
    front = "S 50 4 517.642\n STO\n ASP; K -0.5; A 1e-6; B -2e-9\n CIR 5"
    ends = {"head": head, "target": "SO 0 200", "image": "SI 0 0.5\n CIR 7"}
    return read_codev(system(front, "S -50 39.5\n CIR 5", **ends), "lens").prescription


UNITS = [(in_zemax, {"MM": 1.0, "CM": 10.0, "IN": 25.4, "METER": 1000.0}),
         (in_code_v, {"M": 1.0, "C": 10.0, "I": 25.4})]  # fmt: skip


@pytest.mark.parametrize(
    ("read", "unit", "u"), [(read, *one) for read, units in UNITS for one in units.items()]
)
def test_units(read, unit, u):
    """A length u·r in mm; the coefficient of r^2i in mm^(1-2i) is u^(1-2i) of the file's."""
    found = read(unit)
    first, second = found["surfaces"].values()
    assert (first["type"], first["conic"]) == ("even_asphere", -0.5)
    lengths = {"radius": 50.0 * u, "a4": 1e-6 * u**-3, "a6": -2e-9 * u**-5, "thickness": 4.0 * u}
    assert {key: first[key] for key in lengths} == pytest.approx(lengths, rel=1e-15)
    assert second["semi_diameter"] == pytest.approx(5.0 * u, rel=1e-15)
    assert found["sensor"] == pytest.approx({"distance": 40.0 * u, "diameter": 14.0 * u}, rel=1e-15)
    assert found["object_distance"] == pytest.approx(200.0 * u, rel=1e-15)
    assert found["entrance_pupil_diameter"] == pytest.approx(8.0 * u, rel=1e-15)
    assert found["fields"] == {"heights": [[0.0, pytest.approx(3.0 * u, rel=1e-15)]]}
    assert found["wavelengths"] == [550.0]


def archive():
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as file:
        file.writestr("lens.zmx", triplet())
    return data.getvalue()


UNKNOWN = {
    "nothing": (b"", "is empty"),
    "blanks": (b" \r\n\t\n", "is empty"),
    "zip": (archive(), "is a .zip archive; unpack it"),
    "gzip": (gzip.compress(triplet().encode()), "is compressed (gzip); unpack it"),
    "zar": (b"\xec\x03\0\0\0\0\0\0" + bytes(300), "is an archive of OpticStudio (.zar); unpack it"),
    "zos": (b"ZoS\0\x01\0\0", "is OpticStudio's binary form of a lens (.zos)"),
    "pdf": (b"%PDF-1.7\n", "is a PDF document"),
    "html": (b"<!DOCTYPE html><title>404</title>", "is a page of a website (HTML)"),
    "utf-32": (codecs.BOM_UTF32_LE + triplet().encode("utf-32-le"), "is text in UTF-32"),
    "code v": (b"]\0\0\0Y\0\0\0" + b"New lens".ljust(300), "is CODE V's binary form of a lens"),
    "binary": (bytes(range(256)) * 9, "is binary, no text of a lens"),
    "prose": (b"Dear reader,\nthis is no lens.\n", "is no lens file that is known here"),
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_what_is_no_lens_is_named_in_one_line(name, tmp_path):
    data, said = UNKNOWN[name]
    require_refused(tmp_path / "lens.dat", data, said)


@pytest.mark.parametrize("suffix", [".zmx", ".seq", ".len", ".json", ".yaml", ".txt"])
@pytest.mark.parametrize("name", [n for n in UNKNOWN if n != "prose"])
def test_the_suffix_does_not_hide_what_it_is(name, suffix, tmp_path):
    data, said = UNKNOWN[name]
    require_refused(tmp_path / f"lens{suffix}", data, said)


@pytest.mark.parametrize(
    ("suffix", "said"), [(".yaml", "is not valid YAML"), (".txt", "is not valid text")]
)
def test_bytes_that_are_no_text(suffix, said, tmp_path):
    require_refused(tmp_path / f"lens{suffix}", b"\xff\xfe\x00\x80", said)


@pytest.mark.parametrize(
    ("text", "name"),
    [(triplet(), "Zemax"), (TRIPLET, "CODE V"), (OSLO_TRIPLET, "OSLO")],
    ids=["Zemax", "CODE V", "OSLO"],
)
@pytest.mark.parametrize("suffix", [".txt", ".lens", ".zmx"])
def test_content_counts_before_the_name(text, name, suffix, tmp_path):
    path = tmp_path / f"lens{suffix}"
    path.write_text(text)
    assert len(load_prescription(path)["surfaces"]) == 6


def zmx(distance, height):
    kind = "0 0 1 1" if distance is None else "1 0 1 1"
    head = f"ENPD 6\nFTYP {kind}\nYFLN {height}\n"
    text = singlet("CURV 0.02", "DISZ 4", "GLAS ___BLANK 1 0 1.5 0 0", head=head)
    return text.replace("INFINITY", f"{distance or 'INFINITY'}\n  CURV -0.005")


def seq(distance, height):
    field = "YAN" if distance is None else "YOB"
    return system(
        *CODE_V_SINGLET,
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
def test_a_curved_object_is_a_plane_on_the_axis_and_listed(name, write, distance, height):
    found = read_lens(write(distance, height).encode(), name)
    assert found.prescription.get("object_distance") == distance
    assert [entry for entry in found.passed_over if RADIUS in entry] != []


@pytest.mark.parametrize(("name", "write"), FORMATS.items())
def test_a_curved_object_off_the_axis_is_refused(name, write):
    with pytest.raises(InputError, match=rf"a curved object \({RADIUS}\) is not held for fields"):
        read_lens(write(90, 3).encode(), name)


def test_a_curved_object_of_do_s_text_is_listed():
    rows = "O 0 -200 10 air\nS 0 20 10 1.5/60\nI 30 0 5 air\n"
    text = f"lens\ntype distance roc diameter material\n{rows}"
    assert any(RADIUS in entry for entry in read_lens(text.encode(), "lens.txt").passed_over)


def test_a_curved_object_of_ray_optics_is_listed():
    content = json.loads((PEERS / "ray_optics_rich.roa").read_text())
    model = content["optical_model"]["attributes"]
    target = model["seq_model"]["attributes"]["ifcs"][0]["attributes"]
    model["profile_dict"][str(target["profile_id"])]["attributes"]["cv"] = -0.005
    assert any(RADIUS in entry for entry in read_json(json.dumps(content), "lens").passed_over)


FILM = SINGLET | {"sensor": {"distance": 30.0, "diameter": 10.0, "radius": -27.3, "conic": -0.4}}


@pytest.mark.parametrize(
    "sensor",
    [
        {"distance": 30.0, "radius": -27.3, "conic": -0.4},
        {"distance": 30.0, "radius": 12.5, "diameter": 9.0},
        # No radius gives this curvature to the last bit.
        {"distance": 30.0, "curvature": -0.036630036630036634},
    ],
)
@pytest.mark.parametrize("program", ["zmx", "seq"])
def test_files_give_a_curved_sensor_back(sensor, program):
    lens = SINGLET | {"sensor": sensor}
    if program == "zmx":
        found = prescription_from_zemax(zemax_of(lens))
    else:
        found = read_codev(codev_of(lens), "lens").prescription
    assert not [d for d in differences(lens, found) if d.place == ("sensor",)]
    curvature = found["sensor"].get("curvature") or 1.0 / found["sensor"]["radius"]
    assert curvature == sensor.get("curvature", 1.0 / sensor.get("radius", 1.0))


def test_a_format_without_a_curved_sensor_says_so():
    """A text file of dO's has a plane for its sensor."""
    with pytest.raises(InputError, match=r"sensor: a \.txt file cannot hold"):
        diffoptics_text_of(FILM, "lens")


def test_a_radius_is_its_curvature_and_a_plane_is_a_plane():
    sensor = FILM["sensor"]
    flat = {"distance": 30.0, "diameter": 10.0}
    same = {key: value for key, value in sensor.items() if key != "radius"}
    assert not differences(FILM, FILM | {"sensor": same | {"curvature": 1.0 / -27.3}})
    assert not differences(
        FILM | {"sensor": flat}, FILM | {"sensor": flat | {"radius": float("inf"), "conic": 0.0}}
    )
    assert differences(FILM, FILM | {"sensor": flat})


def test_a_schmidt_camera_is_sharp_on_its_film(root):
    """All fields of a camera with its corrector at the mirror's centre see the same optics, but for
    how the corrector is foreshortened.
    """
    film = load_lens(root / "conf/lens/published/schmidt_camera_200_f24.yaml")
    fields = [(0.0, 0.0), (0.0, 1.26), (0.0, 1.8)]
    spots = 1e3 * spot_diagram(film, conditions(film, fields), 400).polychromatic_rms
    assert (spots / spots[0] - 1.0).abs().max() < 0.08
    assert spots[0] < 3.0
