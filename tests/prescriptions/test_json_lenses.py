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


def changed(content, path, value):
    new = copy.deepcopy(content)
    place = new
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return new


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


MODEL = ("optical_model", "attributes")
SEQUENCE = (*MODEL, "seq_model", "attributes")
FRONT = (*SEQUENCE, "ifcs", 1, "attributes")
SPECIFICATION = (*MODEL, "optical_spec", "attributes")
PUPIL = (*SPECIFICATION, "pupil", "attributes")
FIELDS = (*SPECIFICATION, "field_of_view", "attributes")
WAVES = (*SPECIFICATION, "spectral_region", "attributes")
LENS = ("surface_group", "surfaces", 2)
GEOMETRY = OPTILAND["surface_group"]["surfaces"][2]["geometry"]


CIRCLE = instance("Circular", radius=4.0)
RECTANGLE = instance("Rectangular", x_half_width=3.0, y_half_width=2.0)
HALF_WIDTHS = {"half_width_x": 3.0, "half_width_y": 2.0}
HOLE = instance("Circular", radius=1.0, is_obscuration=True)
SQUARE_HOLE = instance("Rectangular", is_obscuration=True, x_half_width=3.0, y_half_width=2.0)
# Of Optiland: the keys that its classes write, and the points that they contain (version 0.6.3).
RADIAL = {"type": "RadialAperture", "r_max": 10.0, "r_min": 0.0}
BOX = {"type": "RectangularAperture", "x_min": -1.0, "x_max": 1.0, "y_min": 2.0, "y_max": 5.0}
ELLIPSE = {"type": "EllipticalAperture", "a": 3.0, "b": 2.0, "offset_x": 0.5, "offset_y": 0.0}
SEMI_AXES = {"semi_axis_x": 3.0, "semi_axis_y": 2.0, "decenter_x": 0.5}
TRIANGLE = {"type": "PolygonAperture", "x": [-4.0, 4.0, 0.0], "y": [-3.0, -3.0, 5.0]}
CORNERS = [[-4.0, -3.0], [4.0, -3.0], [0.0, 5.0]]
# Keys of the first face that another shape or aperture would have.
ABSENT = dict.fromkeys(("a2", "a10", "aperture", "obscuration"))
EVEN = {"type": "even_asphere", "conic": 0.5, "a4": 1e-5}


def polynomial(*coefficients, **more):
    return instance("EvenPolynomial", coefs=[*coefficients], **more)


# What a key of the first face is given, and what its row then has.
ROWS = {
    "ray-optics": (RAY_OPTICS, "1", [
        ((*FRONT, "profile"), instance("Spherical", cv=0.0), {"type": "plane"}),
        ((*FRONT, "profile"), instance("Conic", cv=0.05, cc=-1.0),
         {"type": "conic", "radius": 20.0, "conic": -1.0}),
        ((*FRONT, "profile"), polynomial(0.0, 1e-5, 0.0, 2e-9, 0.0, cv=0.05, cc=0.5),
         EVEN | {"radius": 20.0, "a6": 0.0, "a8": 2e-9}),
        ((*FRONT, "profile"), instance("EvenPolynomial", cv=0.0, coefs={"__ndarray__": [1e-3, 0]}),
         {"type": "even_asphere", "a2": 1e-3, "a4": None}),
        ((*SEQUENCE, "gaps", 1), gap(5.0, instance("ModelGlass", n=1.6, v=35.5)),
         {"material": "1.6/35.5"}),
        ((*SEQUENCE, "gaps", 1), gap(5.0, instance("ConstantIndex", n=1.25)), {"material": "1.25"}),
        ((*SEQUENCE, "gaps", 1), gap(5.0, instance("HoyaGlass", gname="FCD1")),
         {"material": "HOYA:FCD1"}),
        ((*FRONT, "clear_apertures"), [CIRCLE], {"semi_diameter": 4.0}),
        ((*FRONT, "clear_apertures"), [RECTANGLE],
         {"aperture": HALF_WIDTHS, "semi_diameter": None}),
        ((*FRONT, "clear_apertures"), [CIRCLE, HOLE],
         {"semi_diameter": 4.0, "obscuration": {"semi_diameter": 1.0}}),
        ((*FRONT, "clear_apertures"), [SQUARE_HOLE],
         {"semi_diameter": "auto", "obscuration": HALF_WIDTHS}),
        ((*FRONT, "interact_mode"), "reflect", {"material": "mirror"}),
        ((*FRONT, "label"), "first mirror", {"note": "first mirror"}),
    ]),
    "Optiland": (OPTILAND, "2", [
        ((*LENS, "geometry"), GEOMETRY | {"type": "StandardGeometry", "conic": -1.0},
         {"type": "conic", "radius": 20.0, "conic": -1.0}),
        ((*LENS, "geometry"),
         GEOMETRY | {"type": "EvenAsphere", "coefficients": [0.0, 1e-5], "conic": 0.5},
         EVEN | {"radius": 20.0}),
        ((*LENS, "material_post"), {"type": "IdealMaterial", "index": [1.25]},
         {"material": "1.25"}),
        ((*LENS, "material_post"), {"type": "AbbeMaterial", "index": [1.6], "abbe": [35.5]},
         {"material": "1.6/35.5"}),
        ((*LENS, "material_post"), {"type": "Material", "name": "FCD1", "reference": "hoya"},
         {"material": "HOYA:FCD1"}),
        ((*LENS, "aperture"), RADIAL | {"r_min": 2.0},
         {"semi_diameter": 10.0, "obscuration": {"semi_diameter": 2.0}}),
        ((*LENS, "aperture"), BOX,
         {"aperture": {"half_width_x": 1.0, "half_width_y": 1.5, "decenter_y": 3.5}}),
        ((*LENS, "aperture"), ELLIPSE, {"aperture": SEMI_AXES}),
        ((*LENS, "aperture"), TRIANGLE, {"aperture": {"polygons": [CORNERS]}}),
        ((*LENS, "aperture"), {"type": "DifferenceAperture", "a": RADIAL, "b": ELLIPSE},
         {"semi_diameter": 10.0, "obscuration": SEMI_AXES}),
    ]),
    "DeepLens": (DEEPLENS, "2", [
        # r is half the diagonal of a square.
        (("surfaces", 1, "is_square"), True,
         {"aperture": dict.fromkeys(HALF_WIDTHS, 10.0 / math.sqrt(2.0)), "a4": 1e-6}),
        (("surfaces", 1, "use_ai2"), True, {"a2": None, "a4": 1e-6}),
        (("surfaces", 1, "use_ai2"), False, {"a4": 0.0, "a6": 1e-6}),
    ]),
}  # fmt: skip


