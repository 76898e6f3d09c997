"""A STEP file holds the glass that the prescription describes, to a nanometre."""

import math

import mpmath
import numpy as np
import pytest
import torch

from dolens import load_lens
from dolens.errors import InputError
from dolens.manufacturing import modeller
from dolens.manufacturing.glass_elements import glass_elements
from dolens.manufacturing.lens_export import export_lens
from dolens.manufacturing.solids import element_solid, triangles, visible
from dolens.manufacturing.step import export_step, product_name, read_step_file, sag_errors
from tests.lenses import GLASS, lens_of_rows


def singlet(front, back, thickness=3.0, **more):
    return lens_of_rows({**front, "thickness": thickness, "material": GLASS}, back, **more)


SPHERE = {"type": "sphere", "radius": 20.0}
PLANE = {"type": "plane"}
CONIC = {"type": "conic", "radius": -15.0, "conic": -2.3}
ASPHERE = {"type": "even_asphere", "radius": 12.0, "conic": 0.7, "a4": 1e-4, "a6": -3e-6}
PLATE = {"type": "xy_polynomial", "x3": 2e-4, "y3": 2e-4, "x2y": -1e-4, "x2": 0.01}


def conic_of(r2, radius, k):
    c = 1 / mpmath.mpf(radius)
    return c * r2 / (1 + mpmath.sqrt(1 - (1 + mpmath.mpf(k)) * c * c * r2))


def heights(solid, x, y):
    """Where lines along z meet a solid, lowest and highest."""
    finder = modeller.occ("IntCurvesFace").IntCurvesFace_ShapeIntersector()
    finder.Load(solid, 1e-10)
    along = modeller.occ("gp").gp_Dir(0.0, 0.0, 1.0)
    found = []
    for a, b in zip(x, y, strict=True):
        line = modeller.occ("gp").gp_Lin(modeller.point(a, b, 0.0), along)
        finder.Perform(line, -1e3, 1e3)
        met = [finder.WParameter(k) for k in range(1, finder.NbPnt() + 1)]
        found.append((min(met), max(met)))
    return np.array(found).T


@pytest.fixture(scope="module")
def points():
    angle = np.linspace(0.3, 6.0, 17)
    r = 4.99 * np.sqrt(np.linspace(0.02, 1.0, 17))
    return r * np.cos(angle), r * np.sin(angle)


@pytest.mark.parametrize(
    ("front", "back", "of_front", "of_back"),
    [
        (SPHERE, CONIC, lambda x, y: conic_of(x * x + y * y, 20, 0),
         lambda x, y: conic_of(x * x + y * y, -15, "-2.3")),
        (ASPHERE, PLANE,
         lambda x, y: conic_of(x * x + y * y, 12, "0.7") + mpmath.mpf("1e-4") * (x * x + y * y) ** 2
         - mpmath.mpf("3e-6") * (x * x + y * y) ** 3,
         lambda x, y: mpmath.mpf(0)),
        (PLANE, PLATE, lambda x, y: mpmath.mpf(0),
         lambda x, y: mpmath.mpf("2e-4") * (x**3 + y**3) - mpmath.mpf("1e-4") * x * x * y
         + mpmath.mpf("0.01") * x * x),
    ],
    ids=["sphere and conic", "asphere and plane", "plane and cubic plate"],
)  # fmt: skip
def test_surfaces_of_the_file_are_the_closed_forms_to_a_nanometre(
    front, back, of_front, of_back, points, tmp_path
):
    lens = singlet(front, back)
    export_step(lens, tmp_path / "lens.step")
    (solid,) = read_step_file(tmp_path / "lens.step").values()
    low, high = heights(solid, *points)
    for found, form, vertex in ((low, of_front, 0.0), (high, of_back, 3.0)):
        expected = [
            float(form(mpmath.mpf(float(x)), mpmath.mpf(float(y)))) + vertex
            for x, y in zip(*points, strict=True)
        ]
        assert np.abs(found - expected).max() < 1e-6  # mm


