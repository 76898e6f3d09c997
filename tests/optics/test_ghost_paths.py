"""Ghost paths: unfolded lenses beside closed forms, a published table, and rays piece by piece."""

import itertools
import math

import pytest
import torch
from mpmath import mp

from dolens import InputError, Lens, Rays, Status, load_lens
from dolens.optics.aiming import launch, line_of_slopes
from dolens.optics.elements import from_lens_axes, to_lens_axes
from dolens.optics.ghost_paths import ghost_path_system, ghost_paths, reflecting_surfaces, unfolded
from dolens.optics.paraxial import first_order
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Components
from dolens.optics.surfaces.refraction import snell
from dolens.optics.trace import meet, trace_surfaces
from dolens.prescriptions import lens_from_prescription
from tests.lenses import lens_of_rows, prescription_of_rows

F64 = torch.float64
WAVE = 587.5618

TILTED = {
    "outer": {"surfaces": [2, 4], "tilt_x": 2.0, "decenter_y": 0.2, "pivot": [0.1, 0.0, 1.5]},
    "inner": {"surfaces": [3, 4], "tilt_y": -3.0, "shift_z": 0.1, "pivot": [0.0, 0.2, 0.5]},
}
ROWS = (
    (30.0, 3.0, "1.6"),
    (-40.0, 2.0, "air"),
    (25.0, 2.5, "1.5"),
    (-60.0, 1.5, "1.7"),
    ({"type": "even_asphere", "radius": 80.0, "a4": 1e-5, "thickness": 3.0, "material": "air"}),
    (45.0, 2.0, "1.55"),
    (-35.0, 0.0, "air"),
)
BREAK = {"type": "coordinate_break", "tilt_x": 4.0, "decenter_y": 0.3, "thickness": 1.0}


def lens(kind: str) -> Lens:
    """A lens whose light takes every kind of turn."""
    rows, keys = list(ROWS), {}
    if kind == "tilted":
        keys["elements"] = TILTED
    if kind == "broken":
        rows.insert(4, {**BREAK, "order": "tilt_first", "tilt_y": 3.0})
        rows.insert(2, BREAK)
        keys["elements"] = {"a": {"surfaces": [2, 5], "tilt_x": 1.0, "pivot": [0.0, 0.1, 0.7]}}
    if kind == "mirror":
        rows[3:5] = [(-200.0, -3.0, "mirror"), (60.0, -4.0, "air")]
        rows[5:] = [(-50.0, -2.0, "1.55"), (70.0, 0.0, "air")]
    distance = -20.0 if kind == "mirror" else 20.0
    given = prescription_of_rows(*rows, sensor=distance, stop=2, semi_diameter=5.0, **keys)
    for row in given["surfaces"].values():
        if row["type"] == "coordinate_break":
            row.pop("semi_diameter"), row.pop("material")
    return lens_from_prescription(given)


def pencil(count=40, seed=3) -> Rays:
    generator = torch.Generator().manual_seed(seed)
    q = 3.0 * (2.0 * torch.rand(count, 2, generator=generator, dtype=F64) - 1.0)
    slopes = torch.tensor([0.03, -0.05], dtype=F64)
    return Rays.from_components(launch(line_of_slopes(slopes).expand(count, 3), 0.0, q), WAVE)


def reflected(system, ray: Components, number: int, sense: float) -> Components:
    """Rays in the lens's axes that a surface reflects, from what it is alone."""
    axes = system.all_axes[number - 1]
    here = from_lens_axes(ray, axes)
    surface = system.surfaces[number - 1]
    x, y, z, *direction = meet(surface, here, sense).ray
    normal = surface.shape.normal(surface.parameters, x, y, z)
    return to_lens_axes(Components(x, y, z, *snell(direction, normal, 1.0, -sense)[:3]), axes)


def piece_by_piece(system, rays: Rays, path) -> tuple[torch.Tensor, torch.Tensor]:
    """Where rays of a path land, and which pass: forwards and backwards through the lens itself."""
    ray, valid = rays.components(), torch.ones(len(rays.position), dtype=torch.bool)
    at, travel = 0, 1.0
    for number in path:
        first, last = (at + 1, number - 1) if travel > 0.0 else (number + 1, at - 1)
        if last >= first:
            part = trace_surfaces(system, ray, WAVE, travel, first=first, last=last)
            ray, valid = part.ray, valid & part.valid
        before = number - 1 if travel > 0.0 else number
        place = from_lens_axes(ray, system.all_axes[number - 1])
        sense = travel * system.senses[before]
        margin = meet(system.surfaces[number - 1], place, sense)
        inside = system.surfaces[number - 1].aperture.margin(margin.ray.x, margin.ray.y)
        valid = valid & (margin.met > 0.0) & (inside > 0.0)
        ray = reflected(system, ray, number, sense)
        at, travel = number, -travel
    rest = Rays.from_components(ray, WAVE)
    hit = trace_rays(system.traced_by("reference"), rest, 1.0, first=at + 1)
    return hit.position, hit.valid & valid


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("kind", ["plain", "tilted", "broken", "mirror"])
def test_a_path_is_the_lens_met_piece_by_piece(kind, backend):
    system, rays = lens(kind).requires_grad_(False).system(), pencil()
    count = len(system.surfaces)
    arrived = 0
    for path in [*ghost_paths(system), (count - 1, 2, count, count - 2)]:
        if path[-1] == count:
            continue
        found = trace_rays(ghost_path_system(system, path).traced_by(backend), rays)
        position, valid = piece_by_piece(system, rays, path)
        assert torch.equal(found.valid, valid), path
        away = (found.position - position)[valid]
        assert away.numel() == 0 or float(away.abs().max()) < 1e-9, path
        arrived += int(valid.sum())
    assert arrived > 300