@pytest.mark.parametrize(
    ("content", "number", "path", "value", "row"),
    [(content, n, *one) for content, n, rows in ROWS.values() for one in rows],
)
def test_shapes_media_and_apertures(content, number, path, value, row):
    found = read(changed(content, path, value))["surfaces"][number]
    expected = ABSENT | row
    assert {key: found.get(key) for key in expected} == expected


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        (["object", "pupil"], 6.0, {"entrance_pupil_diameter": 6.0}),
        (["object", "NA"], 0.1, {"object_na": 0.1}),
        (["image", "f/#"], 2.8, {"f_number": 2.8}),
        # An aperture of 30° to each side: sin U' = 1/2, and tan U' = 1/√3 is half of 1/N.
        (["image", "NA"], 0.5, {"f_number": math.sqrt(3.0) / 2.0}),
    ],
)
def test_pupils_of_ray_optics(key, value, expected):
    found = read(changed(RAY_OPTICS, PUPIL, {"key": ["aperture", *key], "value": value}))
    assert {name: found[name] for name in expected} == pytest.approx(expected, rel=1e-15)


def test_the_f_number_of_a_near_object_is_the_working_one():
    near = changed(RAY_OPTICS, (*SEQUENCE, "gaps", 0), gap(300.0, instance("Air")))
    found = read(changed(near, PUPIL, {"key": ["aperture", "image", "f/#"], "value": 4.0}))
    assert found["object_distance"] == 300.0
    assert found["working_f_number"] == 4.0


def test_weights_of_ray_optics():
    content = changed(RAY_OPTICS, (*WAVES, "spectral_wts"), [1.0, 2.0])
    fields = [instance("Field", x=0.0, y=y, wt=1.0 + y) for y in (0.0, 1.0)]
    found = read(changed(content, (*FIELDS, "fields"), fields))
    assert found["wavelength_weights"] == [1.0, 2.0]
    assert found["fields"]["weights"] == [1.0, 2.0]


def test_a_curved_image_of_ray_optics():
    image = instance("Surface", profile=instance("Conic", cv=-0.01, cc=-1.0))
    found = read(changed(RAY_OPTICS, (*SEQUENCE, "ifcs", 3), image))
    assert found["sensor"] == {"distance": 30.0, "radius": -100.0, "conic": -1.0}


def test_what_optiland_says_of_a_system():
    content = changed(OPTILAND, ("name",), "A mirror")
    content["fields"] = {
        "field_definition": {"field_type": "ObjectHeightField"},
        "fields": [{"x": 0.0, "y": y, "weight": 1.0 + y} for y in (0.0, 3.0)],
    }
    content["wavelengths"]["wavelengths"] = [
        {"value": w, "unit": "nm", "weight": w / 500.0} for w in (500.0, 750.0)
    ]
    content["aperture"] = {"type": "float_by_stop_size", "value": 3.0}
    surfaces = content["surface_group"]["surfaces"]
    surfaces[0]["geometry"]["cs"]["z"] = -200.0
    surfaces[3] |= {"is_reflective": True}
    surfaces[4]["geometry"] |= {"type": "StandardGeometry", "radius": -80.0}
    found = read(content)
    assert found["name"] == "A mirror"
    assert found["object_distance"] == 200.0
    assert found["fields"] == {"heights": [[0.0, 0.0], [0.0, 3.0]], "weights": [1.0, 4.0]}
    assert found["wavelengths"] == [500.0, 750.0]
    assert found["wavelength_weights"] == [1.0, 1.5]
    assert "entrance_pupil_diameter" not in found
    assert found["surfaces"]["3"]["material"] == "mirror"
    assert found["sensor"] == {"distance": 30.0, "radius": -80.0}