def test_a_biconvex_lens_has_the_volume_of_two_caps_and_a_cylinder():
    (element,) = glass_elements(singlet(SPHERE, {"type": "sphere", "radius": -30.0}, 4.0))
    caps, edge = 0.0, 4.0
    for radius in (20.0, 30.0):
        height = radius - math.sqrt(radius**2 - 25.0)
        caps += math.pi * height**2 * (3.0 * radius - height) / 3.0
        edge -= height
    solid = element_solid(element, 1e-5)
    assert modeller.volume(solid) == pytest.approx(caps + math.pi * 25.0 * edge, rel=1e-9)
    a, b, c = triangles(solid).transpose(1, 0, 2)
    enclosed = (a * np.cross(b, c)).sum() / 6.0
    assert enclosed == pytest.approx(caps + math.pi * 25.0 * edge, rel=0.01)
    assert element.edge_thickness == pytest.approx(edge, rel=1e-12)


def test_a_smaller_surface_ends_in_a_flat_ring():
    small = {"type": "sphere", "radius": -10.0, "semi_diameter": 3.0}
    (element,) = glass_elements(singlet(small, PLANE, 1.0))
    sag = 10.0 - math.sqrt(91.0)
    hollow = math.pi * sag**2 * (30.0 - sag) / 3.0
    # The rim of the hollow front lies towards the light, and so does the ring around it.
    whole = math.pi * 25.0 * (1.0 + sag) - hollow
    assert modeller.volume(element_solid(element, 1e-5)) == pytest.approx(whole, rel=1e-9)


def test_where_a_flat_would_cut_the_glass_the_edge_is_a_cone():
    steep = {"type": "sphere", "radius": 4.0, "semi_diameter": 3.0}
    (element,) = glass_elements(singlet(steep, {"type": "sphere", "radius": -12.0}, 1.9))
    assert element.conical_edge and element.fault() is None
    r = np.linspace(0.0, 5.0, 200_001)
    rim, end = 4.0 - math.sqrt(7.0), 1.9 - 12.0 + math.sqrt(119.0)
    front = np.where(
        r <= 3.0, 4.0 - np.sqrt(16.0 - np.minimum(r, 3.0) ** 2), rim + (end - rim) * (r - 3.0) / 2.0
    )
    back = 1.9 - 12.0 + np.sqrt(144.0 - r**2)
    expected = np.trapezoid(2.0 * np.pi * r * (back - front), r)
    assert modeller.volume(element_solid(element, 1e-5)) == pytest.approx(expected, rel=1e-7)


def test_a_tilted_element_lies_where_its_pose_puts_it(tmp_path):
    lens = singlet(
        PLANE, PLANE, elements={"plate": {"surfaces": [1, 2], "tilt_x": 10.0, "decenter_y": 0.5}}
    )
    result = export_step(lens, tmp_path / "lens.step")
    assert max(error.largest for error in result.errors) < 1e-3
    low, high = heights(result.solids["E1"], [0.0, 0.0], [0.5, 1.5])
    # Turned about x by the right hand: +z goes towards -y, so z grows with y.
    angle = math.radians(10.0)
    assert low == pytest.approx([0.0, math.tan(angle)], abs=1e-9)
    assert high - low == pytest.approx([3.0 / math.cos(angle)] * 2, abs=1e-9)
    assert result.volumes["E1"] == pytest.approx(math.pi * 25.0 * 3.0, rel=1e-9)


def test_a_wedge_between_two_tilted_surfaces_is_cut_from_one_cylinder(tmp_path):
    lens = singlet(PLANE, PLANE, elements={"wedge": {"surfaces": [2, 2], "tilt_x": 2.0}})
    result = export_step(lens, tmp_path / "lens.step")
    assert result.volumes["E1"] == pytest.approx(math.pi * 25.0 * 3.0, rel=1e-7)
    low, high = heights(result.solids["E1"], [0.0, 0.0], [-4.0, 4.0])
    assert high - low == pytest.approx(3.0 + math.tan(math.radians(2.0)) * np.array([-4, 4]))


def test_rectangular_faces_make_a_rectangular_edge(tmp_path):
    sides = {"semi_diameter": None, "aperture": {"half_width_x": 4.0, "half_width_y": 2.0}}
    result = export_step(singlet({**PLANE, **sides}, {**PLANE, **sides}), tmp_path / "lens.step")
    assert result.volumes["E1"] == pytest.approx(8.0 * 4.0 * 3.0, rel=1e-9)