def test_every_pair_of_surfaces_is_a_path_and_four_reflections_go_to_and_fro():
    system = load_lens("cooke_triplet").system()
    assert ghost_paths(system) == [(j, i) for j in range(2, 7) for i in range(1, j)]
    assert len(ghost_paths(system, sensor=True)) == 21
    four = ghost_paths(system, 4)
    every = itertools.product(range(1, 7), repeat=4)
    assert four == [p for p in every if p[0] > p[1] < p[2] > p[3]]
    assert unfolded((5, 3), 6).numbers == (1, 2, 3, 4, 5, 4, 3, 4, 5, 6)


def test_stops_dummies_and_mirrors_reflect_nothing():
    rows = ((None, 1.0, "air"), (40.0, 2.0, "1.5"), (None, 2.0, "1.5"), (-40.0, 0.0, "air"))
    assert reflecting_surfaces(lens_of_rows(*rows, stop=1).system()) == (2, 4)
    assert 4 not in reflecting_surfaces(lens("mirror").system())
    with pytest.raises(InputError, match=r"surface 3 reflects no light .*allowed: 2, 4, 5"):
        ghost_path_system(lens_of_rows(*rows, stop=1).system(), (3, 2))
    with pytest.raises(InputError, match="surface 2 reflects does not come to 4"):
        ghost_path_system(lens_of_rows(*rows, stop=1).system(), (2, 4))
    with pytest.raises(InputError, match="bounces: 3; allowed: 2, 4 or 6"):
        ghost_paths(lens_of_rows(*rows, stop=1).system(), 3)


def test_first_order_of_a_ghost_is_that_of_zemax():
    """The ghost of surfaces 2 and 1 of `Cooke 40 degree field.zmx` at 550 nm, as printed in
    A. Arora, How do I account for energy losses when performing a sequential ghost analysis?
    (Zemax knowledge base, 2008).  The lens has the sample's glasses as nd and Vd here, and its
    radii and gaps to a micrometre.
    """
    system = load_lens("cooke_triplet").requires_grad_(False).system()
    found = first_order(ghost_path_system(system, (2, 1)), 550.0)
    end = ghost_path_system(system, (2, 1)).vertices[-1]
    assert abs(float(found.efl) - 8.2347) < 1e-4
    assert abs(float(found.focus - end) + 57.1176) < 2e-4
    assert abs(float(found.exit_pupil.z - end) + 50.9613) < 6e-4


def test_the_ghosts_of_a_plate_are_shifted_by_its_thickness():
    """Light reflected 2k times in a plate lands 2k·d·tan θ' aside."""
    thickness, index = 4.0, 1.5
    rows = ((math.inf, thickness, str(index)), (math.inf, 0.0, "air"))
    plate = lens_of_rows(*rows, sensor=20.0, stop=1, semi_diameter=20.0)
    angle = math.radians(20.0)
    ray = Rays(
        torch.zeros(1, 3, dtype=F64),
        torch.tensor([[0.0, math.sin(angle), math.cos(angle)]], dtype=F64),
        WAVE,
    )
    image = plate.trace(ray).position[0]
    inside = math.asin(math.sin(angle) / index)
    for bounces in (2, 4, 6):
        (path,) = ghost_paths(plate.system(), bounces)
        ghost = ghost_path_system(plate.system(), path)
        hit = trace_rays(ghost, ray)
        shift = bounces * thickness * math.tan(inside)
        assert bool(hit.valid.all())
        assert torch.allclose(hit.position[0, 1] - image[1], torch.tensor(shift).double())
        assert torch.allclose(hit.direction, plate.trace(ray).direction)


