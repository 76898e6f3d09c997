"""Ghosts as operands: their numbers beside the analysis, their derivatives beside differences."""

import math

import pytest
import torch

from dolens import InputError, load_lens
from dolens.analysis.conditions import conditions
from dolens.analysis.ghosts import ghosts
from dolens.optimize.operands import LensProperties, operand

WAVE = 587.5618


@pytest.fixture(scope="module")
def triplet():
    return load_lens("cooke_triplet").requires_grad_(False)


def properties(lens, kept=None):
    return LensProperties(lens.system(), WAVE, None, {}, {} if kept is None else kept)


def test_numbers_are_those_of_the_analysis(triplet):
    """Within the errors of some hundred rays, and of coatings at normal incidence."""
    lens = triplet
    given = {"field": [0.0, 8.0], "min": 0.0}
    rms, light = (
        operand({"kind": kind, **given}, lens).values(properties(lens))
        for kind in ("ghost_rms", "log_ghost_irradiance")
    )
    free = load_lens("cooke_triplet").requires_grad_(False)
    free.sensor_diameter = None  # the operands count light beside the sensor too
    found = ghosts(free, conditions(free, 8.0, WAVE))
    assert len(rms) == len(light) == 15
    for number, path in enumerate(found.paths):
        label = f"{'-'.join(map(str, path))}/0,8"
        size, exact = float(rms[f"ghost_rms/{label}"]), float(found.measures.rms[number])
        assert math.isclose(size, exact, rel_tol=0.15), path
        level = float(light[f"log_ghost_irradiance/{label}"])
        wanted = math.log10(float(found.measures.irradiance[number]))
        assert abs(level - wanted) < 0.15, path


def test_the_focus_is_that_of_first_order_optics(triplet):
    one = operand({"kind": "ghost_focus", "paths": [[2, 1]], "target": 0.0}, triplet)
    ((label, value),) = one.values(properties(triplet)).items()
    found = ghosts(triplet, conditions(triplet, 0.0, WAVE), rays=100, paths=[(2, 1)])
    assert label == "ghost_focus/2-1"
    assert math.isclose(float(value), float(found.first_order.focus[0]), rel_tol=1e-12)


@pytest.mark.parametrize("kind", ["ghost_rms", "log_ghost_irradiance", "ghost_focus"])
def test_derivatives_are_differences(kind):
    """Of the very numbers: rays that were chosen at the start stay chosen."""
    lens = load_lens("cooke_triplet").requires_grad_(False)
    paths = [[6, 1], [5, 4], [3, 2]]
    one = operand({"kind": kind, "paths": paths, "field": [0.0, 10.0], "min": 0.0}, lens)
    start = {n: p.detach().clone() for n, p in lens.named_parameters()}
    kept: dict = {}
    one.values(properties(lens, kept))

    def values(given):
        found = one.values(properties(lens.with_values(given), kept))
        return torch.stack([*found.values()])

    leaves = {name: value.clone().requires_grad_() for name, value in start.items()}
    found = values(leaves)
    for row in range(len(paths)):
        slopes = torch.autograd.grad(found[row], [*leaves.values()], retain_graph=True)
        for name, slope in zip(start, slopes, strict=True):
            step = 1e-7 if name.endswith("curvature") else 1e-5
            ends = [values({**start, name: start[name] + s * step}) for s in (1.0, -1.0)]
            difference = float(ends[0][row] - ends[1][row]) / (2.0 * step)
            assert math.isclose(float(slope), difference, rel_tol=1e-5, abs_tol=1e-5), (name, row)


def test_a_lens_is_designed_against_a_ghost(triplet):
    """The brightest one, which is focused near the sensor, spreads."""
    wanted = {"min": 9.0, "paths": [[6, 1]], "field": (0.0, 0.0), "weight": 100.0}
    free = [f"surfaces.{n}.curvature" for n in range(1, 7)]
    before = ghosts(triplet, conditions(triplet, 0.0, WAVE), rays=2000, paths=[(6, 1)])
    better = triplet.optimize(free, keep={"efl": 50.0, "ghost_rms": wanted}, iterations=15)
    after = ghosts(better, conditions(better, 0.0, WAVE), rays=2000, paths=[(6, 1)])
    (shown,) = [o for o in better.optimization.operands if o.label.startswith("ghost_rms")]
    assert shown.before < 6.5 and shown.after > 8.9
    # Apertures, which stayed as they were, clip a part of the larger ghost.
    assert float(after.measures.rms[0]) > 1.1 * float(before.measures.rms[0])
    assert float(after.measures.irradiance[0]) < 0.75 * float(before.measures.irradiance[0])
    assert "ghost_rms/6-1/0,0" in repr(better.optimization)


def test_a_ghost_that_there_is_not_is_refused(triplet):
    with pytest.raises(InputError, match=r"ghost path \(1, 6\)"):
        operand({"kind": "ghost_rms", "paths": [[1, 6]], "min": 1.0}, triplet)
