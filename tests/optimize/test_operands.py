"""Operands give a lens's own numbers, and deviations only where something is amiss."""

import math

import pytest
import torch

from dolens import Rays, load_lens
from dolens.optimize.operands import LensProperties, operand
from dolens.prescriptions import lens_from_prescription

D_LINE = 587.5618


def values(lens, object_distance=None, **settings):
    made = operand({"target": 0.0, **settings}, lens)
    found = made.values(LensProperties(lens.system(), D_LINE, object_distance))
    return {label: float(value.detach()) for label, value in found.items()}


@pytest.fixture
def triplet(root):
    return load_lens(root / "conf/lens/cooke_triplet.yaml")


def test_first_order_operands_are_the_lens_s(triplet, reference):
    """EFL, BFD and F-number of tests/reference/first_order.json, by an independent program."""
    first = triplet.first_order(D_LINE)
    for kind in ("efl", "bfd", "f_number", "working_f_number", "magnification"):
        assert values(triplet, kind=kind) == {kind: float(getattr(first, kind).detach())}
    assert values(triplet, kind="efl")["efl"] == pytest.approx(50.019, abs=5e-4)


def test_lengths(triplet):
    """From the prescription; at the rim, sags of spheres by Pythagoras."""
    assert values(triplet, kind="total_track")["total_track"] == pytest.approx(
        3.259 + 6.008 + 1.0 + 4.75 + 2.952 + 42.208, rel=1e-12
    )
    glass = values(triplet, kind="centre_thickness")
    assert glass == pytest.approx(
        {"centre_thickness/1": 3.259, "centre_thickness/3": 1.0, "centre_thickness/5": 2.952}
    )
    assert values(triplet, kind="air_gap") == pytest.approx({"air_gap/2": 6.008, "air_gap/4": 4.75})
    assert values(triplet, kind="air_gap", gaps=[1]) == pytest.approx({"air_gap/1": 3.259})

    def sag(radius, height):
        return radius - math.copysign(math.sqrt(radius**2 - height**2), radius)

    edge = values(triplet, kind="edge_thickness")
    assert edge["edge_thickness/1"] == pytest.approx(
        3.259 + sag(-435.76, 9.5) - sag(22.014, 9.5), rel=1e-12
    )
    assert edge["edge_thickness/3"] == pytest.approx(
        1.0 + sag(20.292, 3.86) - sag(-22.213, 4.0), rel=1e-12
    )
    gap = values(triplet, kind="edge_air_gap")["edge_air_gap/2"]
    assert gap == pytest.approx(6.008 + sag(-22.213, 4.0) - sag(-435.76, 9.5), rel=1e-12)


def test_a_plate_behind_a_stop_passes_the_chief_ray_at_its_own_angle():
    plate = lens_from_prescription(
        {
            "surfaces": {
                "1": {
                    "type": "aperture",
                    "semi_diameter": 1.0,
                    "thickness": 5.0,
                    "material": "air",
                },
                "2": {"type": "plane", "semi_diameter": 9.0, "thickness": 3.0, "material": 1.5},
                "3": {"type": "plane", "semi_diameter": 9.0, "material": "air"},
            },
            "stop": 1,
            "sensor": {"distance": 10.0},
        }
    )
    for field in ([0, 20], [15, 0]):
        (angle,) = values(plate, kind="chief_ray_angle", field=field).values()
        assert angle == pytest.approx(max(field), rel=1e-12)


@pytest.mark.parametrize("field", [(0.0, 18.0), (12.0, 9.0)])
def test_distortion_and_chief_ray_angle_of_real_rays(triplet, field):
    """Against the chief ray as a user traces it: height over f·tan θ."""
    hit = triplet.trace(Rays(*vars_of(triplet.chief_ray(field, D_LINE))))
    height = float(hit.position[:2].detach().norm())
    ideal = float(triplet.first_order(D_LINE).efl.detach()) * math.hypot(
        *(math.tan(math.radians(angle)) for angle in field)
    )
    (distortion,) = values(triplet, kind="distortion", field=field).values()
    assert distortion == pytest.approx(100.0 * (height / ideal - 1.0), rel=1e-9)
    (angle,) = values(triplet, kind="chief_ray_angle", field=field).values()
    assert math.cos(math.radians(angle)) == pytest.approx(
        float(hit.direction[2].detach()), rel=1e-12
    )


def vars_of(rays):
    return rays.position, rays.direction, D_LINE


def test_limits_cost_nothing_within_and_the_excess_beyond(triplet):
    for settings, value, deviation in (
        ({"target": 2.0}, 5.0, 3.0),
        ({"target": 2.0}, 1.0, -1.0),
        ({"min": 2.0}, 5.0, 0.0),
        ({"min": 2.0}, 1.5, -0.5),
        ({"max": 2.0}, 5.0, 3.0),
        ({"min": 1.0, "max": 2.0}, 1.5, 0.0),
    ):
        made = operand({"kind": "efl", **settings}, triplet)
        found = made.deviation(torch.tensor(value, dtype=torch.float64))
        assert float(found) == pytest.approx(deviation, abs=1e-15)