def test_a_ball_lens_s_ghost_has_its_focus_where_algebra_says():
    """Refraction, two reflections and refraction, written out with mpmath: vergences of a beam
    along the light, so that no sign of a mirror's is shared with the library.
    """
    radius, index = mp.mpf(5), mp.mpf("1.5")
    diameter = 2 * radius
    vergence = (index - 1) / radius  # of the beam in the glass, n/s, converging
    for _ in range(2):
        vergence = vergence / (1 - vergence * diameter / index)
        vergence += 2 * index / radius  # a concave mirror
    vergence = vergence / (1 - vergence * diameter / index) + (index - 1) / radius
    ball = lens_of_rows((5.0, 10.0, "1.5"), (-5.0, 0.0, "air"), sensor=3.0, stop=1)
    found = first_order(ghost_path_system(ball.system(), (2, 1)), WAVE)
    assert abs(float(found.bfd) - float(1 / vergence)) < 1e-12


def test_light_from_the_centre_of_a_concentric_meniscus_goes_on_as_if_from_there():
    """Every surface reflects it back into itself."""
    meniscus = lens_of_rows((-20.0, 5.0, "1.6"), (-25.0, 0.0, "air"), sensor=10.0, stop=1)
    slopes = 0.1 * (torch.rand(50, 2, dtype=F64) - 0.5)
    direction = line_of_slopes(slopes)
    centre = torch.tensor([0.0, 0.0, -20.0], dtype=F64)
    hit = trace_rays(
        ghost_path_system(meniscus.system(), (2, 1)), Rays(centre.expand(50, 3), direction, WAVE)
    )
    away = (centre + direction * (35.0 / direction[:, 2:]))[:, :2]
    assert bool(hit.valid.all())
    assert torch.allclose(hit.position[:, :2], away, rtol=0.0, atol=1e-12)


def test_the_sensor_reflects_as_a_surface_of_its_own():
    """A plane in front of it and the sensor make a plate of air."""
    plate = lens_of_rows(
        (math.inf, 2.0, "1.5"), (math.inf, 0.0, "air"), sensor=7.0, stop=1, semi_diameter=30.0
    )
    direction = torch.tensor([[0.0, 0.6, 0.8]], dtype=F64)
    ray = Rays(torch.zeros(1, 3, dtype=F64), direction, WAVE)
    hit = trace_rays(ghost_path_system(plate.system(), (3, 2)), ray)
    shift = hit.position[0, 1] - plate.trace(ray).position[0, 1]
    assert torch.allclose(shift, torch.tensor(2.0 * 7.0 * 0.75, dtype=F64))


def test_light_beyond_the_critical_angle_is_reflected_on_a_ghost_path():
    prism = lens_of_rows((math.inf, 1.0, "1.5"), (math.inf, 0.0, "air"), sensor=5.0, stop=1)
    system = prism.system()
    steep = torch.tensor([[0.0, 0.8, 0.6]], dtype=F64)  # in glass, behind surface 1
    start = Rays(torch.tensor([[0.0, 0.0, 0.5]], dtype=F64), steep, WAVE)
    ghost = ghost_path_system(system, (2, 1))
    hit = trace_rays(ghost, start, 1.0, first=2)
    assert hit.status.tolist() == [Status.TIR] and hit.surface.tolist() == [4]


@pytest.mark.parametrize("kind", ["tilted", "broken"])
def test_gradients_of_a_path_are_differences(kind):
    """With respect to shapes, gaps, poses, an index and what breaks do."""
    made, rays = lens(kind), pencil()
    path = (len(made.surfaces) - 1, 2)
    start = {name: p.detach().clone() for name, p in made.named_parameters()}
    start["media.1.index_offset"] = torch.tensor(1e-3, dtype=F64)

    def landed(values):
        # All rays whatever the apertures are: none comes or goes within a difference.
        hit = trace_rays(ghost_path_system(made.system(values), path).opened(), rays)
        assert int(hit.valid.sum()) > 10
        weight = torch.linspace(0.5, 1.5, hit.valid.sum(), dtype=F64)
        return (hit.position[hit.valid][:, :2] @ torch.tensor([1.0, 0.7], dtype=F64) * weight).sum()

    leaves = {name: p.clone().requires_grad_() for name, p in start.items()}
    landed(leaves).backward()
    for name in start:
        step = 1e-7 if name.endswith(("curvature", "a4")) else 1e-5
        step = 1e-9 if name.endswith("a4") else step
        up, down = ({**start, name: start[name] + s * step} for s in (1.0, -1.0))
        with torch.no_grad():
            slope = float(landed(up) - landed(down)) / (2.0 * step)
        found = float(leaves[name].grad)
        assert math.isclose(found, slope, rel_tol=2e-5, abs_tol=1e-3), name


def test_single_precision_lands_where_double_does():
    for path in ((6, 1), (5, 4), (3, 2)):
        exact, single = (
            load_lens("cooke_triplet", dtype=kind).requires_grad_(False)
            for kind in (F64, torch.float32)
        )
        rays = pencil()
        a = trace_rays(ghost_path_system(exact.system(), path), rays)
        b = trace_rays(ghost_path_system(single.system(), path), rays)
        both = a.valid & b.valid
        assert int(both.sum()) > 20 and torch.equal(a.valid, b.valid)
        assert float((a.position - b.position)[both].abs().max()) < 5e-4
