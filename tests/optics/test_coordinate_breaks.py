"""Coordinate breaks: what they do to axes, to light, and to the numbers of a folded lens."""

import math

import pytest
import torch

from dolens import Rays
from dolens.errors import InputError
from dolens.optics.elements import rotation_matrix
from dolens.prescriptions import lens_from_prescription, prescription_of
from tests.kernels.trace_cases import LENSES, bundle

F64 = torch.float64
AXIS = torch.tensor([0.0, 0.0, 1.0], dtype=F64)


def broken(**row):
    return {"type": "coordinate_break", **row}


def flat(material="mirror", size=50.0, **row):
    return {"type": "plane", "semi_diameter": size, "material": material, **row}


def lens_of(rows, distance=10.0, **more):
    surfaces = {str(n): row for n, row in enumerate(rows, 1)}
    prescription = {"surfaces": surfaces, "sensor": {"distance": distance}}
    stop = next(n for n, row in enumerate(rows, 1) if row["type"] != "coordinate_break")
    return lens_from_prescription({**prescription, "stop": stop, **more})


def newtonian(tilt=45.0):
    """A paraboloid of f = 1000, folded 200 mm before its focus."""
    conic = {"type": "conic", "radius": -2000.0, "conic": -1.0, "semi_diameter": 100.0,
             "material": "mirror", "thickness": -800.0}  # fmt: skip
    fold = [broken(tilt_x=tilt, thickness=0.0), flat(thickness=0.0), broken(tilt_x=tilt)]
    return lens_of([conic, *fold], 200.0)


def turn(**degrees):
    angles = [math.radians(degrees.get(axis, 0.0)) for axis in "xyz"]
    return rotation_matrix(*(torch.tensor(a, dtype=F64) for a in angles))


def test_axes_move_and_then_turn_about_x_y_and_z():
    lens = lens_of(
        [broken(decenter_x=1.0, decenter_y=2.0, tilt_x=10.0, tilt_y=20.0, tilt_z=30.0,
                thickness=5.0), flat("air")]
    )  # fmt: skip
    found = lens.global_axes()
    r = turn(x=10.0) @ turn(y=20.0) @ turn(z=30.0)
    at = torch.tensor([1.0, 2.0, 0.0], dtype=F64)
    assert torch.allclose(found.rotation[1], r, rtol=0.0, atol=1e-15)
    assert torch.allclose(found.origin[0], at, rtol=0.0, atol=1e-15)
    assert torch.allclose(found.origin[1], at + 5.0 * r[:, 2], rtol=0.0, atol=1e-14)
    assert torch.allclose(found.origin[2], at + 15.0 * r[:, 2], rtol=0.0, atol=1e-14)


def test_tilt_first_undoes_what_decenter_first_did():
    numbers = {
        "decenter_x": 1.0,
        "decenter_y": -2.0,
        "tilt_x": 10.0,
        "tilt_y": -35.0,
        "tilt_z": 70.0,
    }
    opposite = {name: -value for name, value in numbers.items()}
    lens = lens_of(
        [broken(**numbers, thickness=0.0), flat("air", thickness=0.0),
         broken(**opposite, order="tilt_first", thickness=3.0), flat("air")]
    )  # fmt: skip
    found = lens.global_axes()
    assert torch.allclose(found.rotation[3], torch.eye(3, dtype=F64), rtol=0.0, atol=1e-15)
    assert torch.allclose(found.origin[3], 3.0 * AXIS, rtol=0.0, atol=1e-14)


