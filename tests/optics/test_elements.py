"""Elements: rigid motion of groups of surfaces."""

import math

import pytest
import torch
import yaml

from dolens import InputError, Rays, Status
from dolens.optics.elements import rotation_matrix
from dolens.prescriptions import lens_from_prescription, prescription_of

pytestmark = pytest.mark.usefixtures("backend")

PI = math.pi


@pytest.fixture
def triplet(root):
    text = (root / "conf/lens/cooke_triplet.yaml").read_text(encoding="utf-8")
    prescription = yaml.safe_load(text)

    def make(elements, dtype=torch.float64):
        return lens_from_prescription(prescription | {"elements": elements}, dtype)

    return make


def pencil(count=24, radius=3.0, depth=400.0, dtype=torch.float64):
    """Rays from an object point 2.9° off the axis, towards the first surface."""
    generator = torch.Generator().manual_seed(3)
    aim = (torch.rand((count, 2), generator=generator, dtype=torch.float64) - 0.5) * 2.0 * radius
    source = torch.tensor([0.03 * depth, -0.04 * depth, -depth], dtype=torch.float64)
    direction = torch.cat([aim, torch.zeros(count, 1, dtype=torch.float64)], -1) - source
    direction = direction / direction.norm(dim=-1, keepdim=True)
    return Rays(source.expand(count, 3).to(dtype), direction.to(dtype), 587.5618)


def moved(rays, rotation, pivot, displacement):
    """The same rays after the rigid motion p → pivot + R·(p - pivot) + displacement."""
    position = pivot + (rays.position - pivot) @ rotation.T + displacement
    return Rays(position, rays.direction @ rotation.T, rays.wavelength)


def test_the_rotation_is_right_handed_and_turns_about_z_first():
    quarter = torch.tensor(0.5 * PI, dtype=torch.float64)
    zero = torch.zeros((), dtype=torch.float64)
    x, y, z = torch.eye(3, dtype=torch.float64)
    for tilts, start, end in (
        ((quarter, zero, zero), y, z),
        ((zero, quarter, zero), z, x),
        ((zero, zero, quarter), x, y),
        ((quarter, zero, quarter), x, z),
    ):
        assert torch.allclose(rotation_matrix(*tilts) @ start, end, atol=1e-15)


def test_a_pose_of_zero_changes_nothing(triplet):
    plain, posed = triplet({}), triplet({"1": {"surfaces": [3, 4]}})
    rays = pencil()
    assert torch.equal(posed.trace(rays).status, plain.trace(rays).status)
    assert (posed.trace(rays).position - plain.trace(rays).position).abs().max() < 1e-13


@pytest.mark.parametrize("pivot", [[0.0, 0.0, 0.0], [1.0, -2.0, 7.0]])
def test_a_lens_that_moves_as_a_whole_sees_the_rays_move_the_other_way(triplet, pivot):
    """Frame invariance: trace of moved rays by the moved lens = motion of the trace."""
    pose = {"tilt_x": 7.0, "tilt_y": -11.0, "tilt_z": 30.0,
            "decenter_x": 0.6, "decenter_y": -0.4, "shift_z": 1.5}  # fmt: skip
    posed = triplet({"1": {"surfaces": [1, 6], "pivot": pivot, **pose}})
    rotation = rotation_matrix(
        *(torch.tensor(math.radians(pose[k]), dtype=torch.float64) for k in
          ("tilt_x", "tilt_y", "tilt_z"))
    )  # fmt: skip
    shift = torch.tensor(
        [pose[k] for k in ("decenter_x", "decenter_y", "shift_z")], dtype=torch.float64
    )
    centre = torch.tensor(pivot, dtype=torch.float64)
    rays = pencil()
    still = triplet({}).trace(rays, record=True)
    turned = posed.trace(moved(rays, rotation, centre, shift), record=True)
    assert torch.equal(still.status, turned.status)
    expected = centre + (still.points - centre) @ rotation.T + shift
    assert still.valid.sum() > 10
    assert (turned.points - expected)[:, still.valid].abs().max() < 1e-11
    assert (turned.direction - still.direction @ rotation.T)[still.valid].abs().max() < 1e-13


def test_an_element_inside_another_moves_within_it(triplet):
    """The inner motion in the outer one's axes, then the outer: two rotations multiply."""
    inner = {"surfaces": [3, 4], "tilt_x": 2.0, "decenter_y": 0.3}
    outer = {"surfaces": [1, 6], "tilt_y": 5.0, "tilt_z": 20.0, "shift_z": 0.7}
    both, alone = triplet({"in": inner, "out": outer}), triplet({"in": inner})
    rotation = rotation_matrix(
        *(torch.tensor(math.radians(a), dtype=torch.float64) for a in (0.0, 5.0, 20.0))
    )
    zero, shift = torch.zeros(3).double(), torch.tensor([0.0, 0.0, 0.7], dtype=torch.float64)
    rays = pencil()
    one = alone.trace(rays, record=True)
    expected = one.points @ rotation.T + shift
    found = both.trace(moved(rays, rotation, zero, shift), record=True)
    assert torch.equal(found.valid, one.valid)
    assert one.valid.sum() > 10
    assert (found.points - expected)[:, one.valid].abs().max() < 1e-11


