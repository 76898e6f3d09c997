"""Rays aimed at the stop land there, and have the derivatives of doing so."""

import math

import pytest
import torch
import yaml

from dolens import InputError, Status, load_lens
from dolens.optics.aiming import aim, field_line, launch
from dolens.optics.trace import trace_surfaces
from dolens.prescriptions import lens_from_prescription

D_LINE = 587.5618
FISHEYE = {
    "name": "Fisheye",
    "stop": 7,
    "surfaces": {
        "1": {"type": "sphere", "radius": 45.0, "semi_diameter": 30.0, "thickness": 2.5,
              "material": "1.7440/44.8"},
        "2": {"type": "sphere", "radius": 14.0, "semi_diameter": 13.5, "thickness": 11.0,
              "material": "air"},
        "3": {"type": "sphere", "radius": 60.0, "semi_diameter": 13.0, "thickness": 1.5,
              "material": "1.6204/60.3"},
        "4": {"type": "sphere", "radius": 11.0, "semi_diameter": 9.0, "thickness": 8.0,
              "material": "air"},
        "5": {"type": "sphere", "radius": 20.0, "semi_diameter": 7.0, "thickness": 5.0,
              "material": "1.7200/29.3"},
        "6": {"type": "sphere", "radius": -60.0, "semi_diameter": 6.0, "thickness": 3.0,
              "material": "air"},
        "7": {"type": "aperture", "semi_diameter": 1.5, "thickness": 1.0, "material": "air"},
        "8": {"type": "sphere", "radius": 30.0, "semi_diameter": 5.0, "thickness": 3.0,
              "material": "1.6204/60.3"},
        "9": {"type": "sphere", "radius": -9.0, "semi_diameter": 5.0, "material": "air"},
    },
    "sensor": {"distance": 12.0},
}  # fmt: skip
# The lens's widest field, degrees.
WIDEST = {
    "nikon": 32.45,
    "large_fov_doublet": 20.0,
    "cooke_triplet": 20.0,
    "asphere": 5.0,
    "wavefront_coding": 1.0,
    "fisheye": 85.0,
}


def lens_named(name, root, dtype=torch.float64):
    if name == "fisheye":
        return lens_from_prescription(FISHEYE, dtype)
    return load_lens(root / "conf" / "lens" / f"{name}.yaml", dtype)


def symmetric_lens():
    """Two equal menisci about a central stop."""
    meniscus = {"type": "sphere", "semi_diameter": 15.0}
    return lens_from_prescription(
        {
            "stop": 3,
            "surfaces": {
                "1": {**meniscus, "radius": 18.0, "thickness": 4.0, "material": "1.6/50"},
                "2": {**meniscus, "radius": 20.0, "thickness": 9.0, "material": "air"},
                "3": {"type": "aperture", "semi_diameter": 2.0, "thickness": 9.0,
                      "material": "air"},
                "4": {**meniscus, "radius": -20.0, "thickness": 4.0, "material": "1.6/50"},
                "5": {**meniscus, "radius": -18.0, "material": "air"},
            },
            "sensor": {"distance": 60.0},
        }
    )  # fmt: skip


def disc(dtype=torch.float64, rings=(0.0, 0.5, 1.0), spokes=6):
    angle = torch.arange(spokes, dtype=dtype) * (2 * math.pi / spokes) + 0.2
    spoke = torch.stack((torch.cos(angle), torch.sin(angle)), -1)
    return torch.cat([ring * spoke for ring in rings])


def landing(lens, rays):
    """x and y on the stop over its semi-diameter."""
    traced = trace_surfaces(lens.system(), rays.components(), rays.wavelength, last=lens.stop)
    radius = lens.surfaces[str(lens.stop)].semi_diameter
    return torch.stack((traced.ray.x, traced.ray.y), -1) / radius


