"""Checks of a found lens agree with what other parts of the tree, or geometry, say of it."""

import copy
import math
from dataclasses import replace

import pytest
import torch

from dolens import load_lens
from dolens.errors import InputError
from dolens.lens_page.overview import prepared_lens
from dolens.lens_search.real_beams import real_beams, spaces, with_drawn_heights
from dolens.lens_search.specification import Limits, Specification
from dolens.lens_search.verification import Check, Requirements, verify
from dolens.optics.surfaces.clear_aperture import Circle
from dolens.optimize.operands import LensProperties, operand
from tests.lenses import GLASS, lens_of_rows

FIELDS, RAYS = 3, 40


@pytest.fixture(scope="module")
def checked(triplet):
    required = Requirements(50.0, f_number=4.9, total_track=60.0, back_focus=40.0, vignetting=0.5)
    return verify(triplet, required, FIELDS, RAYS)


def test_chief_rays_are_those_of_the_operands(triplet, checked):
    properties = LensProperties(triplet.system(), 587.5618, None)
    found = {check.name: check for check in checked.checks}
    for name, kind in (("distortion", "distortion"), ("chief-ray angle", "chief_ray_angle")):
        values = [
            float(value)
            for angle in (10.0, 20.0)
            for value in operand({"kind": kind, "target": 0.0, "field": (0.0, angle)}, triplet)
            .values(properties)
            .values()
        ]
        assert found[name].value == pytest.approx(max(values, key=abs), rel=1e-9)
    assert found["chief-ray angle"].place == "field 20°"


def test_first_order_numbers_and_lengths_are_compared_with_what_is_asked_for(checked):
    assert checked.value("focal length") == pytest.approx(50.019, abs=5e-4)
    assert checked.value("F-number") == pytest.approx(4.93, rel=0.02)
    assert checked.value("total track") == pytest.approx(60.177)
    assert [check.name for check in checked.broken] == ["total track"]
    assert not checked.holds
    with pytest.raises(InputError, match="no quantity 'weight'"):
        checked.value("weight")


def test_apertures_that_clip_are_vignetting(triplet):
    def vignetted(semi_diameter):
        lens = copy.deepcopy(triplet)
        surface = lens.surfaces["6"]
        surface.aperture = replace(surface.aperture, edge=Circle(semi_diameter))
        return verify(lens, Requirements(), FIELDS, RAYS)

    narrow, wide = vignetted(4.0), vignetted(20.0)
    assert narrow.value("vignetting") > 20.0 > wide.value("vignetting")
    broken = {check.name: check for check in narrow.broken}
    assert broken["vignetting"].place == "field 20°"
    assert wide.value("rays that fail") == 0.0


def singlets(gap):
    """Two meniscus lenses whose neighbouring surfaces bulge towards each other."""
    rows = [(80.0, 5.0, GLASS), (-40.0, gap, "air"), (40.0, 5.0, GLASS), (-80.0, 0.0, "air")]
    fields = {"angles": [[0, 0], [0, 5]]}
    return lens_of_rows(
        *rows, semi_diameter=12.0, sensor=20.0, wavelengths=[587.5618], fields=fields
    )


def test_surfaces_that_cross_within_the_beam_are_found():
    apart, crossing = (verify(singlets(gap), Requirements(), FIELDS, RAYS) for gap in (1.0, -1.0))
    assert apart.value("shortest ray segment") == pytest.approx(1.0, rel=1e-9)
    # Vertices stand apart by -1 mm, and so does the axial ray.
    assert crossing.value("shortest ray segment") == pytest.approx(-1.0, rel=1e-9)
    names = {check.name for check in crossing.broken}
    assert {"shortest ray segment", "smallest air space"} <= names
    assert not {"shortest ray segment", "smallest air space"} & {c.name for c in apart.broken}


def test_a_stop_within_glass_is_found():
    """A concave surface with a sag of some 1.7 mm at the beam's edge, in front of the stop."""

    def made(gap):
        rows = (
            (60.0, 4.0, GLASS),
            {"radius": 20.0, "semi_diameter": 10.0, "thickness": gap},
            {"type": "aperture", "semi_diameter": 8.0, "thickness": 8.0},
            (90.0, 4.0, GLASS),
            (-40.0, 0.0, "air"),
        )
        fields = {"angles": [[0, 0], [0, 2]]}
        return lens_of_rows(*rows, semi_diameter=12.0, sensor=60.0, stop=3, fields=fields)

    asked = Requirements(stop_to_glass=0.0)
    inside, clear = (verify(made(gap), asked, FIELDS, RAYS) for gap in (1.0, 3.0))
    found = {check.name: check for check in inside.checks}
    assert found["stop to glass"].holds is False and found["shortest ray segment"].holds is True
    assert clear.value("stop to glass") > 0.0
    height = float(inside.beams.heights[1])
    sag = 20.0 - math.sqrt(20.0**2 - height**2)
    assert found["stop to glass"].value == pytest.approx(1.0 - sag, rel=1e-6)


