"""scripts/search_by_others.py: a task in plain numbers against dolens, and the table of runs."""

import json

import numpy as np
import pytest
import torch

from dolens.lens_search.starts import random_starts
from scripts.lens_search.plain_task import Beams, PlainTask
from scripts.search_by_others import Run, Task, kept, table

TASKS = [("search_triplet", 2), ("search_double_gauss", 2), ("search_phone", 0)]


@pytest.fixture(params=TASKS, ids=[name for name, _ in TASKS])
def both(request):
    """Return the merit of a task, the same in plain numbers, and a random lens of both."""
    of = Task.of(*request.param)
    data = json.loads(json.dumps(of.as_plain(5.0)))
    plain = PlainTask(data)
    u = random_starts(of.merit, 4, torch.Generator().manual_seed(1))[:1]
    if any(plain.terms):
        more = torch.linspace(-1.0, 1.0, sum(plain.terms), dtype=torch.float64)
        u[0, -len(more) :] = more
    return of, plain, u


def test_bounds_are_those_of_the_search(both):
    of, plain, _ = both
    low, high = np.array(of.bounds(5.0)).T
    assert plain.bounds / np.array(plain.scales) == pytest.approx(np.array([low, high]))
    assert high[: plain.surfaces] == pytest.approx(5.0)


def test_first_order_optics_is_that_of_dolens(both):
    of, plain, u = both
    lens = plain.lens(u[0].numpy() * np.array(plain.scales))
    power, pupil, _, _ = of.merit.paraxial_of(u)
    focal_length, distance = plain.paraxial(lens)
    f = plain.focal_length
    assert f / focal_length == pytest.approx(power.item(), rel=1e-10)
    assert distance == pytest.approx(f * pupil.item(), rel=1e-10, abs=1e-12)


def test_limits_of_paraxial_beams_are_those_of_dolens(both):
    of, plain, u = both
    merit, f = of.merit, plain.focal_length
    _, found = merit.first_order(u)
    aperture, tangent = 0.5 / plain.f_number, max(plain.field_tangents)
    rays = zip(found.marginal, found.chief, strict=True)
    heights = [abs(float(m)) * aperture + abs(float(c)) * tangent for m, c in rays]
    ideal = f * np.array(plain.chief_tangents)
    beams = Beams(
        plain.paraxial(plain.lens(u[0].numpy() * np.array(plain.scales)))[0],
        f * np.array(heights),
        f * abs(float(found.stop_height)) * aperture,
        ideal,
        np.zeros(ideal.size),
    )
    own = plain.deviations(plain.lens(u[0].numpy() * np.array(plain.scales)), beams)
    theirs = merit.deviations(u, merit.full(1))[0]
    real = (plain.limits["distortion"], plain.limits["chief_ray_angle"]).count(None)
    paraxial = len(theirs) - (2 - real) * merit.rays.chiefs
    theirs = torch.where(merit.is_limit, theirs.clamp(min=0.0), theirs)[:paraxial]
    assert len(own) == merit.operands
    assert np.count_nonzero(own) > 1
    assert own[0] == pytest.approx(theirs[0].item(), abs=1e-12)
    assert np.sort(own[1:paraxial]) == pytest.approx(np.sort(theirs[1:].numpy()), abs=1e-10)


def test_distortion_and_angles_of_chief_rays_are_limited(both):
    _, plain, u = both
    lens = plain.lens(u[0].numpy() * np.array(plain.scales))
    limits, ideal = plain.limits, plain.focal_length * np.array(plain.chief_tangents)

    def chief(heights, sines):
        beams = Beams(100.0, np.zeros(plain.surfaces), 0.0, heights, sines)
        kinds = (limits["distortion"], limits["chief_ray_angle"])
        count = len(ideal) * sum(kind is not None for kind in kinds)
        return plain.deviations(lens, beams)[-count:]

    none = np.zeros(ideal.size)
    assert not chief(ideal, none).any()
    over = chief(ideal * (1.0 + limits["distortion"]), none)[: ideal.size]
    assert 0.0 < over.min() <= over.max() < 0.02 * limits["distortion"]
    if limits["chief_ray_angle"]:
        steep = np.sin(np.radians(limits["chief_ray_angle"] + 1.0)) + none
        assert chief(ideal, steep)[-ideal.size :].min() > 0.01


def test_runs_are_kept_and_tabled(tmp_path):
    for seed, spot in enumerate((10.92, None, 9.5)):
        Run("search_x", "a method", seed, 115.0, 1200, [0.5], spot).keep(tmp_path)
    Run("search_y", "a method", 0, 1.0, 1, None, None).keep(tmp_path)
    runs = kept(tmp_path, "search_x")
    assert [run.seed for run in runs] == [0, 1, 2]
    assert runs[0].path(tmp_path).name == "search_x_a_method_0.json"
    last = table(runs).splitlines()[-1]
    assert last == "| a method | 3 | 115 | 1.2e+03 | 10.92, none, 9.5 |"