def test_cemented_elements_share_a_surface_and_stops_are_no_solids(tmp_path, points):
    lens = lens_of_rows(
        (20.0, 3.0, GLASS),
        (-18.0, 2.0, "1.62/36.37"),
        (-60.0, 2.0, "air"),
        {"type": "aperture", "semi_diameter": 3.0},
    )
    result = export_step(lens, tmp_path / "lens.step")
    names = [product_name(element) for element in result.elements]
    assert list(read_step_file(tmp_path / "lens.step")) == names
    assert names == ["E1 (surfaces 1-2) 1.5168/64.17", "E2 (surfaces 2-3) 1.62/36.37"]
    behind, before = heights(result.solids["E1"], *points)[1], heights(result.solids["E2"], *points)
    assert np.abs(behind - before[0]).max() < 1e-9


def test_a_spline_surface_goes_into_the_file_as_it_is(tmp_path):
    generator = torch.Generator().manual_seed(1)
    numbers = 0.02 * torch.rand(9, 8, generator=generator, dtype=torch.float64)
    freeform = {"type": "b_spline", "half_width_x": 5.0, "half_width_y": 5.5,
                "coefficients": numbers.tolist()}  # fmt: skip
    result = export_step(singlet(PLANE, freeform), tmp_path / "lens.step")
    assert result.errors[1].kind == "spline" and result.errors[1].largest < 1e-3


def test_the_measurement_sees_a_surface_that_is_wrong():
    (right,) = glass_elements(singlet(SPHERE, PLANE))
    (wrong,) = glass_elements(singlet({"type": "sphere", "radius": 20.01}, PLANE))
    front, back = sag_errors(right, element_solid(wrong, 1e-5))
    expected = (20.0 - math.sqrt(375.0)) - (20.01 - math.sqrt(20.01**2 - 25.0))
    assert front.largest == pytest.approx(1e6 * expected, rel=1e-6)  # nm
    assert back.largest < 1e-6


def test_glass_whose_surfaces_cross_is_left_out_with_one_line(tmp_path):
    thin = singlet(SPHERE, {"type": "sphere", "radius": -20.0}, 1.0)
    with pytest.raises(InputError, match=r"E1 \(surfaces 1-2\): its surfaces cross") as caught:
        export_step(thin, tmp_path / "lens.step")
    assert "\n" not in str(caught.value)
    exported = export_lens(thin, tmp_path, ["yaml", "step"])
    assert list(exported.files) == ["lens.yaml"] and "cross" in exported.refused["step"]


def test_without_the_modeller_one_line_says_how_to_install_it(monkeypatch, tmp_path):
    def missing(name):
        raise ModuleNotFoundError(f"No module named '{name}'", name="OCP")

    monkeypatch.setattr(modeller.importlib, "import_module", missing)
    with pytest.raises(InputError, match=r"pip install 'dolens\[cad\]'"):
        export_step(singlet(SPHERE, PLANE), tmp_path / "lens.step")


def test_a_format_that_cannot_hold_the_lens_is_named_and_the_others_are_written(tmp_path):
    exported = export_lens(load_lens("freeform_corrector"), tmp_path, ["yaml", "zmx"])
    assert list(exported.files) == ["lens.yaml"]
    assert ": a .zmx file cannot hold type 'b_spline' (allowed: " in exported.refused["zmx"]


def test_only_what_faces_the_eye_is_drawn():
    """Of a box three sides show: those towards larger z, smaller x and larger y."""
    corners = triangles(modeller.box((0.0, 0.0, 0.0), (1.0, 2.0, 3.0)))
    shown = corners[visible(corners[:, :, [2, 0, 1]])]
    assert len(corners) == 12 and len(shown) == 6
    sides = {
        (axis, float(c[0, axis])) for c in shown for axis in range(3) if np.ptp(c[:, axis]) == 0
    }
    assert sides == {(2, 3.0), (0, 0.0), (1, 2.0)}
