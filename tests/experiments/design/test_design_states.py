"""A design over the states of a lens as an experiment: metrics, files, resumed."""

import pytest
from omegaconf import open_dict

from dolens import InputError
from dolens.experiments.running.training import run
from tests.experiments.runs import Finished, same_to_the_bit
from tests.experiments.tiny_experiment import ONE_EPOCH, UNPICTURED

QUIET = ["+trainer.enable_progress_bar=false", "optimizer=damped_least_squares"]
STATES = {
    "far": {"sensor": {"distance": 26.0}},
    "near": {
        "object_distance": 2000.0,
        "fields": {"heights": [[0, 0]]},
        "sensor": {"distance": 26.8},
    },
}
VARIABLES = {
    "surfaces.[12].curvature": {"scale": 0.01},
    "states.far.sensor_distance": {"solve": "best_focus"},
    "states.near.sensor_distance": None,
}


UNTESTED = [UNPICTURED, "test=false", "objective=train/merit"]


@pytest.fixture
def searched(composed, tmp_path):
    """Design the supplement's asphere, focused at two distances, as overrides and changes say."""

    def search(*overrides, change=lambda cfg: None, folder="run"):
        cfg = tiny(composed("experiment=asphere", *QUIET, *overrides, folder=folder))
        change(cfg)
        return Finished(tmp_path / folder, run(cfg))

    return search


def tiny(cfg):
    with open_dict(cfg):
        cfg.lens.surfaces["1"].semi_diameter = 6.0
        cfg.lens.surfaces["2"].clips = False
        cfg.lens.states, cfg.variables, cfg.published = STATES, VARIABLES, None
        cfg.lens.fields = {"angles": [[0.0, 0.0]]}
        cfg.merit.fields = cfg.evaluation = None
        cfg.merit.sampling = "gaussian_quadrature"
        cfg.merit.sampling_options = {"rings": 3, "arms": 6}
        cfg.merit.operands = [{"kind": "efl", "state": "far", "target": 40.0}]
    return cfg


def test_a_run_folder_of_a_lens_with_states(searched):
    found = searched("data.iterations=2", ONE_EPOCH, UNPICTURED, "keep_pupils=true")
    metrics, lens, rms = found.metrics, found.lens(), found.objective
    means = [metrics[f"rms_spot_um/final/{name}"] for name in STATES]
    assert rms == metrics["rms_spot_um/final"] == pytest.approx(sum(means) / 2.0, rel=1e-6)
    assert rms < metrics["rms_spot_um/initial"]
    assert "operand/far/efl" in found.table("history")[0]
    # The stop lets the prescription's beams in, at both distances.
    initial = found.lens("initial")
    for name in STATES:
        pupils = [
            float(one.in_state(name).first_order().entrance_pupil.diameter.detach())
            for one in (initial, lens)
        ]
        assert pupils[0] == pytest.approx(pupils[1], rel=1e-9)
    assert metrics["efl_mm/far"] == pytest.approx(
        float(lens.in_state("far").first_order(lens.primary_wavelength).efl.detach()), rel=1e-6
    )


def test_a_resumed_search_repeats_an_uninterrupted_one(searched):
    """Operands alone, which need no rays."""

    def without_rays(cfg):
        cfg.variables = {
            "surfaces.[12].curvature": {"scale": 0.01},
            "states.near.sensor_distance": None,
        }
        cfg.merit.quality = None
        cfg.merit.operands = [
            {"kind": "bfd", "state": "far", "target": 24.0},
            {"kind": "efl", "target": 41.0},
            {"kind": "total_track", "state": "near", "target": 45.0},
        ]

    settings = ["module.round_tolerance=0.0", "data.iterations=1", *UNTESTED]
    two = [*settings, "trainer.max_epochs=2"]
    whole = searched(*two, change=without_rays, folder="whole")
    first = searched(*settings, ONE_EPOCH, change=without_rays, folder="first")
    again = searched(*two, f"ckpt_path={first.last}", change=without_rays, folder="second")
    assert same_to_the_bit(whole.lens().state_dict(), again.lens().state_dict())
    moved = float(whole.lens().in_state("near").sensor_distance.detach())
    assert moved != STATES["near"]["sensor"]["distance"]


def test_a_run_takes_one_state(searched):
    def of_a_curvature(cfg):
        cfg.variables = {"surfaces.1.curvature": None}
        cfg.merit.operands = []

    found = searched("state=near", "data.iterations=1", ONE_EPOCH, *UNTESTED, change=of_a_curvature)
    lens = found.lens("initial")
    assert (lens.object_distance, float(lens.sensor_distance.detach())) == (2000.0, 26.8)
    assert lens.state_names == ()
    with pytest.raises(InputError, match="no state 'nearer'"):
        searched("state=nearer", folder="other")