def with_stops(*stops):
    content = copy.deepcopy(OPTILAND)
    for n, surface in enumerate(content["surface_group"]["surfaces"]):
        surface["is_stop"] = n in stops
    return content


SHEET = instance("ThinLens")


REFUSED = [
    (changed(DEEPLENS, ("surfaces", 2, "type"), "ThinLens"), "a paraxial lens is not held"),
    (changed(DEEPLENS, ("surfaces", 2, "d_next"), 29.0), "'d_sensor' puts the sensor 30 mm"),
    (changed(DEEPLENS, ("surfaces", 0, "type"), "Plane"), "no surface is the stop"),
    (changed(DEEPLENS, ("foclen",), 15.0), "'foclen' says 15 mm, and the surfaces one after"),
    (changed(DEEPLENS, ("DOE",), {"type": "Grating"}), "a diffractive element is not held"),
    (
        changed(OPTILAND, (*LENS, "geometry", "cs", "rx"), 0.1),
        "a decentred or tilted surface is not held ('rx')",
    ),
    (
        changed(OPTILAND, (*LENS, "geometry", "type"), "Toroidal"),
        "a surface of shape 'Toroidal' is not held",
    ),
    (
        changed(OPTILAND, (*LENS, "material_post", "name"), "N-BK99"),
        "unknown material",
    ),
    ({"surfaces": [1, 2]}, "no program that is known here writes lenses with the keys surfaces"),
    ([1], "expected a mapping of keys to values, not a list"),
    (changed(RAY_OPTICS, (*MODEL, "system_spec"), {"dimensions": "inches"}), "lengths in inches"),
    (changed(RAY_OPTICS, (*SEQUENCE, "stop_surface"), None), "a stop that no surface is"),
    (changed(RAY_OPTICS, (*SEQUENCE, "gaps"), []), "needs an object, a surface and an image"),
    (changed(RAY_OPTICS, (*SEQUENCE, "ifcs", 1), SHEET), "a paraxial lens (ThinLens) is not held"),
    (changed(RAY_OPTICS, (*FRONT, "decenter"), instance("DecenterData")), "a decentred or tilted"),
    (changed(RAY_OPTICS, (*FRONT, "interact_mode"), "phantom"), "acts as 'phantom' is not held"),
    (changed(RAY_OPTICS, (*FRONT, "profile"), instance("XToroid")), "shape 'XToroid' is not held"),
    (changed(RAY_OPTICS, (*FRONT, "clear_apertures"), [CIRCLE, CIRCLE]), "a second aperture"),
    (changed(RAY_OPTICS, (*FRONT, "clear_apertures"), [CIRCLE, RECTANGLE]), "a circle cut by"),
    (
        changed(RAY_OPTICS, (*FRONT, "clear_apertures"), [instance("Elliptical")]),
        "an aperture of type 'Elliptical' is not held",
    ),
    (
        changed(RAY_OPTICS, (*SEQUENCE, "gaps", 1), gap(5.0, instance("SchottGlass", gname="?"))),
        "gap 1: ",
    ),
    (
        changed(RAY_OPTICS, (*SEQUENCE, "gaps", 1), gap(5.0, instance("Opaque"))),
        "a medium of type 'Opaque' is not held",
    ),
    (changed(RAY_OPTICS, (*WAVES, "reference_wvl"), 7), "is none of the wavelengths"),
    (changed(RAY_OPTICS, (*FIELDS, "key"), ["field", "image", "angle"]), "fields of kind"),
    (changed(RAY_OPTICS, (*PUPIL, "_key"), ["aperture", "image", "NA"]), "a pupil of kind"),
    (
        changed(RAY_OPTICS, (*SEQUENCE, "ifcs", 3, "attributes", "profile"),
                instance("EvenPolynomial", cv=0.0, coefs=[1e-3])),
        "an image of this shape is not held",
    ),
    (with_stops(), "one surface must be the stop ('is_stop'), not 0"),
    (with_stops(1, 2), "one surface must be the stop ('is_stop'), not 2"),
    (
        changed(OPTILAND, LENS, optiland_surface(3.0, 20.0, N_BK7, type="ParaxialLens")),
        "a surface of type 'ParaxialLens' is not held",
    ),
    (
        changed(OPTILAND, (*LENS, "material_post"), {"type": "GradientMaterial"}),
        "a medium of type 'GradientMaterial' is not held",
    ),
    (
        changed(OPTILAND, (*LENS, "material_post"), AIR | {"absorp": 0.1}),
        "absorption is not held",
    ),
    (changed(OPTILAND, ("aperture", "type"), "working_fno"), "an aperture of type 'working_fno'"),
    (
        changed(OPTILAND, ("wavelengths", "wavelengths", 0, "unit"), "inch"),
        "a wavelength in 'inch' (allowed: um, nm, mm, m)",
    ),
    (
        changed(OPTILAND, ("fields", "fields", 0, "field_type"), "solid_angle"),
        "fields of type 'solid_angle' are not held",
    ),
]  # fmt: skip


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