def test_thicknesses_are_taken_where_beams_end():
    """Sags of spheres by Pythagoras; a flat leads out to the edge of an element."""
    heights = torch.tensor([10.0, 8.0, 6.0, 9.0], dtype=torch.float64)
    first, air, second = spaces(singlets(1.0), heights)

    def sag(radius, height):
        return radius - math.copysign(math.sqrt(radius**2 - height**2), radius)

    assert (first.first, first.last, first.glass, first.centre) == (1, 2, True, 5.0)
    assert first.edge == pytest.approx(5.0 + sag(-40.0, 8.0) - sag(80.0, 10.0), rel=1e-12)
    assert second.edge == pytest.approx(5.0 + sag(-80.0, 9.0) - sag(40.0, 6.0), rel=1e-12)
    # Between them it is least on the axis.
    assert (air.glass, air.edge) == (False, 1.0)


def test_a_stop_between_elements_parts_no_air_space():
    gauss = load_lens("double_gauss").requires_grad_(False)
    found = spaces(gauss, torch.full((11,), 10.0, dtype=torch.float64))
    assert [(space.first, space.last) for space in found if not space.glass] == [
        *((2, 3), (5, 7), (9, 10)),
    ]
    assert found[4].centre == pytest.approx(11.41 + 9.0)


def test_surfaces_are_drawn_as_far_as_their_beams_go():
    lens = lens_of_rows(
        {"type": "aperture", "semi_diameter": 3.0, "thickness": 10.0},
        {"type": "plane", "thickness": 5, "material": "1.5"},
        (-30.0, 0.0, "air"),
        semi_diameter="auto",
        sensor=60.0,
        stop=1,
        fields={"angles": [[0, 0], [0, 10]]},
    )
    heights = real_beams(lens, FIELDS, RAYS).heights
    # From the edge of the stop upwards at 10°.
    assert float(heights[1]) == pytest.approx(3.0 + 10.0 * math.tan(math.radians(10.0)), rel=1e-3)
    drawn = with_drawn_heights(lens, heights)
    assert drawn.surfaces["2"].semi_diameter == pytest.approx(1.02 * float(heights[1]))
    assert drawn.surfaces["1"].semi_diameter == 3.0


def test_an_asphere_is_checked_within_its_beam():
    """A plane plate with r⁴ behind it, in a beam of 10 mm: z = a·r⁴ has the slope 4a·r³ at the rim,
    and comes nearer to the sensor by its sag there.
    """
    lens = lens_of_rows(
        {"type": "plane", "thickness": 1e-3, "material": "1.5"},
        {"type": "even_asphere", "radius": 1e12, "a4": 1e-3, "semi_diameter": 6.0},
        sensor={"distance": 3.0, "diameter": 50.0},
        wavelengths=[587.5618],
        fields={"angles": [[0.0, 0.0], [0.0, 0.1]]},
    )
    found = verify(lens, Requirements(slope=20.0, back_focus=2.5, vignetting=None), 2, 40)
    height = float(found.beams.heights[1])
    assert height == pytest.approx(5.0, rel=1e-3)
    slope = math.degrees(math.atan(4e-3 * height**3))
    assert found.value("steepest slope") == pytest.approx(slope, rel=1e-9)
    assert found.value("back focus") == pytest.approx(3.0 - 1e-3 * height**4, rel=1e-9)
    assert {"steepest slope", "back focus"} <= {check.name for check in found.broken}


def test_what_cannot_be_computed_keeps_no_limit():
    assert Check("track", math.nan, "mm", most=1.0).holds is False
    assert Check("track", math.nan, "mm").holds is None
    assert Check("track", 1.0005, "mm", most=1.0).holds is True
    assert Check("track", 1.002, "mm", most=1.0).holds is False


def test_requirements_follow_from_the_specification_of_a_search():
    specification = Specification(
        100.0,
        3.0,
        (0.0, 15.0),
        (587.5618,),
        (1, 1),
        ("1.5168",),
        limits=Limits(track=250.0),
        vignetting=0.3,
    )
    required = Requirements.of(specification)
    assert (required.focal_length, required.f_number, required.total_track) == (100.0, 3.0, 250.0)
    assert required.distortion == 1.0 and required.glass_centre == (2.0, 120.0)
    assert required.vignetting == 0.3


def test_a_lens_for_the_axis_alone_is_checked_there(triplet):
    """Its beam is narrower than those of its full field, and clipped by nothing."""
    alone = prepared_lens(triplet, [(0.0, 0.0)])
    found = verify(alone, Requirements(50.0, f_number=4.9, total_track=61.0), FIELDS, RAYS)
    assert found.holds and found.value("vignetting") == 0.0
    assert abs(found.value("chief-ray angle")) < 0.001
    pupil = 0.5 * alone.first_order().entrance_pupil.diameter.item()
    assert found.beams.heights[0].item() == pytest.approx(pupil, rel=0.02)
    assert pupil < 0.6 * alone.surfaces["1"].semi_diameter
