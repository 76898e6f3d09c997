"""Field curves, lateral colour and focal shift, against closed forms and another program."""

import numpy as np
import pytest
import torch

from dolens import load_lens
from dolens.analysis.conditions import field_scans
from dolens.analysis.field_curves import field_curves
from dolens.analysis.lateral_colour import chromatic_focal_shift, lateral_colour
from dolens.errors import InputError
from dolens.prescriptions import lens_from_prescription

LINES = (656.2725, 587.5618, 486.1327)
GLASS = "1.5168/64.17"


def single_sphere(radius=20.0, glass=1.5, distance=55.0):
    """One refracting sphere with its stop at the vertex; the sensor is in the glass."""
    row = {"type": "sphere", "radius": radius, "semi_diameter": 2.0, "material": glass}
    return lens_from_prescription({"surfaces": {"1": row}, "sensor": {"distance": distance}})


def plate_behind_a_stop(glass, thickness=5.0, gap=10.0):
    plane = {"type": "plane", "semi_diameter": 30.0}
    stop = {"type": "plane", "semi_diameter": 1.0, "material": "air", "thickness": 4.0}
    return lens_from_prescription(
        {
            "stop": 1,
            "surfaces": {
                "1": stop,
                "2": {**plane, "material": glass, "thickness": thickness},
                "3": {**plane, "material": "air"},
            },
            "sensor": {"distance": gap},
        }
    )


def scan(lens, edge, count=5, distance=None):
    return field_scans(lens, distance, edge, count)[0]


def test_foci_of_one_sphere_are_coddington_s():
    """n'cos²I'/t' = n'/s' = (n'cos I' - cos I)/R, along a chief ray through the vertex."""
    lens, radius, n = single_sphere(), 20.0, 1.5
    found = field_curves(lens, scan(lens, 30.0), [587.5618])
    incidence = np.radians(np.linspace(0.0, 30.0, 5))
    refracted = np.arcsin(np.sin(incidence) / n)
    power = (n * np.cos(refracted) - np.cos(incidence)) / radius
    sagittal = n / power * np.cos(refracted) - 55.0
    tangential = n * np.cos(refracted) ** 2 / power * np.cos(refracted) - 55.0
    np.testing.assert_allclose(found.sagittal[:, 0], sagittal, atol=1e-9)
    np.testing.assert_allclose(found.tangential[:, 0], tangential, atol=1e-9)


def test_field_curves_of_the_triplet_are_those_of_optiland(root, reference):
    expected = reference("field_curves_optiland.json")
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml")
    found = field_curves(lens, scan(lens, 20.0, 9), [587.5618])
    assert found.scan.coordinate.tolist() == pytest.approx(expected["field_deg"])
    np.testing.assert_allclose(found.tangential[:, 0], expected["tangential_mm"], atol=1e-7)
    np.testing.assert_allclose(found.sagittal[:, 0], expected["sagittal_mm"], atol=1e-7)
    np.testing.assert_allclose(found.distortion, expected["distortion_percent"], atol=1e-5)


def test_lateral_colour_of_the_triplet_is_that_of_optiland_s_chief_rays(root, reference):
    heights = reference("field_curves_optiland.json")["chief_height_mm"]
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml")
    found = lateral_colour(lens, scan(lens, 20.0, 9), LINES)
    for number, line in enumerate("CdF"):
        expected = 1e3 * (np.array(heights[line]) - np.array(heights["d"]))
        np.testing.assert_allclose(found.shift_um[:, number], expected, atol=1e-5)


def test_a_plate_distorts_and_disperses_by_snell_s_law():
    lens = plate_behind_a_stop(GLASS)
    fields = np.radians(np.linspace(0.0, 40.0, 5))
    index = {line: float(lens.materials[2].index(line)) for line in LINES}

    def height(line):
        inside = np.arcsin(np.sin(fields) / index[line])
        return 14.0 * np.tan(fields) + 5.0 * np.tan(inside)

    found = lateral_colour(lens, scan(lens, 40.0), LINES)
    for number, line in enumerate(LINES):
        expected = 1e3 * (height(line) - height(587.5618))
        np.testing.assert_allclose(found.shift_um[:, number], expected, atol=1e-8)
    ideal = (14.0 + 5.0 / index[587.5618]) * np.tan(fields)
    distortion = field_curves(lens, scan(lens, 40.0), LINES).distortion
    assert float(distortion[0]) == 0.0
    expected = 100.0 * (height(587.5618)[1:] / ideal[1:] - 1.0)
    np.testing.assert_allclose(distortion[1:], expected, atol=1e-9)


def test_the_image_of_a_near_object_is_compared_with_its_magnification():
    """A stop alone is a pinhole: it images without distortion, upside down."""
    lens = plate_behind_a_stop("air")
    found = field_curves(lens, scan(lens, 50.0, distance=100.0), LINES[:1])
    assert found.scan.field_unit == "mm"
    np.testing.assert_allclose(found.distortion, 0.0, atol=1e-9)


def test_focal_shift_of_one_sphere_is_that_of_its_index():
    """The focus of a sphere lies n·R/(n - 1) behind it."""
    lens = single_sphere(glass=GLASS)
    found = chromatic_focal_shift(lens, (486.1327, 656.2725), 3)
    focus = [20.0 * n / (n - 1.0) for n in map(lens.materials[1].index, found.wavelengths.tolist())]
    n = lens.materials[1].index(587.5618)
    expected = 1e3 * (np.array(focus) - 20.0 * n / (n - 1.0))
    np.testing.assert_allclose(found.shift_um, expected, atol=1e-6)
    with pytest.raises(InputError, match="shorter"):
        chromatic_focal_shift(lens, (600.0, 500.0))


def test_a_lens_without_symmetry_is_scanned_along_both_axes(root):
    lens = load_lens(root / "conf/lens/freeform_corrector.yaml")
    along_y, along_x = field_scans(lens, None, 2.0, 3)
    assert (along_y.axis, along_x.axis) == ("y", "x")
    assert along_y.coordinate.tolist() == [-2.0, -1.0, 0.0, 1.0, 2.0]
    in_y, in_x = (field_curves(lens, one, [587.5618]) for one in (along_y, along_x))
    # The singlet is tilted about x: mirror symmetry is left in x alone.
    assert torch.allclose(in_x.tangential, in_x.tangential.flip(0), atol=1e-9)
    assert (in_y.tangential - in_y.tangential.flip(0)).abs().max() > 0.1


def test_chief_rays_that_do_not_arrive_leave_gaps():
    """From glass into air, light beyond 41° is reflected totally."""
    row = {"type": "plane", "semi_diameter": 1.0, "material": "air"}
    lens = lens_from_prescription(
        {"object_material": GLASS, "surfaces": {"1": row}, "sensor": {"distance": 5.0}}
    )
    found = field_curves(lens, scan(lens, 80.0, 3), [587.5618])
    for values in (found.tangential[:, 0], found.sagittal[:, 0], found.distortion):
        assert torch.isnan(values).tolist() == [False, False, True]
