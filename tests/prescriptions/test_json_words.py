"""Words of Optiland's and ray-optics' files: surfaces, media, apertures, fields and pupils."""

import copy
import json
import math

import pytest

from tests.prescriptions.samples import require_refused
from tests.prescriptions.test_json_lenses import (
    AIR,
    N_BK7,
    OPTILAND,
    RAY_OPTICS,
    changed,
    gap,
    instance,
    optiland_surface,
    read,
)

MODEL = ("optical_model", "attributes")
SEQUENCE = (*MODEL, "seq_model", "attributes")
FRONT = (*SEQUENCE, "ifcs", 1, "attributes")
SPECIFICATION = (*MODEL, "optical_spec", "attributes")
PUPIL = (*SPECIFICATION, "pupil", "attributes")
FIELDS = (*SPECIFICATION, "field_of_view", "attributes")
WAVES = (*SPECIFICATION, "spectral_region", "attributes")


def of_ray_optics(path, value):
    return read(changed(RAY_OPTICS, path, value))


@pytest.mark.parametrize(
    ("profile", "row"),
    [
        (instance("Spherical", cv=0.0), {"type": "plane"}),
        (instance("Conic", cv=0.05, cc=-1.0), {"type": "conic", "radius": 20.0, "conic": -1.0}),
        (
            instance("EvenPolynomial", cv=0.05, cc=0.5, coefs=[0.0, 1e-5, 0.0, 2e-9, 0.0]),
            {"type": "even_asphere", "conic": 0.5, "a4": 1e-5, "a6": 0.0, "a8": 2e-9},
        ),
        (
            instance("EvenPolynomial", cv=0.0, coefs={"__ndarray__": [1e-3, 0.0]}),
            {"type": "even_asphere", "a2": 1e-3},
        ),
    ],
)
def test_shapes_of_ray_optics(profile, row):
    found = of_ray_optics((*FRONT, "profile"), profile)["surfaces"]["1"]
    assert row.items() <= found.items()
    assert {key for key in found if key[1:].isdigit()} == {key for key in row if key[1:].isdigit()}


@pytest.mark.parametrize(
    ("medium", "name"),
    [
        (instance("ModelGlass", n=1.6, v=35.5), "1.6/35.5"),
        (instance("ConstantIndex", n=1.25), "1.25"),
        (instance("HoyaGlass", gname="FCD1"), "HOYA:FCD1"),
    ],
)
def test_media_of_ray_optics(medium, name):
    found = of_ray_optics((*SEQUENCE, "gaps", 1), gap(5.0, medium))
    assert found["surfaces"]["1"]["material"] == name


CIRCLE = instance("Circular", radius=4.0)
RECTANGLE = instance("Rectangular", x_half_width=3.0, y_half_width=2.0)
HALF_WIDTHS = {"half_width_x": 3.0, "half_width_y": 2.0}


@pytest.mark.parametrize(
    ("given", "row"),
    [
        ([CIRCLE], {"semi_diameter": 4.0}),
        ([RECTANGLE], {"aperture": HALF_WIDTHS}),
        (
            [CIRCLE, instance("Circular", radius=1.0, is_obscuration=True)],
            {"semi_diameter": 4.0, "obscuration": {"semi_diameter": 1.0}},
        ),
        (
            [instance("Rectangular", is_obscuration=True, x_half_width=3.0, y_half_width=2.0)],
            {"semi_diameter": "auto", "obscuration": HALF_WIDTHS},
        ),
    ],
)
def test_apertures_of_ray_optics(given, row):
    found = of_ray_optics((*FRONT, "clear_apertures"), given)["surfaces"]["1"]
    keys = ("semi_diameter", "aperture", "obscuration")
    assert {key: found[key] for key in keys if key in found} == row


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
    found = of_ray_optics(PUPIL, {"key": ["aperture", *key], "value": value})
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


def test_a_mirror_a_label_and_a_curved_image_of_ray_optics():
    content = changed(RAY_OPTICS, (*FRONT, "interact_mode"), "reflect")
    content = changed(content, (*FRONT, "label"), "first mirror")
    image = instance("Surface", profile=instance("Conic", cv=-0.01, cc=-1.0))
    found = read(changed(content, (*SEQUENCE, "ifcs", 3), image))
    assert found["surfaces"]["1"]["material"] == "mirror"
    assert found["surfaces"]["1"]["note"] == "first mirror"
    assert found["sensor"] == {"distance": 30.0, "radius": -100.0, "conic": -1.0}


OPTILAND_FRONT = ("surface_group", "surfaces", 2)


def of_optiland(path, value):
    return read(changed(OPTILAND, path, value))


@pytest.mark.parametrize(
    ("shape", "row"),
    [
        ({"type": "StandardGeometry", "conic": -1.0}, {"type": "conic", "conic": -1.0}),
        (
            {"type": "EvenAsphere", "coefficients": [0.0, 1e-5], "conic": 0.5},
            {"type": "even_asphere", "conic": 0.5, "a4": 1e-5},
        ),
    ],
)
def test_shapes_of_optiland(shape, row):
    geometry = OPTILAND["surface_group"]["surfaces"][2]["geometry"] | shape
    found = of_optiland((*OPTILAND_FRONT, "geometry"), geometry)["surfaces"]["2"]
    assert (row | {"radius": 20.0}).items() <= found.items()
    assert "a2" not in found


@pytest.mark.parametrize(
    ("medium", "name"),
    [
        ({"type": "IdealMaterial", "index": [1.25]}, "1.25"),
        ({"type": "AbbeMaterial", "index": [1.6], "abbe": [35.5]}, "1.6/35.5"),
        ({"type": "Material", "name": "FCD1", "reference": "hoya"}, "HOYA:FCD1"),
    ],
)
def test_media_of_optiland(medium, name):
    found = of_optiland((*OPTILAND_FRONT, "material_post"), medium)
    assert found["surfaces"]["2"]["material"] == name


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
        changed(OPTILAND, OPTILAND_FRONT, optiland_surface(3.0, 20.0, N_BK7, type="ParaxialLens")),
        "a surface of type 'ParaxialLens' is not held",
    ),
    (
        changed(OPTILAND, (*OPTILAND_FRONT, "material_post"), {"type": "GradientMaterial"}),
        "a medium of type 'GradientMaterial' is not held",
    ),
    (
        changed(OPTILAND, (*OPTILAND_FRONT, "material_post"), AIR | {"absorp": 0.1}),
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
def test_words_that_are_not_held_are_refused(content, said, tmp_path):
    require_refused(tmp_path / "lens.json", json.dumps(content), said)
