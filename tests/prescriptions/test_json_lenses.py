"""Lenses in JSON: dolens's own, and those of Optiland, DeepLens and ray-optics."""

import copy
import json
import math
from pathlib import Path

import pytest
import torch

from dolens import load_lens, save_lens
from dolens.optics.rays import Rays
from dolens.prescriptions.build import lens_from_prescription
from dolens.prescriptions.lens_formats import read_json
from dolens.prescriptions.plain_values import json_of
from tests.prescriptions.samples import SINGLET, require_refused

PEERS = Path(__file__).parent / "peer_files"

# A singlet in the words of each program: N-BK7, R 20 and -50 mm, 5 mm thick, stop in front.
DEEPLENS = {
    "info": "Singlet",
    "foclen": 28.4,
    "fnum": 4.0,
    "r_sensor": 5.0,
    "d_sensor": 37.0,
    "surfaces": [
        {"type": "Aperture", "r": 3.0, "d": 0.0, "mat2": "air", "d_next": 2.0},
        {"type": "Aspheric", "r": 10.0, "roc": 20.0, "d": 2.0, "k": -0.5, "ai": [0.0, 1e-6, 0.0],
         "mat2": "n-bk7", "d_next": 5.0},
        {"type": "Spheric", "r": 10.0, "c": -0.02, "d": 7.0, "mat2": "air", "d_next": 30.0},
    ],
}  # fmt: skip


def optiland_surface(z, radius, medium, **more):
    axes = {"x": 0.0, "y": 0.0, "z": z, "rx": 0.0, "ry": 0.0, "rz": 0.0, "reference_cs": None}
    kind = "Plane" if math.isinf(radius) else "StandardGeometry"
    return {
        "type": "Surface",
        "geometry": {"type": kind, "cs": axes, "radius": radius, "conic": 0.0},
        "material_post": medium,
        "is_stop": False,
        "aperture": None,
        "is_reflective": False,
    } | more


AIR = {"type": "IdealMaterial", "index": 1.0, "absorp": 0.0}
N_BK7 = {"type": "Material", "filename": "C:\\data-nk\\glass\\schott\\N-BK7.yml", "name": "N-BK7"}
OPTILAND = {
    "version": 1.0,
    "aperture": {"type": "EPD", "value": 6},
    "fields": {"fields": [{"field_type": "angle", "x": 0.0, "y": y, "vx": 0.0, "vy": v}
                          for y, v in ((0.0, 0.0), (14.0, 0.2))], "telecentric": False},
    "wavelengths": {"wavelengths": [{"value": w, "is_primary": w == 0.5876, "unit": "um"}
                                    for w in (0.4861, 0.5876)]},
    "pickups": [],
    "surface_group": {"surfaces": [
        optiland_surface(-math.inf, math.inf, AIR, type="ObjectSurface"),
        optiland_surface(0.0, math.inf, AIR, is_stop=True),
        optiland_surface(3.25896, 20.0, N_BK7),
        optiland_surface(9.26651, -50.0, AIR, aperture={"type": "RadialAperture", "r_max": 10.0}),
        optiland_surface(39.26651, math.inf, AIR),
    ]},
}  # fmt: skip


def instance(kind, **attributes):
    return {"__instance_type__": ["rayoptics", kind], "attributes": attributes}


def interface(curvature, mode="transmit", **more):
    return instance(
        "Surface",
        profile=instance("Spherical", cv=curvature),
        interact_mode=mode,
        decenter=None,
        label="",
        clear_apertures=[],
        edge_apertures=[],
    ) | {"more": more}


def gap(length, medium):
    return instance("Gap", thi=length, medium=medium)


RAY_OPTICS = {"optical_model": instance(
    "OpticalModel",
    system_spec=instance("SystemSpec", title="Singlet", _dimensions="mm"),
    seq_model=instance(
        "SequentialModel",
        ifcs=[interface(0.0, "dummy"), interface(0.05), interface(-0.02), interface(0.0, "dummy")],
        gaps=[gap(1e10, instance("Air")), gap(5.0, instance("SchottGlass", gname="N-BK7")),
              gap(30.0, instance("Air"))],
        stop_surface=1,
    ),
    optical_spec=instance(
        "OpticalSpecs",
        spectral_region=instance("WvlSpec", wavelengths=[656.0, 588.0], reference_wvl=1),
        pupil=instance("PupilSpec", _key=["aperture", "object", "epd"], value=6.0),
        field_of_view=instance(
            "FieldSpec", key=["field", "object", "angle"], is_relative=True, value=20.0,
            fields=[instance("Field", x=0.0, y=y, vuy=0.4 * y, vly=0.25 * y) for y in (0.0, 1.0)],
        ),
    ),
)}  # fmt: skip


