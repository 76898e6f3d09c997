"""The source's classical designs, from its own starts, without any experiment around them."""

import pytest
import torch

from dolens import load_lens
from dolens.optimize import DampedLeastSquares, DesignVariables, MeritSettings


def design(lens, variables, merit, iterations, **options):
    """Merit before and after, and the optimizer."""
    variables = DesignVariables(lens, variables)
    function = merit.build(lens, variables)
    optimizer = DampedLeastSquares([variables.scaled], **options)
    start = function().sum_of_squares()
    for _ in range(iterations):
        optimizer.step(function)
        if optimizer.stopped:
            break
    end = function()
    end.write_to(lens)
    return start, end, optimizer


def mean_rms_um(value):
    return 1e3 * float(value.quality.rms.mean())


def test_the_asphere_of_table_1(root):
    """At 532.8 nm through 31×31 rays, half-width 15 mm: 25.3 µm to below the published 4.29 µm."""
    lens = load_lens(root / "conf/lens/asphere.yaml", index_model="do")
    variables = {
        "surfaces.1.curvature": None,
        "surfaces.1.conic": None,
        "surfaces.1.a4": {"scale": 1e-6},
    }
    merit = MeritSettings(sampling="square_grid", sampling_options={"half_width": 15.0})
    start, end, optimizer = design(lens, variables, merit, 20)
    assert start**0.5 == pytest.approx(25.3, abs=0.05)
    assert optimizer.stopped and optimizer.last.merit < 2.9**2
    assert mean_rms_um(end) < 4.29


def test_the_nikon_lens_of_table_2(root):
    """From spheres, mean of twelve spots: 28.06 µm to 0.18 µm; the source ends at 0.36."""
    lens = load_lens(root / "conf/lens/nikon.yaml", index_model="do")
    with torch.no_grad():
        for parameter in lens.variables(["surfaces.1[78].a*", "surfaces.1[78].conic"]).values():
            parameter.zero_()
    variables = {
        "surfaces.[1-9].curvature": None,
        "surfaces.1[0-13-9].curvature": None,
        "surfaces.20.curvature": None,
        "surfaces.1[78].conic": None,
        "surfaces.1[78].a4": None,
    }
    merit = MeritSettings(sampling="square_grid")
    _, end, optimizer = design(lens, variables, merit, 80)
    assert optimizer.last.merit < 0.19**2
    assert mean_rms_um(end) < 0.18
    # On all rays that pass the finished lens, not only on those that passed the first.
    spots = merit.build(lens, DesignVariables(lens, {"sensor_distance": None}))()
    assert mean_rms_um(spots) < 0.18


def test_the_best_focus_is_where_a_free_sensor_would_go(root):
    """Solved at every step, or one variable among the others: the same lens."""
    ends = []
    for sensor in ({"solve": "best_focus"}, None):
        lens = load_lens(root / "conf/lens/cooke_triplet.yaml")
        variables = {"surfaces.[246].curvature": {"scale": 0.01}, "sensor_distance": sensor}
        merit = MeritSettings(
            fields=[(0, 0), (0, 14)],
            wavelengths=[587.5618],
            operands=[{"kind": "efl", "target": 50.0}],
        )
        start, end, optimizer = design(lens, variables, merit, 200)
        assert optimizer.stopped and end.sum_of_squares() < 0.8 * start
        assert float(lens.sensor_distance) == end.sensor_distance
        ends.append((end.sum_of_squares(), end.sensor_distance))
    assert ends[0][0] == pytest.approx(ends[1][0], rel=1e-6)
    assert ends[0][1] == pytest.approx(ends[1][1], abs=1e-4)
