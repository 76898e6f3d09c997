"""Beams on the surfaces of lenses, and what apertures take of them."""

import math

import pytest
import torch

from dolens import load_lens
from dolens.analysis.conditions import conditions, field_scans
from dolens.analysis.field_curves import field_curves
from dolens.analysis.footprint import footprint
from dolens.errors import InputError
from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture
from tests.diffraction.perfect_lenses import pinhole


def test_a_parallel_beam_keeps_its_size_and_moves_by_the_tangent():
    """Behind a hole of radius 2 the field of 10° meets a plane 20 mm on at 20·tan 10°."""
    lens = pinhole(2.0, second=(20.0, 50.0))
    found = footprint(lens, conditions(lens, [(0.0, 0.0), (0.0, 10.0)]), 500.0, 400)
    assert found.surfaces == (1, 2)
    shift = 20.0 * math.tan(math.radians(10.0))
    assert found.points[1, 1].mean(0).tolist() == pytest.approx([0.0, shift], abs=2e-3)
    # The rim of the stop is among the rays.
    assert found.extent[:, 0].tolist() == pytest.approx([2.0, 2.0], rel=1e-3)
    assert float(found.extent[1, 1]) == pytest.approx(2.0 + shift, rel=1e-3)
    assert bool(found.passes.all()) and float(found.clipped.sum()) == 0.0


def test_an_aperture_stops_its_share_of_the_light():
    """A second hole of the same radius a, shifted by d: two circles overlap by a known area."""
    a, gap, angle = 2.0, 10.0, 8.0
    lens = pinhole(a, second=(gap, a))
    found = footprint(
        lens,
        conditions(lens, [(0.0, angle)]),
        500.0,
        4000,
    )
    d = gap * math.tan(math.radians(angle))
    overlap = 2.0 * math.acos(d / (2 * a)) - d / (2 * a * a) * math.sqrt(4 * a * a - d * d)
    assert float(found.clipped[1, 0]) == pytest.approx(1.0 - overlap / math.pi, abs=2e-3)
    weight = float((found.weight * found.passes[0]).sum())
    assert weight == pytest.approx(overlap / math.pi, abs=2e-3)
    # Rays that end there are shown outside of its edge, and no farther.
    ends = found.points[1, 0][~found.passes[0]]
    assert float(ends.norm(dim=-1).min()) >= a


def test_an_obscuration_ends_the_middle_of_the_beam():
    lens = pinhole(2.0, second=(10.0, ClearAperture(Circle(9.0), Circle(1.0))))
    found = footprint(lens, conditions(lens, [(0.0, 0.0)]), 500.0, 4000)
    assert float(found.clipped[1, 0]) == pytest.approx(0.25, abs=2e-3)
    assert float(found.points[1, 0][found.passes[0]].norm(dim=-1).min()) >= 1.0


def test_a_folded_beam_is_seen_in_the_mirror_s_own_axes(root):
    """The Newtonian's flat at 45° is met over √2 the height: an ellipse, in the mirror's plane."""
    lens = load_lens(root / "conf/lens/published/newtonian_200_f5.yaml").requires_grad_(False)
    found = footprint(lens, conditions(lens, [(0.0, 0.0)]), rays=1000)
    assert found.surfaces == (1, 2, 3, 5)
    x, y = found.points[3, 0][found.passes[0]].unbind(-1)
    # The cone is 200·200/1000 mm wide there, and slopes.
    assert float(x.abs().max()) == pytest.approx(20.0, rel=0.02)
    assert float(y.max() - y.min()) == pytest.approx(2.0 * 20.0 * math.sqrt(2.0), rel=0.02)


def test_a_fisheye_s_edge_of_the_field_gets_through(root):
    """Its surfaces have the sizes that 85° needs, though the paraxial pupil's rays miss them."""
    lens = load_lens(root / "conf/lens/published/fisheye_laikin_p114.yaml").requires_grad_(False)
    found = footprint(lens, conditions(lens, [(0.0, 85.0)]), rays=40)
    assert float(found.passes.double().mean()) > 0.9
    sizes = torch.tensor([surface.semi_diameter for surface in lens.surfaces.values()])
    # The stop's is its own.
    beyond = found.extent[:, 0] - sizes
    beyond[lens.stop - 1] = 0.0
    assert bool((beyond < 1e-2 * sizes).all())


def test_a_scan_lens_is_without_distortion_from_f_theta(root):
    """That of Laikin's p. 251 is corrected for f·θ, at most 0.075 % and nil at 15°; from f·tan θ it
    has θ/tan θ - 1.  Numbers: Optiland 0.6.3 (`Distortion`, `f-theta`), index 1.839565724 for SF57.
    """
    lens = load_lens(root / "conf/lens/published/ftheta_laikin_p251.yaml").requires_grad_(False)
    (scan,) = field_scans(lens, None, 15.0, 11)
    theta = field_curves(lens, scan, [632.8], "f_theta").distortion
    tangent = field_curves(lens, scan, [632.8]).distortion
    optiland = (0.002651, 0.010355, 0.022345, 0.037280, 0.053146)
    optiland += (0.067097, 0.075222, 0.072205, 0.050823, 0.001209)
    assert theta[1:].tolist() == pytest.approx(optiland, abs=2e-5)
    assert float(tangent[-1]) == pytest.approx(-2.293957, abs=2e-5)
    angle = torch.deg2rad(scan.coordinate[1:])
    ratio = (1.0 + tangent[1:] / 100.0) / (1.0 + theta[1:] / 100.0)
    assert torch.allclose(ratio, angle / angle.tan(), atol=1e-12)


def test_f_theta_is_that_of_fields_in_degrees():
    lens = pinhole(1.0)
    (scan,) = field_scans(lens, None, 30.0, 3)
    # A pinhole images by the tangent.
    found = field_curves(lens, scan, [500.0], "f_theta").distortion
    angle = math.radians(30.0)
    assert float(found[-1]) == pytest.approx(100.0 * (math.tan(angle) / angle - 1.0))
    (near,) = field_scans(lens, 100.0, 5.0, 3)
    with pytest.raises(InputError, match="object at infinity"):
        field_curves(lens, near, [500.0], "f_theta")
    with pytest.raises(InputError, match=r"distortion: 'fisheye' .*f_tan_theta, f_theta"):
        field_curves(lens, scan, [500.0], "fisheye")