def test_a_fold_of_45_degrees_sends_light_up():
    """A positive tilt about x turns y towards z, so that the mirror faces -z and +y."""
    lens = lens_of(
        [broken(tilt_x=45.0, thickness=0.0), flat(thickness=0.0), broken(tilt_x=45.0)], -20.0
    )
    hit = lens.trace(Rays(torch.tensor([1.0, 2.0, -10.0], dtype=F64), AXIS), record=True)
    assert lens.system().senses == (1.0, 1.0, -1.0, -1.0)
    # On the mirror y = z; then it goes up to the sensor at y = 20, and is seen in its axes.
    assert torch.allclose(hit.points[1], torch.tensor([1.0, 2.0, 2.0], dtype=F64), atol=1e-14)
    place = lens.global_axes()
    assert torch.allclose(place.origin[-1], torch.tensor([0.0, 20.0, 0.0], dtype=F64), atol=1e-13)
    assert torch.allclose(hit.position, torch.tensor([1.0, 2.0, -20.0], dtype=F64), atol=1e-13)
    assert torch.allclose(hit.direction, -AXIS, atol=1e-15)
    there = place.rotation[-1] @ (hit.position - torch.tensor([0.0, 0.0, -20.0])) + place.origin[-1]
    assert torch.allclose(there, torch.tensor([1.0, 20.0, 2.0], dtype=F64), atol=1e-13)
    assert float(hit.path_length.detach()) == pytest.approx(12.0 + 18.0, abs=1e-13)


@pytest.mark.parametrize("tilt", [45.0, -45.0, 20.0])
def test_a_newtonian_is_as_sharp_as_its_paraboloid(tilt):
    lens = newtonian(tilt)
    k = torch.arange(50, dtype=F64)
    r, angle = 95.0 * ((k + 0.5) / 50).sqrt(), 2.4 * k
    position = torch.stack((r * angle.cos(), r * angle.sin(), torch.full_like(r, -1200.0)), -1)
    for backend in ("reference", "cpu"):
        lens.backend = backend
        hit = lens.trace(Rays(position, AXIS))
        ok = hit.valid
        assert ok.sum() > 40
        assert hit.position[ok, :2].abs().max() < 1e-12
        assert (hit.path_length[ok] - 2200.0).abs().max() < 1e-11


def test_metres_and_folds_keep_ten_digits_behind_the_point():
    """Ten folds of 45°, 10 m apart, with a decentre undone each time: the ray is where it was."""
    rows = []
    for n in range(10):
        rows += [broken(tilt_x=45.0 if n % 2 else -45.0, decenter_x=0.1, thickness=0.0),
                 flat(thickness=0.0, size=2e4),
                 broken(tilt_x=45.0 if n % 2 else -45.0, decenter_x=-0.1,
                        thickness=1e4 if n % 2 else -1e4)]  # fmt: skip
    rows.append(flat("air"))
    lens = lens_of(rows, 0.0)
    x, y = math.pi, math.e
    for backend in ("reference", "cpu"):
        lens.backend = backend
        hit = lens.trace(Rays(torch.tensor([x, y, -1e4], dtype=F64), AXIS))
        assert bool(hit.valid)
        assert abs(float(hit.position[0].detach()) - x) < 1e-10
        assert abs(abs(float(hit.position[1].detach())) - y) < 1e-10


def test_axes_may_turn_back_so_that_thicknesses_stay_positive():
    """Turned by 180° behind a mirror, light comes towards +z again."""
    conic = {"type": "conic", "radius": -200.0, "conic": -1.0, "semi_diameter": 50.0,
             "material": "mirror", "thickness": 0.0}  # fmt: skip
    lens = lens_of([conic, broken(tilt_x=180.0)], 100.0)
    assert lens.system().senses == (1.0, -1.0, 1.0)
    for backend in ("reference", "cpu"):
        lens.backend = backend
        hit = lens.trace(
            Rays(torch.tensor([[0.0, 30.0, -300.0], [20.0, 5.0, -300.0]], dtype=F64), AXIS)
        )
        assert hit.valid.all()
        assert hit.position[:, :2].abs().max() < 1e-12
        assert (hit.direction[:, 2] > 0.0).all()
    assert float(lens.first_order().efl.detach()) == pytest.approx(100.0)
    assert float(lens.first_order().bfd.detach()) == pytest.approx(100.0)


