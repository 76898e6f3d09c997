"""scripts/lens_search: the plain tracers by closed forms, against each other and against dolens."""

import importlib
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import dolens

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
# Two positive lenses, a negative and a positive one, by hand: EFL about 100 mm, nothing optimal.
RADII = np.array([70.0, 300.0, 45.0, 80.0, -60.0, 40.0, 150.0, -60.0])
QUARTET = np.append(1.0 / RADII, [6.0, 1.0, 7.0, 12.0, 3.0, 14.0, 6.0, 60.0, 20.0])


@pytest.fixture
def part(monkeypatch):
    """Return a function that imports a module of scripts/lens_search."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    before = set(sys.modules)
    yield lambda name: importlib.import_module(f"lens_search.{name}")
    for name in set(sys.modules) - before:
        if name.startswith("lens_search"):
            del sys.modules[name]


@pytest.fixture
def file(part, tmp_path):
    """Return a function that writes surfaces (radius, gap, material) as a lens file."""

    def write(rows, **more):
        surfaces = [
            f"  '{k}': {{type: sphere, radius: {r}, thickness: {t}, material: {m}}}"
            for k, (r, t, m) in enumerate(rows, 1)
        ]
        path = tmp_path / "lens.yaml"
        head = {"stop": 1, "entrance_pupil_diameter": 20.0, **more}
        lines = [f"{key}: {json.dumps(value)}" for key, value in head.items()]
        path.write_text("\n".join([*lines, "surfaces:", *surfaces]) + "\n")
        return part("plain_lens").read(path)

    return write


def one(part, curvature, gap, index, image, angle, px=0.0, py=0.0, pupil=0.0):
    """x and y of one ray (mm) with a pupil of 20 mm, by the plain tracer."""
    trace = part("plain_trace")
    ray = trace.PupilRays(*np.array([[px], [py], [1.0]]), np.array([True]))
    lens = np.atleast_2d(curvature), np.atleast_2d(gap), np.array(index)
    found = trace.trace(
        *lens, np.array([image]), np.array([pupil]), 20.0, np.array([float(angle)]), ray
    )
    assert found.lacking == 0.0
    return found.x.item(), found.y.item()


def test_the_quadrature_is_exact_over_the_disk(part):
    rays = part("plain_trace").pupil_rays(4, 8, rim=3)
    assert rays.weight.sum() == pytest.approx(1.0)
    assert (rays.x[rays.chief], rays.y[rays.chief]) == (0.0, 0.0)
    for power, mean in ((2, 1 / 4), (4, 1 / 8), (6, 5 / 64)):
        assert (rays.weight * rays.y**power).sum() == pytest.approx(mean)
    assert (rays.weight * rays.x**2 * rays.y**2).sum() == pytest.approx(1 / 24)
    assert np.hypot(rays.x, rays.y)[rays.rim] == pytest.approx(1.0)


@pytest.mark.parametrize("exact", [False, True])
def test_a_plane_plate_displaces_by_its_closed_form(part, file, exact):
    angle, thickness, index, rest = 40.0, 7.0, 1.6, 5.0
    tilt = math.radians(angle)
    inside = math.asin(math.sin(tilt) / index)
    expected = thickness * math.tan(inside) + rest * math.tan(tilt)
    if exact:
        # A plate has no focus, so no pupil by first-order optics: the ray is given.
        lens = file([(".inf", thickness, index), (80.0, 0.0, "air")], sensor={"distance": rest})
        plate = part("exact_trace").ExactLens(lens, 550.0)
        mp = part("exact_trace").mp
        plate.curvature[1] = mp.mpf(0)
        ray = plate.trace((0, 0, 0), (0, mp.sin(mp.mpf(tilt)), mp.cos(mp.mpf(tilt))))
        assert float(ray.y) == pytest.approx(expected, rel=1e-14)
    else:
        _, y = one(part, [0.0, 0.0], [thickness], [index, 1.0], rest, angle)
        assert y == pytest.approx(expected, rel=1e-14)


def singlet(height, index, radius, image):
    """Where a ray lands that enters the plane face of a plano-convex lens along the axis."""
    inner = math.asin(height / radius)
    deviation = math.asin(index * math.sin(inner)) - inner
    sag = -(radius - math.sqrt(radius**2 - height**2))
    return height - (image - sag) * math.tan(deviation)


def test_the_spherical_aberration_of_a_singlet(part, file):
    index, radius, image = 1.5168, 50.0, 96.0
    for height in (2.0, 6.0, 10.0):
        _, y = one(part, [0.0, -1 / radius], [4.0], [index, 1.0], image, 0.0, py=height / 10)
        assert y == pytest.approx(singlet(height, index, radius, image), abs=1e-13)
    lens = file([(".inf", 4.0, index), (-radius, 0.0, "air")], sensor={"distance": image})
    rays = part("plain_trace").pupil_rays(6, 4)
    spot = part("exact_trace").spots(lens, rays)
    radii = np.hypot(rays.x, rays.y)[rays.weight > 0.0] * 10.0
    square = [singlet(h, index, radius, image) ** 2 for h in radii]
    rms = 1e3 * math.sqrt(np.dot(rays.weight[rays.weight > 0.0], square))
    assert float(spot.rms[0]) == pytest.approx(rms, rel=1e-13)
    assert (spot.failed, float(spot.height[0])) == (0, pytest.approx(10.0))


def test_narrow_beams_meet_where_first_order_optics_says(part):
    quartet, plain = part("quartet"), part("plain_trace")
    curvature, gap, _, _ = quartet.split(QUARTET[None])
    focal, back = plain.first_order(curvature, gap, quartet.INDICES)
    _, y = one(part, curvature, gap, quartet.INDICES, back[0], 0.0, py=1e-4)
    assert abs(y) < 1e-10
    _, y = one(part, curvature, gap, quartet.INDICES, back[0], 1e-4, py=0.0)
    assert y == pytest.approx(focal[0] * math.tan(math.radians(1e-4)), rel=1e-6)


def test_both_tracers_and_dolens_see_the_same_spots(part, tmp_path):
    files, quartet = part("quartet_files"), part("quartet")
    path = tmp_path / "quartet.yaml"
    files.write(QUARTET, path, "a quartet")
    assert files.candidate(path) == pytest.approx(QUARTET, rel=1e-14)
    rays = part("plain_trace").pupil_rays(2, 4)
    measured = quartet.measure(QUARTET[None], rays)
    exact = part("exact_trace").spots(part("plain_lens").read(path), rays)
    assert [float(r) for r in exact.rms] == pytest.approx(measured.rms[0], rel=1e-12)
    ideal = 100.0 * np.tan(np.radians(quartet.ANGLES[1:]))
    chief = np.array([float(y) for y in exact.chief[1:]]) / ideal - 1.0
    assert chief == pytest.approx(measured.distortion[0], abs=1e-12)
    lens = dolens.load_lens(path, dtype=torch.float64)
    assert lens.first_order(587.5618).efl.item() == pytest.approx(measured.focal_length[0])
    radius = 100.0 / 3.0 / 2.0
    spots = []
    for angle in np.radians(quartet.ANGLES):
        start = [[radius * x, radius * y, 0.0] for x, y in zip(rays.x, rays.y, strict=True)]
        along = [0.0, math.sin(angle), math.cos(angle)]
        double = {"dtype": torch.float64}
        hit = lens.trace(
            dolens.Rays(torch.tensor(start, **double), torch.tensor(along, **double), 587.5618)
        )
        x, y = hit.position[:, 0].detach().numpy(), hit.position[:, 1].detach().numpy()
        y = y - (rays.weight * y).sum()
        spots.append(1e3 * math.sqrt((rays.weight * (x**2 + y**2)).sum()))
    assert spots == pytest.approx(measured.rms[0], rel=1e-10)


def test_rays_aimed_at_the_stop_meet_its_rim(part):
    exact = part("exact_trace")
    lens = part("plain_lens").read(SCRIPTS.parent / "conf" / "lens" / "cooke_triplet.yaml")
    at = exact.ExactLens(lens, lens.reference)
    first = dolens.load_lens(lens.path, dtype=torch.float64).first_order(lens.reference)
    assert float(at.focal_length) == pytest.approx(first.efl.item(), rel=1e-12)
    assert float(at.pupil) == pytest.approx(first.entrance_pupil.z.item(), rel=1e-9)
    ray = at.through_stop(20.0, 0.6, -0.8)
    x, y = (float(v) for v in ray.points[lens.stop])
    assert (x, y) == pytest.approx((0.6 * 3.86, -0.8 * 3.86), rel=1e-12)
    other = at.through_pupil(20.0, 0.6, -0.8)
    assert math.dist(map(float, other.points[lens.stop]), (x, y)) > 0.01


def test_both_tracers_aim_at_the_same_stop(part, tmp_path):
    """In 80 digits and in NumPy; and where the stop is in front, both measures are one."""
    files, real, quartet = part("quartet_files"), part("real_stop"), part("quartet")
    rays = part("plain_trace").pupil_rays(1, 3)
    front = QUARTET.copy()
    front[16] = -15.0
    aimed = real.measure(front, rays)
    assert aimed.rms == pytest.approx(quartet.measure(front[None], rays).rms, rel=1e-12)
    row = part("stops").with_stop(np.append(QUARTET[:16], 5.0)[None], np.array([2]))[0]
    path = tmp_path / "air.yaml"
    files.write(row, path, "a stop in its second air space")
    data = yaml.safe_load(path.read_text())
    rows = list(data["surfaces"].values())[1:]
    rows[3]["thickness"] = 5.0
    rows.insert(4, {"type": "aperture", "semi_diameter": 9.0, "thickness": float(row[11]) - 5.0})
    data |= {"stop": 5, "surfaces": {str(k): entry for k, entry in enumerate(rows, 1)}}
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    # As wide as the real axial beam of f/3 is there, which is what the plain tracer takes.
    exact = part("exact_trace")
    lens = part("plain_lens").read(path)
    at = exact.ExactLens(lens, lens.reference)
    rim = at.through_pupil(0.0, 0.0, 1.0).points[4][1]
    data["surfaces"]["5"]["semi_diameter"] = float(rim)
    del data["entrance_pupil_diameter"]
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    spots = exact.spots(part("plain_lens").read(path), rays, aimed=True)
    found = real.measure(row, rays, files.stop_of(path))
    assert found.rms[0] == pytest.approx([float(r) for r in spots.rms], rel=1e-9)


def test_limits_are_seen(part):
    quartet = part("quartet")
    broken = QUARTET.copy()
    broken[8], broken[15] = 0.5, 20.0
    said = " ".join(quartet.measure(broken[None]).broken)
    assert "thinnest glass 1 by 1.5" in said
    assert "back focus by 10" in said
    # Two spheres of R = 50 that are 1 mm apart cross where each has a sag of 0.5 mm.
    cross = math.sqrt(50.0**2 - 49.5**2)
    gap = quartet.gap_at(np.array([[0.02, -0.02]]), np.array([[1.0]]), np.array([[cross]]))
    assert gap.item() == pytest.approx(0.0, abs=1e-13)


def test_rays_that_fail_are_counted_and_stay_finite(part):
    quartet = part("quartet")
    points = np.random.default_rng(0).random((64, 17))
    found = quartet.LOWER + (quartet.UPPER - quartet.LOWER) * points
    measured = quartet.measure(found)
    assert np.isfinite(measured.mean).all() and np.isfinite(quartet.residuals(found)).all()
    failing = quartet.LIMITS.index("rays that fail")
    assert (measured.excess[:, failing] > 0.0).any()
    assert not measured.feasible.any()


def test_forms_are_counted_once(part):
    quartet = part("quartet")
    near, far = QUARTET.copy(), QUARTET.copy()
    near[0] += 1e-4
    far[3] += 0.01
    assert quartet.forms(np.array([far, near, QUARTET]), np.array([3.0, 1.0, 2.0])) == [1, 0]


def test_a_search_improves_and_ends_with_its_budget(part):
    budget, least_squares, quartet = (part(n) for n in ("budget", "least_squares", "quartet"))
    progress = budget.Progress(1e9)
    _, found = least_squares.finish(QUARTET, progress, "lm", most=20)
    first, last = (quartet.measure(row[None]) for row in (QUARTET, found))
    assert last.mean < 0.5 * first.mean
    assert progress.evaluations > 100
    assert json.loads(json.dumps(progress.as_data()))["started"] == 1
    with pytest.raises(budget.OutOfTime):
        least_squares.finish(QUARTET, budget.Progress(0.0), "lm")


def test_a_stop_in_air_makes_the_pupil_that_dolens_sees(part, tmp_path):
    stops, files, quartet = part("stops"), part("quartet_files"), part("quartet")
    for segment, place in ((0, 7.0), (1, 0.4), (2, 5.0), (3, 9.0)):
        row = QUARTET.copy()
        row[16] = place
        found = stops.with_stop(row[None], np.array([segment]))[0]
        assert stops.segment_of(found) == (segment, pytest.approx(place))
        assert quartet.stop_depth(found[None]) == 0.0
        path = tmp_path / "stop.yaml"
        files.write(found, path, "a stop")
        if segment:
            text = path.read_text().replace("stop: 1\n", f"stop: {2 * segment + 1}\n")
            data = yaml.safe_load(text)
            rows = list(data["surfaces"].values())[1:]
            gap = rows[2 * segment - 1]["thickness"]
            rows[2 * segment - 1]["thickness"] = place
            rows.insert(2 * segment, {"type": "aperture", "semi_diameter": 9.0, "material": "air"})
            rows[2 * segment]["thickness"] = gap - place
            data["surfaces"] = {str(k): entry for k, entry in enumerate(rows, 1)}
            path.write_text(yaml.safe_dump(data, sort_keys=False))
        assert files.candidate(path) == pytest.approx(found, rel=1e-12)
        assert files.stop_of(path) == (segment, pytest.approx(place))
        pupil = dolens.load_lens(path, dtype=torch.float64).first_order(587.5618).entrance_pupil
        first = 0.0 if segment else place
        assert pupil.z.item() - first == pytest.approx(found[16], rel=1e-9)
    # Behind the first face, in the middle of a lens: no diaphragm can stand there.
    inside = QUARTET.copy()
    inside[16] = 3.0 / 1.5168
    inside[0] = 0.0
    assert quartet.stop_depth(inside[None]) == pytest.approx(3.0)


def test_both_spaces_give_back_their_points(part):
    spaces = part("spaces")
    for name, space in spaces.SPACES.items():
        found, wrong = space.candidates(space.point(QUARTET)[None])
        assert wrong == 0.0
        if name == "plain":
            assert found[0] == pytest.approx(QUARTET, rel=1e-12)
        else:
            measured = part("quartet").measure(found)
            assert measured.focal_length == pytest.approx(100.0, rel=1e-12)


def test_the_table_reads_runs_and_lens_files(part, tmp_path, capsys, monkeypatch):
    compare = part("compare")
    run = {"seconds": 60.0, "evaluations": 10, "started": 1, "designs": [], "nearest": None}
    run["history"] = [(2.0, 5, 30.0, QUARTET.tolist()), (70.0, 9, 20.0, QUARTET.tolist())]
    (tmp_path / "direct_1.json").write_text(json.dumps(run))
    part("quartet_files").write(QUARTET, tmp_path / "forms" / "a.yaml", "a")
    words = ["compare.py", "--table", "--out", str(tmp_path), "--ours", str(tmp_path / "forms")]
    monkeypatch.setattr(sys, "argv", words)
    compare.main()
    printed = capsys.readouterr().out
    assert "| direct | 1 | 10 | 30 |  |  |" in printed
    assert "a.yaml: " in printed and "focal length by" in printed
