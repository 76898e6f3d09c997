"""The bench of the pose experiments: what it simulates, and which settings it refuses."""

import copy

import pytest
import torch

from dolens.alignment.measurement import Light
from dolens.errors import InputError
from dolens.experiments.poses.bench import Bench, Observations, draw, light_of, simulate
from dolens.experiments.poses.fit_plan import fit_plan
from dolens.sensor.pixels import Sensor

BENCH = Bench(622.5, Sensor(32, 32, 0.15), [[0.0, 0.0, -864.0]])
TILT, DISTANCE = "elements.lens.tilt_x", "sensor_distance"


def plan(fits):
    return fit_plan(fits, [{"optimizer": "dls", "iterations": 1}])


def test_a_fit_that_holds_a_number_has_the_truth_of_the_fit_that_finds_it(singlet):
    fits = plan(
        {
            "bench": {"variables": {DISTANCE: None}, "truth": {DISTANCE: 119.0, TILT: 1.0}},
            "lens": {
                "variables": {TILT: None},
                "truth": {TILT: -5.0},
                "held": {"from": "bench", "variables": [DISTANCE]},
            },
        }
    ).fits
    observed = Observations(singlet, BENCH, Light(10_000), fits, None, seed=0)
    assert observed.truth(0) == {DISTANCE: 119.0, TILT: 1.0}
    assert observed.truth(1) == {DISTANCE: 119.0, TILT: -5.0}
    true = observed.true_pose(1)
    assert float(true.lens.sensor_distance) == 119.0
    # What a fit explains is simulated once, and is its measurement of number 0.
    assert observed.measured(1) is observed.measured(1)
    again = observed.simulated(1, 0, observed.light)
    assert torch.equal(observed.measured(1).images, again.images)
    assert float(singlet.sensor_distance) != 119.0


def test_every_photon_behind_the_lens_is_counted_where_the_sensor_is_wide(singlet):
    light = Light(photons=5000, read_noise=0.0)
    wide = Bench(622.5, Sensor(64, 64, 1.0), BENCH.sources, (0.0, -2.0))
    found = simulate(wide.pose(copy.deepcopy(singlet)), wide, light, draw(0, 0, 0))
    assert (wide.images, len(found.images)) == (2, 2)
    assert found.images.sum((-2, -1)).tolist() == [5000.0, 5000.0]


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Light(photons=0), "photons: 0; allowed: 1 or more"),
        (lambda: light_of(read_noise=-1.0), r"read_noise: -1\.0; allowed: 0 or more"),
        (lambda: light_of(unmodelled={"radii": 0.1}), "unmodelled: unknown key 'radii'"),
        (lambda: plan({}), "fits: none is given"),
        (lambda: plan({"a": {"truht": {}}}), "unknown key 'truht'; did you mean 'truth'"),
        (
            lambda: plan({"a": {"held": {"from": "b", "variables": [TILT]}}}),
            r"fits\.a\.held\.from: 'b' is no earlier fit; allowed: none",
        ),
    ],
)
def test_bad_settings_are_one_line(make, said):
    with pytest.raises(InputError, match=said):
        make()