def test_an_off_axis_paraboloid_turns_a_beam_by_90_degrees():
    """The beam is one focal length's double off the axis: reflected, it runs across the axis."""
    f = 50.0
    conic = {"type": "conic", "radius": -2.0 * f, "conic": -1.0, "semi_diameter": 130.0,
             "material": "mirror", "thickness": -f}  # fmt: skip
    stop = {"type": "aperture", "semi_diameter": 10.0, "material": "air", "thickness": 150.0}
    lens = lens_of(
        [stop, broken(decenter_y=-2.0 * f, thickness=0.0), conic,
         broken(tilt_x=90.0, thickness=0.0), flat("air")], 0.0
    )  # fmt: skip
    position = torch.tensor([[0.0, 0.0, 0.0], [5.0, 5.0, 0.0], [-9.0, 1.0, 0.0]], dtype=F64)
    hit = lens.trace(Rays(position, AXIS))
    assert hit.valid.all()
    assert hit.position[:, :2].abs().max() < 1e-12
    assert abs(float(hit.direction[0, 2].detach())) == pytest.approx(1.0)
    rays = lens.marginal_rays((0.0, 0.0))
    assert rays.converged.all()
    assert lens.trace(rays).position[:, :2].abs().max() < 1e-9


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_breaks_that_undo_each_other_leave_a_lens_as_it_is(backend, root):
    lens = LENSES["cooke_triplet"](root)
    prescription = prescription_of(lens)
    rows = list(prescription["surfaces"].values())
    pair = [broken(tilt_x=30.0, tilt_z=10.0, decenter_y=3.0, thickness=0.0),
            broken(tilt_x=-30.0, tilt_z=-10.0, decenter_y=-3.0, order="tilt_first")]  # fmt: skip
    gap = rows[1]["thickness"]
    rows[1] = {**rows[1], "thickness": 0.4 * gap}
    rows[2:2] = [pair[0], {**pair[1], "thickness": 0.6 * gap}]
    numbered = {str(n): row for n, row in enumerate(rows, 1)}
    twin = lens_from_prescription({**prescription, "surfaces": numbered, "stop": lens.stop + 2})
    rays = bundle(lens)
    lens.backend = twin.backend = backend
    found, expected = twin.trace(rays), lens.trace(rays)
    assert torch.equal(found.status, expected.status)
    ok = expected.valid
    for name in ("position", "direction", "path_length"):
        difference = (getattr(found, name) - getattr(expected, name))[ok]
        assert difference.abs().max() < 1e-12, name
    assert float(twin.first_order().efl.detach()) == pytest.approx(
        float(lens.first_order().efl.detach()), rel=1e-14
    )
    assert torch.allclose(twin.seidel(5.0).total.coma, lens.seidel(5.0).total.coma)
    late = found.surface[found.surface > 2].long() - 2
    assert torch.equal(late, expected.surface[expected.surface > 2].long())


def test_a_prescription_with_breaks_is_written_as_it_was_read():
    lens = LENSES["folded"](None)
    written = prescription_of(lens)
    again = lens_from_prescription(written)
    assert prescription_of(again) == written
    assert written["surfaces"]["9"]["order"] == "tilt_first"
    for name, value in lens.named_parameters():
        assert torch.equal(dict(again.named_parameters())[name], value)
    names = list(lens.variables(["surfaces.4.*"]))
    assert names == [f"surfaces.4.{n}" for n in
                     ("decenter_x", "decenter_y", "tilt_x", "tilt_y", "tilt_z")]  # fmt: skip


@pytest.mark.parametrize(
    "change, said",
    [
        ({"1": broken(semi_diameter=3.0)}, "surface 1: a coordinate break has no 'semi_diameter'"),
        ({"1": broken(material="air")}, "surface 1: a coordinate break has no 'material'"),
        ({"1": broken(order="both", thickness=1.0)}, "'order': 'both' is unknown"),
        ({"1": broken(tilt_w=1.0, thickness=1.0)}, "unknown key 'tilt_w'; did you mean"),
        ({"1": broken(tilt_x=1.0)}, "surface 1: 'thickness' is missing"),
        ({"2": broken()}, "no surface but coordinate breaks"),
    ],
)  # fmt: skip
def test_breaks_that_cannot_be_are_refused(change, said):
    surfaces = {"1": broken(thickness=1.0), "2": flat("air")} | change
    with pytest.raises(InputError, match=said):
        lens_from_prescription({"surfaces": surfaces, "sensor": {"distance": 1.0}, "stop": 2})


def test_a_break_cannot_be_the_stop():
    with pytest.raises(InputError, match="surface 1 is a coordinate break, and cannot be the stop"):
        lens_of([broken(thickness=1.0), flat("air")], stop=1)