def read(content):
    return read_json(json.dumps(content), "lens").prescription


def test_a_prescription_as_json_is_the_same_to_the_last_bit():
    lens = copy.deepcopy(SINGLET)
    lens["surfaces"]["1"] |= {"radius": math.inf, "a4": 0.1 + 0.2}
    text = json_of(lens, "lens").decode()
    assert "Infinity" not in text
    back = read_json(text, "lens").prescription
    assert float(back["surfaces"]["1"].pop("radius")) == math.inf
    del lens["surfaces"]["1"]["radius"]
    assert back == lens


def test_a_lens_of_deeplens():
    found = read(DEEPLENS)
    assert found["stop"] == 1
    assert found["sensor"] == {"distance": 30.0, "diameter": 10.0}
    assert found["surfaces"]["1"] == {
        "type": "aperture", "material": "air", "semi_diameter": 3.0, "thickness": 2.0,
    }  # fmt: skip
    assert found["surfaces"]["2"] == {
        "type": "even_asphere", "radius": 20.0, "conic": -0.5, "a4": 1e-6, "a6": 0.0,
        "material": "n-bk7", "semi_diameter": 10.0, "thickness": 5.0,
    }  # fmt: skip
    assert found["surfaces"]["3"]["radius"] == -50.0


def test_a_lens_of_optiland():
    """Gaps are exact differences of positions; the glass's maker is in the name of its file."""
    found = read(OPTILAND)
    rows = found["surfaces"]
    assert rows["1"]["type"] == "aperture"
    assert rows["2"]["material"] == "SCHOTT:N-BK7"
    assert rows["2"]["thickness"] == 6.00755
    assert rows["2"]["semi_diameter"] == "auto"
    assert rows["3"]["semi_diameter"] == 10.0
    assert found["sensor"] == {"distance": 30.0}
    assert found["wavelengths"] == [486.1, 587.6]
    assert found["reference_wavelength"] == 587.6
    assert found["entrance_pupil_diameter"] == 6.0
    assert found["fields"]["angles"] == [[0.0, 0.0], [0.0, 14.0]]
    assert found["fields"]["vignetting"][1] == {"compression_x": 0.0, "compression_y": 0.2}
    assert "object_distance" not in found


def test_a_lens_of_ray_optics():
    found = read(RAY_OPTICS)
    rows = found["surfaces"]
    assert (rows["1"]["radius"], rows["2"]["radius"]) == (20.0, -50.0)
    assert rows["1"]["material"] == "SCHOTT:N-BK7"
    assert found["stop"] == 1
    assert found["sensor"]["distance"] == 30.0
    assert found["fields"]["angles"] == [[0.0, 0.0], [0.0, 20.0]]
    edge = found["fields"]["vignetting"][1]
    assert edge["decenter_y"] + 1.0 - edge["compression_y"] == pytest.approx(0.6, abs=1e-15)
    assert found["reference_wavelength"] == 588.0


def changed(content, path, value):
    new = copy.deepcopy(content)
    place = new
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return new


REFUSED = [
    (changed(DEEPLENS, ("surfaces", 2, "type"), "ThinLens"), "a paraxial lens is not held"),
    (changed(DEEPLENS, ("surfaces", 2, "d_next"), 29.0), "'d_sensor' puts the sensor 30 mm"),
    (changed(DEEPLENS, ("surfaces", 0, "type"), "Plane"), "no surface is the stop"),
    (changed(DEEPLENS, ("foclen",), 15.0), "'foclen' says 15 mm, and the surfaces one after"),
    (changed(DEEPLENS, ("DOE",), {"type": "Grating"}), "a diffractive element is not held"),
    (
        changed(OPTILAND, ("surface_group", "surfaces", 2, "geometry", "cs", "rx"), 0.1),
        "a decentred or tilted surface is not held ('rx')",
    ),
    (
        changed(OPTILAND, ("surface_group", "surfaces", 2, "geometry", "type"), "Toroidal"),
        "a surface of shape 'Toroidal' is not held",
    ),
    (
        changed(OPTILAND, ("surface_group", "surfaces", 2, "material_post", "name"), "N-BK99"),
        "unknown material",
    ),
    ({"surfaces": [1, 2]}, "no program that is known here writes lenses with the keys surfaces"),
    ([1], "expected a mapping of keys to values, not a list"),
]