@pytest.mark.parametrize("fraction", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("name", WIDEST)
def test_rays_land_where_they_are_aimed(root, name, fraction):
    pupil = disc()
    lens = lens_named(name, root)
    field = (0.3 * fraction * WIDEST[name], fraction * WIDEST[name])
    rays = lens.aim(field, pupil)
    assert rays.converged.all()
    assert (landing(lens, rays) - pupil).abs().max() < 1e-12
    tangent = torch.tan(torch.deg2rad(torch.tensor((*field, 45.0), dtype=torch.float64)))
    expected = tangent / tangent.norm()
    assert (rays.direction - expected).abs().max() < 1e-15
    # They start on a wavefront through the first vertex.
    assert ((rays.position * expected).sum(-1)).abs().max() < 1e-13


@pytest.mark.parametrize("name", ["nikon", "large_fov_doublet", "cooke_triplet", "fisheye"])
def test_single_precision_lands_to_a_millionth(root, name):
    pupil = disc(torch.float32)
    lens = lens_named(name, root, torch.float32)
    rays = lens.aim((0.0, WIDEST[name]), pupil)
    assert rays.converged.all()
    assert rays.position.dtype == rays.direction.dtype == torch.float32
    # Rounding at the front is seen on the stop, and a fisheye's front is twenty times as wide.
    front = lens.surfaces["1"].semi_diameter / lens.surfaces[str(lens.stop)].semi_diameter
    assert (landing(lens, rays) - pupil).abs().max() < 1e-6 * front


@pytest.mark.parametrize("distance", [50.0, 2000.0, 1e7])
@pytest.mark.parametrize("name", ["nikon", "cooke_triplet", "fisheye"])
def test_rays_from_a_point_of_the_object(root, name, distance):
    pupil = disc()
    lens = lens_named(name, root)
    height = distance * math.tan(math.radians(min(WIDEST[name], 60.0)))
    rays = lens.aim((0.2 * height, -height), pupil, D_LINE, distance)
    assert rays.converged.all()
    assert (landing(lens, rays) - pupil).abs().max() < 1e-12
    source = torch.tensor((0.2 * height, -height, -distance), dtype=torch.float64)
    to_source = source - rays.position
    across = torch.linalg.cross(to_source, rays.direction).norm(dim=-1)
    assert across.max() < 1e-14 * source.norm()


def test_far_objects_are_at_infinity(root):
    lens = lens_named("nikon", root)
    near = lens.aim((0.0, -1e12 * math.tan(math.radians(30.0))), disc(), D_LINE, 1e12)
    far = lens.aim((0.0, 30.0), disc())
    assert (near.position - far.position).abs().max() < 1e-11
    assert (near.direction - far.direction).abs().max() < 1e-11


def test_the_pupil_of_a_fisheye_wanders(root):
    """The chief ray crosses the axis ever nearer to the front, from the paraxial pupil on."""
    lens = lens_named("fisheye", root)
    fields = torch.tensor([0.01, 20.0, 40.0, 60.0, 70.0, 80.0, 85.0], dtype=torch.float64)
    rays = lens.chief_ray(torch.stack((torch.zeros_like(fields), fields), -1))
    assert rays.converged.all()
    _, y, z = rays.position.detach().unbind(-1)
    _, m, n = rays.direction.detach().unbind(-1)
    crossing = z - y * n / m
    paraxial = float(lens.first_order().entrance_pupil.z.detach())
    assert float(crossing[0]) == pytest.approx(paraxial, rel=1e-7)
    assert (crossing.diff() < 0.0).all()
    # By far more than the pupil's own size: rays aimed paraxially would miss the stop altogether.
    assert float(paraxial - crossing[-1]) > 6.0
    hit = lens.trace(rays)
    assert hit.valid.all()
    assert (hit.position[:, 1].diff() > 0.0).all()


def test_aimed_rays_are_traced_through_the_lens(root):
    """Inside the stop and unvignetted before it, they reach the sensor."""
    lens = lens_named("fisheye", root)
    fields = torch.tensor([[[0.0, 0.0]], [[0.0, 60.0]], [[50.0, 70.0]]], dtype=torch.float64)
    pupil = 0.99 * disc()
    wavelength = torch.tensor([486.1327, D_LINE, 656.2725], dtype=torch.float64)[:, None, None]
    rays = lens.aim(fields, pupil, wavelength)
    assert rays.position.shape == (3, 3, len(pupil), 3)
    assert rays.converged.shape == (3, 3, len(pupil))
    assert rays.converged.all()
    assert lens.trace(rays).valid.all()
    assert (landing(lens, rays) - pupil).abs().max() < 1e-12
    alone = lens.aim((50.0, 70.0), pupil, 486.1327)
    assert (alone.position - rays.position[0, 2]).abs().max() < 1e-12


@pytest.mark.parametrize("degrees", [5.0, 20.0, 35.0])
def test_the_chief_ray_of_a_symmetric_lens_leaves_as_it_came(degrees):
    """About a central stop the path is symmetric: same direction, and mirrored height."""
    lens = symmetric_lens()
    rays = lens.chief_ray((0.0, degrees))
    assert rays.converged.all()
    hit = lens.trace(rays, record=True)
    assert (hit.direction - rays.direction).abs().max() < 1e-13
    points, length = hit.points, float(lens.system().vertices[4].detach())
    assert abs(float(points[2, 1].detach())) < 1e-13
    assert float((points[0, 1] + points[4, 1]).detach()) == pytest.approx(0.0, abs=1e-12)
    assert float((points[0, 2] + points[4, 2]).detach()) == pytest.approx(length, abs=1e-12)


def test_marginal_rays_are_upper_lower_and_sagittal(root):
    lens = lens_named("cooke_triplet", root)
    fields = torch.tensor([[0.0, 0.0], [0.0, 15.0]], dtype=torch.float64)
    rays = lens.marginal_rays(fields)
    edge = torch.tensor([[0.0, 1.0], [0.0, -1.0], [1.0, 0.0]], dtype=torch.float64)
    assert rays.position.shape == (2, 3, 3)
    assert (landing(lens, rays) - edge).abs().max() < 1e-12
    # Near the axis the real marginal ray is the paraxial one, but for aberration of the pupil.
    height = lens.paraxial_rays(0.0).marginal.height[0]
    assert float((rays.position[0, 0, 1] / height).detach()) == pytest.approx(1.0, abs=0.05)


def test_small_pupils_are_the_paraxial_pupil(root):
    lens = lens_named("nikon", root)
    found = lens.aim((0.0, 0.0), (0.0, 1e-4)).position[1] / 1e-4
    radius = 0.5 * float(lens.first_order().entrance_pupil.diameter.detach())
    assert float(found.detach()) == pytest.approx(radius, rel=1e-6)


# --- out of reach --------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "degrees"), [("cooke_triplet", 60.0), ("cooke_triplet", 40.0)])
def test_fields_out_of_reach_are_flagged(root, name, degrees):
    lens = lens_named(name, root)
    fields = torch.tensor([[0.0, 10.0], [0.0, degrees]], dtype=torch.float64)
    rays = lens.aim(fields[:, None], disc())
    assert rays.converged[0].all()
    assert not rays.converged[1].any()
    # Indeed no ray of a fine grid, far wider than the lens, comes through to the stop.
    side = torch.linspace(-30.0, 30.0, 301, dtype=torch.float64)
    grid = torch.stack(torch.meshgrid(side, side, indexing="ij"), -1)
    line, _ = field_line(torch.deg2rad(fields[1]))
    traced = trace_surfaces(lens.system(), launch(line, 0.0, grid), D_LINE, last=lens.stop)
    lost = [margin > 0.0 for row in traced.margins for margin in (row.met, row.transmitted)
            if margin is not None]  # fmt: skip
    through = torch.stack(lost).all(0)
    radius = lens.surfaces[str(lens.stop)].semi_diameter
    assert not (through & (torch.hypot(traced.ray.x, traced.ray.y) < radius)).any()
    # A trace finds them invalid, with finite numbers and no gradient.
    hit = lens.trace(rays)
    assert not hit.valid[1].any()
    assert (hit.status[1] == int(Status.MISSED)).all()
    assert torch.isfinite(hit.position).all()
    lost = rays.position[1].sum() + rays.direction[1].sum() + hit.position[1].sum()
    parameters = list(lens.parameters())
    for gradient in torch.autograd.grad(lost, parameters, retain_graph=True):
        assert float(gradient) == 0.0
    everything = rays.position.sum() + hit.position.sum()
    for gradient in torch.autograd.grad(everything, parameters):
        assert torch.isfinite(gradient)


def test_points_beyond_the_stop_surface_are_flagged():
    """A spherical stop of radius 5 mm has no points 6 mm off the axis."""
    lens = lens_from_prescription(
        {
            "stop": 1,
            "surfaces": {
                "1": {"type": "sphere", "radius": 5.0, "semi_diameter": 4.0, "material": "1.5/60"}
            },
            "sensor": {"distance": 10.0},
        }
    )
    pupil = torch.tensor([[0.0, 0.5], [0.0, 1.2], [0.0, 1.5]], dtype=torch.float64)
    assert lens.aim((0.0, 0.0), pupil).converged.tolist() == [True, True, False]


def test_shapes_that_are_no_fields(root):
    lens = lens_named("cooke_triplet", root)
    with pytest.raises(InputError, match=r"field must be x and y, \(\.\.\., 2\), not \(3,\)"):
        lens.aim((0.0, 1.0, 2.0), (0.0, 0.0))
    with pytest.raises(InputError, match="pupil must be x and y"):
        lens.aim((0.0, 1.0), 0.5)
    with pytest.raises(InputError, match="object_distance must be positive"):
        lens.chief_ray((0.0, 1.0), D_LINE, -5.0)
    assert lens.aim(torch.zeros(0, 2), (0.0, 0.0)).position.shape == (0, 3)


# --- derivatives ---------------------------------------------------------------------------------

CASES = [("nikon", 32.45, None), ("fisheye", 70.0, None), ("cooke_triplet", 30.0, 100.0)]


@pytest.mark.parametrize(("name", "field", "distance"), CASES)
def test_gradients_are_those_of_aiming_again(root, name, field, distance):
    lens = lens_named(name, root)
    pupil = torch.tensor([[0.0, 0.0], [0.3, 0.8], [-0.7, -0.2]], dtype=torch.float64)
    weights = torch.linspace(0.7, 1.9, 18, dtype=torch.float64).reshape(3, 6)

    def function():
        rays = lens.aim((0.1 * field, field), pupil, D_LINE, distance)
        return (weights * torch.cat((rays.position, rays.direction), -1)).sum()

    stop = lens.stop
    parameters = {
        key: value
        for key, value in lens.named_parameters()
        if key.split(".")[0] in ("surfaces", "thicknesses") and int(key.split(".")[1]) < stop
    }
    later = lens.surfaces[str(len(lens.surfaces))].curvature
    exact = torch.autograd.grad(function(), (*parameters.values(), later), allow_unused=True)
    # What lies behind the stop does not move the rays before it.
    assert exact[-1] is None or float(exact[-1]) == 0.0
    some = list(parameters.items())[:: max(1, len(parameters) // 3)]
    for key, parameter in some:
        gradient = exact[list(parameters).index(key)]
        step = 1e-5
        ends = []
        with torch.no_grad():
            kept = parameter.clone()
            for k in (-2, -1, 1, 2):
                parameter.copy_(kept + k * step)
                ends.append(float(function()))
            parameter.copy_(kept)
        slope = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * step)
        assert float(gradient) == pytest.approx(slope, rel=1e-6, abs=1e-7), key
        assert float(gradient) != 0.0, key


def test_gradients_with_respect_to_field_and_pupil(root):
    lens = lens_named("large_fov_doublet", root)
    system = lens.system()
    field = torch.tensor([0.1, 0.3], dtype=torch.float64)
    pupil = torch.tensor([0.4, -0.5], dtype=torch.float64)

    def start(field, pupil):
        rays = aim(system, field, pupil, D_LINE)
        return torch.cat((rays.position, rays.direction))

    both = torch.cat((field, pupil))
    found = torch.autograd.functional.jacobian(lambda v: start(v[:2], v[2:]), both)
    h = 1e-4
    for column, unit in enumerate(torch.eye(4, dtype=torch.float64)):
        ends = []
        for k in (-2, -1, 1, 2):
            moved = both + k * h * unit
            ends.append(start(moved[:2], moved[2:]).detach())
        slope = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h)
        assert (found[:, column] - slope).abs().max() < 1e-7 * max(1.0, float(slope.abs().max()))


def test_forward_mode_and_reverse_mode_agree(root):
    lens = lens_named("nikon", root)
    value = lens.surfaces["3"].curvature.detach()

    def height(c):
        system = lens.system({"surfaces.3.curvature": c})
        field = torch.deg2rad(torch.tensor([0.0, 25.0], dtype=torch.float64))
        return aim(system, field, torch.tensor([0.5, 0.5], dtype=torch.float64), D_LINE).position

    forward = torch.func.jacfwd(height)(value)
    reverse = torch.func.jacrev(height)(value)
    assert forward.abs().max() > 1e-3
    assert (forward - reverse).abs().max() < 1e-12 * forward.abs().max()


def test_rays_are_aimed_at_the_stop_where_its_element_has_put_it(root):
    """The point asked for counts in the stop's own axes, tilted and decentred with it."""
    text = (root / "conf/lens/cooke_triplet.yaml").read_text(encoding="utf-8")
    pose = {"surfaces": [3, 4], "decenter_x": 0.4, "decenter_y": -0.3}
    pose |= {"tilt_x": 4.0, "tilt_y": -3.0}
    lens = lens_from_prescription(yaml.safe_load(text) | {"elements": {"middle": pose}})
    assert lens.stop == 4
    pupil = torch.tensor([[0.0, 0.0], [0.5, 0.0], [-0.3, 0.6]], dtype=torch.float64)
    rays = lens.aim([2.0, 7.0], pupil)
    assert rays.converged.all()
    points = lens.trace(rays, record=True).points[3]
    axes = lens.system().axes[3]
    own = (points - axes.origin) @ axes.rotation
    radius = lens.surfaces["4"].semi_diameter
    assert (own[:, :2] - pupil * radius).abs().max() < 1e-12 * radius
    assert (points[0, :2] - torch.tensor([0.4, -0.3]).double()).norm() > 0.01  # turned with z
    shift = dict(lens.named_parameters())["elements.middle.decenter_y"]
    (gradient,) = torch.autograd.grad(rays.position[0, 1], shift)
    start = []
    for h in (-1e-4, 1e-4):
        with torch.no_grad():
            shift += h
            start.append(float(lens.aim([2.0, 7.0], pupil).position[0, 1]))
            shift -= h
    assert float(gradient) == pytest.approx((start[1] - start[0]) / 2e-4, rel=1e-6)


def test_a_guess_saves_the_search_and_changes_nothing(root):
    """From the solution of a lens that is nearly this one; a useless guess is not followed."""
    lens = load_lens(root / "conf/lens/double_gauss.yaml", dtype=torch.float64)
    field = torch.deg2rad(torch.tensor([[0.0, 22.0], [5.0, -15.0]], dtype=torch.float64))
    pupil = torch.tensor([[0.0, 0.0], [0.3, -0.6]], dtype=torch.float64)
    before = aim(lens.system(), field, pupil, 587.5618)
    with torch.no_grad():
        lens.surfaces["2"].curvature += 1e-4
    names = ["surfaces.2.curvature", "thicknesses.5"]

    def aimed(guess):
        leaves = {n: p.detach().clone().requires_grad_() for n, p in lens.variables(names).items()}
        found = aim(lens.system(leaves), field, pupil, 587.5618, guess=guess)
        assert bool(found.converged.all())
        rows = [
            torch.cat(
                [
                    g.reshape(-1)
                    for g in torch.autograd.grad(x, list(leaves.values()), retain_graph=True)
                ]
            )
            for x in found.position[..., :2].reshape(-1)
        ]
        return found.position.detach(), torch.stack(rows)

    position, slopes = aimed(None)
    far = torch.full((2, 2), 11.0, dtype=torch.float64)
    for guess in (before.crossing, far):
        again, same = aimed(guess)
        assert torch.allclose(again, position, rtol=0.0, atol=1e-12)
        assert torch.allclose(same, slopes, rtol=1e-6, atol=1e-9 * float(slopes.abs().max()))
