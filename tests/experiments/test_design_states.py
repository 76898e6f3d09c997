"""A design over the states of a lens as an experiment: metrics, files, resumed."""

import json

import pytest
import torch
from omegaconf import open_dict

from dolens import InputError, load_lens
from dolens.experiments.running.training import run

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


UNTESTED = ["callbacks.pictures=null", "test=false", "objective=train/merit"]


def tiny(composed, *more):
    """The supplement's asphere, focused at two distances."""
    folder = next((m.removeprefix("folder=") for m in more if m.startswith("folder=")), "run")
    more = [m for m in more if not m.startswith("folder=")]
    cfg = composed("experiment=asphere", *QUIET, *more, folder=folder)
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


def metrics_of(folder):
    return json.loads((folder / "metrics.json").read_text())


def test_a_run_folder_of_a_lens_with_states(composed, tmp_path):
    small = ["data.iterations=2", "trainer.max_epochs=1", "callbacks.pictures=null"]
    rms = run(tiny(composed, *small, "keep_pupils=true"))
    metrics, lens = metrics_of(tmp_path / "run"), load_lens(tmp_path / "run/lens/final.yaml")
    means = [metrics[f"rms_spot_um/final/{name}"] for name in STATES]
    assert rms == metrics["rms_spot_um/final"] == pytest.approx(sum(means) / 2.0, rel=1e-6)
    assert rms < metrics["rms_spot_um/initial"]
    assert "operand/far/efl" in (tmp_path / "run/history.csv").read_text().splitlines()[0]
    # The stop lets the prescription's beams in, at both distances.
    initial = load_lens(tmp_path / "run/lens/initial.yaml")
    for name in STATES:
        pupils = [
            float(one.in_state(name).first_order().entrance_pupil.diameter.detach())
            for one in (initial, lens)
        ]
        assert pupils[0] == pytest.approx(pupils[1], rel=1e-9)
    assert metrics["efl_mm/far"] == pytest.approx(
        float(lens.in_state("far").first_order(lens.primary_wavelength).efl.detach()), rel=1e-6
    )


def test_a_resumed_search_repeats_an_uninterrupted_one(composed, tmp_path):
    """Operands alone, which need no rays."""

    def search(folder, *more):
        cfg = tiny(composed, *settings, *more, f"folder={folder}")
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
        run(cfg)

    settings = ["module.round_tolerance=0.0", "data.iterations=1", *UNTESTED]
    search("whole", "trainer.max_epochs=2")
    search("first", "trainer.max_epochs=1")
    checkpoint = tmp_path / "first/checkpoints/last.ckpt"
    search("second", "trainer.max_epochs=2", f"ckpt_path={checkpoint}")
    ends = [load_lens(tmp_path / name / "lens/final.yaml") for name in ("whole", "second")]
    others = dict(ends[1].named_parameters())
    for name, value in ends[0].named_parameters():
        assert torch.equal(value, others[name]), name
    moved = float(ends[0].in_state("near").sensor_distance.detach())
    assert moved != STATES["near"]["sensor"]["distance"]


def test_a_run_takes_one_state(composed, tmp_path):
    cfg = tiny(composed, "state=near", "data.iterations=1", "trainer.max_epochs=1", *UNTESTED)
    cfg.variables = {"surfaces.1.curvature": None}
    cfg.merit.operands = []
    run(cfg)
    lens = load_lens(tmp_path / "run/lens/initial.yaml")
    assert (lens.object_distance, float(lens.sensor_distance.detach())) == (2000.0, 26.8)
    assert lens.state_names == ()
    with pytest.raises(InputError, match="no state 'nearer'"):
        run(tiny(composed, "state=nearer", "folder=other"))