@pytest.mark.parametrize(("content", "said"), REFUSED)
def test_what_is_not_held_is_refused_by_name(content, said, tmp_path):
    require_refused(tmp_path / "lens.json", json.dumps(content), said)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "is not valid JSON"),
        ('{"a": 1, "a": 2}', "key 'a' is given twice"),
        ('{"a": ' * 100_000, "is not valid JSON"),
        (f'{{"a": {"9" * 10_000}}}', "a number of 10000 letters"),
    ],
    ids=["cut", "twice", "deep", "digits"],
)
def test_hostile_json_ends_in_one_line(text, said, tmp_path):
    require_refused(tmp_path / "lens.json", text, said)


def test_what_a_source_publishes_and_draws_comes_back(tmp_path):
    """Published numbers and obscurations are kept in JSON as in YAML."""
    lens = load_lens("published/ritchey_chretien_hst")
    for suffix in (".json", ".yaml"):
        save_lens(lens, tmp_path / f"lens{suffix}")
        again = load_lens(tmp_path / f"lens{suffix}")
        assert again.published == lens.published
        assert again.surfaces["1"].aperture.obscuration.semi_diameter == 396.0
        assert again.source == lens.source


CIRCLE = {"type": "RadialAperture", "r_max": 10.0, "r_min": 0.0}
RECTANGLE = {"type": "RectangularAperture", "x_min": -1.0, "x_max": 1.0, "y_min": 2.0, "y_max": 5.0}
ELLIPSE = {"type": "EllipticalAperture", "a": 3.0, "b": 2.0, "offset_x": 0.5, "offset_y": 0.0}


@pytest.mark.parametrize(
    ("aperture", "row"),
    [
        (CIRCLE | {"r_min": 2.0}, {"semi_diameter": 10.0, "obscuration": {"semi_diameter": 2.0}}),
        (RECTANGLE, {"aperture": {"half_width_x": 1.0, "half_width_y": 1.5, "decenter_y": 3.5}}),
        (ELLIPSE, {"aperture": {"semi_axis_x": 3.0, "semi_axis_y": 2.0, "decenter_x": 0.5}}),
        (
            {"type": "PolygonAperture", "x": [-4.0, 4.0, 0.0], "y": [-3.0, -3.0, 5.0]},
            {"aperture": {"polygons": [[[-4.0, -3.0], [4.0, -3.0], [0.0, 5.0]]]}},
        ),
        (
            {"type": "DifferenceAperture", "a": CIRCLE, "b": ELLIPSE},
            {
                "semi_diameter": 10.0,
                "obscuration": {"semi_axis_x": 3.0, "semi_axis_y": 2.0, "decenter_x": 0.5},
            },
        ),
    ],
)
def test_apertures_of_optiland(aperture, row):
    """The keys that its classes write, and the points that they contain (version 0.6.3)."""
    content = copy.deepcopy(OPTILAND)
    content["surface_group"]["surfaces"][3]["aperture"] = aperture
    found = read_json(json.dumps(content), "lens").prescription["surfaces"]["3"]
    assert {key: found.get(key) for key in row} == row


def test_rays_through_a_tilted_asphere_land_where_deeplens_has_them():
    """Of the file as DeepLens 2.5.6 writes it, with two surfaces tilted and one decentred; its own
    numbers, in single precision.
    """
    content = json.loads((PEERS / "deeplens_rich.json").read_text())
    content["surfaces"][1] |= {"pos_xy": [0.1, -0.2], "vec_local": [0.03, 0.05, 0.9983]}
    content["surfaces"][5] |= {"vec_local": [0.2, 0.15, 0.968]}
    lens = lens_from_prescription(read(content))
    at = torch.tensor([[0.5, 0.7, -1.0], [1.5, -0.4, -1.0], [-1.0, 1.0, -1.0], [1.9, 1.9, -1.0]])
    along = torch.tensor([0.0, 0.0, 1.0]).expand_as(at)
    found = lens.trace(Rays(at.double(), along.double(), 587.0)).position[:, :2]
    theirs = [[0.97186, 0.13288], [0.26072, 0.92367], [2.048, -0.10852], [-0.0011486, -0.72002]]
    assert (found - torch.tensor(theirs)).abs().max() < 2e-5


def test_a_square_of_deeplens_has_r_as_half_its_diagonal():
    content = changed(DEEPLENS, ("surfaces", 1, "is_square"), True)
    half = 10.0 / math.sqrt(2.0)
    sides = {"half_width_x": half, "half_width_y": half}
    assert read(content)["surfaces"]["2"]["aperture"] == sides


@pytest.mark.parametrize(("legacy", "first"), [(True, "a2"), (False, "a4")])
def test_the_first_coefficient_of_deeplens_follows_use_ai2(legacy, first):
    content = changed(DEEPLENS, ("surfaces", 1, "use_ai2"), legacy)
    content["surfaces"][1]["ai"] = [1e-6, 1e-9]
    assert read(content)["surfaces"]["2"][first] == 1e-6