def test_a_tilted_plane_parallel_plate_displaces_a_ray():
    """Displacement t·sin(i - i')/cos i', sin i = n·sin i' (Smith, Modern Optical Engineering)."""
    index, thickness, tilt = 1.5168, 10.0, 30.0
    plate = {
        "surfaces": {
            "1": {"type": "plane", "semi_diameter": 20, "thickness": thickness,
                  "material": "1.5168/64.17"},
            "2": {"type": "plane", "semi_diameter": 20, "material": "air"},
        },
        "elements": {"1": {"surfaces": [1, 2], "tilt_x": tilt, "pivot": [0, 0, 5]}},
        "sensor": {"distance": 30.0},
    }  # fmt: skip
    lens = lens_from_prescription(plate)
    ray = Rays(torch.tensor([[0.0, 0.0, -5.0]]).double(), torch.tensor([[0.0, 0.0, 1.0]]).double())
    hit = lens.trace(ray)
    angle = math.radians(tilt)
    inside = math.asin(math.sin(angle) / index)
    shift = thickness * math.sin(angle - inside) / math.cos(inside)
    # Tilted by +θx, the plate's normal turns towards -y: the ray leaves displaced to -y.
    assert hit.position[0].tolist() == pytest.approx([0.0, -shift, 40.0], abs=1e-13)
    assert hit.direction[0].tolist() == pytest.approx([0.0, 0.0, 1.0], abs=1e-15)


def test_a_far_source_loses_nothing_in_float32_to_a_tilt(triplet):
    """The source is ten metres away: turning its coordinates in float32 would cost 1 µm."""
    elements = {"1": {"surfaces": [1, 2], "tilt_x": 3.0, "decenter_y": 0.2}}
    rays = pencil(depth=1e4)
    exact, single = triplet(elements), triplet(elements, torch.float32)
    # The very rays that float32 holds.
    same = Rays(rays.position.float().double(), rays.direction.float().double(), 587.5618)
    a, b = exact.trace(same, record=True), single.trace(rays, record=True)
    assert torch.equal(a.valid, b.valid)
    from_float32_direction = 1e4 * torch.finfo(torch.float32).eps
    assert (a.points - b.points)[:, a.valid].abs().max() < from_float32_direction


def test_a_clipped_ray_names_the_surface_of_a_decentred_element(triplet):
    lens = triplet({"1": {"surfaces": [3, 4], "decenter_y": 7.0}})
    hit = lens.trace(Rays(torch.tensor([0.0, 0.0, -1.0]), torch.tensor([0.0, 0.0, 1.0])))
    assert (int(hit.status), int(hit.surface)) == (Status.VIGNETTED, 3)


def test_poses_are_written_and_read_back_to_the_last_bit(triplet):
    generator = torch.Generator().manual_seed(0)
    lens = triplet({"a": {"surfaces": [1, 2], "pivot": [0.1, 0.2, 0.3]}, "b": {"surfaces": [5, 6]}})
    for _ in range(50):
        with torch.no_grad():
            for p in lens.variables(["elements.*"]).values():
                p.copy_(torch.randn((), generator=generator, dtype=torch.float64))
        again = lens_from_prescription(yaml.safe_load(yaml.safe_dump(prescription_of(lens))))
        for (name, p), (other, q) in zip(
            lens.named_parameters(), again.named_parameters(), strict=True
        ):
            assert name == other
            assert torch.equal(p, q), name
        assert again.elements["a"].pivot == (0.1, 0.2, 0.3)


@pytest.mark.parametrize(
    "elements, message",
    [
        ({"1": {"surfaces": [1, 9]}}, "element 1: surface 9 is not in the lens, which has 6"),
        ({"1": {"surfaces": [2, 1]}}, "element 1: an element's surfaces run"),
        ({"1": {"tilt_x": 1}}, "element 1: 'surfaces' must be [first, last], not None"),
        ({"1": {"surfaces": [1, 2], "tiltx": 1}}, "did you mean 'tilt_x'?"),
        ({"1": {"surfaces": [1, 2], "tilt_x": "one"}}, "'tilt_x' must be a number, not 'one'"),
        ({"1": {"surfaces": [1, 2], "pivot": 3}}, "'pivot' must be [x, y, z] in mm, not 3"),
        ({"1": {"surfaces": [1, 3]}, "2": {"surfaces": [3, 4]}}, "overlap"),
        ({"1": {"surfaces": [1, 3]}, "2": {"surfaces": [1, 3]}}, "overlap"),
    ],
)
def test_bad_elements_are_one_clear_line(triplet, elements, message):
    with pytest.raises(InputError) as error:
        triplet(elements)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
