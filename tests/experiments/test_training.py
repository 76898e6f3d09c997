"""A run from configuration to run folder, resumed, swept, interrupted, and fed bad input."""

import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from PIL import Image
from tiny_experiment import FIXED_WINDOWS, TINY, TINY_DOUBLET, TINY_NETWORK, figure_names
from typer.testing import CliRunner

from dolens import load_lens
from dolens.cli.app import app
from dolens.errors import InputError
from dolens.experiments.running.configuration import checked
from dolens.experiments.running.training import run
from dolens.sensor.readout import Readout

EXPERIMENTS = sorted(p.stem for p in (Path(__file__).parents[2] / "conf/experiment").glob("*.yaml"))
UNTESTED = ["test=false", "objective=train/loss"]
UNPICTURED = ["callbacks.pictures=null"]
WAVEFRONT_CODING = ["experiment=wavefront_coding", *TINY, *TINY_NETWORK]
# The same with the renderer that chooses.
BY_PLAN = [
    *(e for e in WAVEFRONT_CODING if e not in ("renderer=rays", "renderer.pupil_samples=2")),
    "renderer.tolerance=4.0",
]
BY_LEAST_SQUARES = [
    *WAVEFRONT_CODING,
    "optimizer.lens=dls",
    "optimizer.least_squares.every=2",
]


def last_state(folder: Path) -> dict:
    return torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


def train_py(root: Path, *arguments: str, **options) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, str(root / "train.py"), *arguments],
        **{"capture_output": True, "text": True, "cwd": root, "timeout": 500, **options},
    )


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_composes_and_resolves(composed, name, tmp_path):
    overrides = [f"data.root={tmp_path}"] if name.endswith("paper") else []
    cfg = composed(f"experiment={name}", *overrides)
    assert cfg.module.experiment == name
    if name.startswith("wavefront_coding"):
        assert cfg.lens.surfaces["5"].type == "xy_polynomial"
    checked(cfg)  # no experiment sets what nothing reads, or what no class takes


def test_a_run_leaves_the_whole_run_folder(composed, tmp_path):
    objective = run(composed(*WAVEFRONT_CODING))
    folder = tmp_path / "run"
    for name in (
        "run.json",
        "metrics.json",
        "test_photographs.csv",
        "checkpoints/last.ckpt",
        "checkpoints/best.ckpt",
        "lens/initial.yaml",
        "lens/final.yaml",
    ):
        assert (folder / name).stat().st_size > 0, name
    assert figure_names(folder) == {"images", "layout", "point_spread_functions"}
    assert list((folder / "tensorboard").glob("events.out.tfevents.*"))
    info = json.loads((folder / "run.json").read_text())
    assert info["status"] == "finished" and info["seed"] == 0
    assert {"commit", "dirty"} <= set(info["git"])
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["test/psnr_db/worst"] == objective
    depths = ["8m", "6m", "4.5m"]
    for name in ("psnr_db", "raw_psnr_db", "ssim", "raw_ssim"):
        values = [metrics[f"test/{name}/{depth}"] for depth in depths]
        assert metrics[f"test/{name}"] == pytest.approx(sum(values) / 3, rel=1e-5)
        assert metrics[f"test/{name}/worst"] == min(values)
    for name in ("wall_s", "step_s", "optics_s", "network_s", "data_s", "rays", "peak_memory_mb"):
        assert metrics[f"cost/{name}"] > 0
    assert metrics["cost/rays"] == 24 * 24 * 4 * 3
    assert metrics["loss/perceptual_available"] == 0
    assert all(math.isfinite(value) for value in metrics.values())


def test_the_last_checkpoint_is_the_end_of_the_run_whichever_was_best(composed, tmp_path):
    run(composed(*WAVEFRONT_CODING, "callbacks.best.mode=min", *UNTESTED, *UNPICTURED))
    run(composed(*WAVEFRONT_CODING, *UNTESTED, *UNPICTURED, folder="other"))
    for folder in ("run", "other"):
        last = torch.load(tmp_path / folder / "checkpoints" / "last.ckpt", weights_only=True)
        assert last["global_step"] == 4
    best = [
        torch.load(tmp_path / folder / "checkpoints" / "best.ckpt", weights_only=True)
        for folder in ("run", "other")
    ]
    # Of the two opposite criteria, one at least has its best before the end.
    assert min(b["global_step"] for b in best) == 2


def test_training_moves_the_plate_and_the_final_prescription_holds_it(composed, tmp_path):
    run(composed(*WAVEFRONT_CODING, *UNTESTED, *UNPICTURED))
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    initial = load_lens(tmp_path / "run" / "lens" / "initial.yaml", dtype=torch.float32)
    final = load_lens(tmp_path / "run" / "lens" / "final.yaml", dtype=torch.float32)
    for name in ("x3", "x2y", "xy2", "y3"):
        start, end = (float(getattr(lens.surfaces["5"], name)) for lens in (initial, final))
        assert end == pytest.approx(metrics[f"variables/surfaces.5.{name}"], abs=1e-12)
        assert end != start
    assert float(final.surfaces["1"].curvature) == float(initial.surfaces["1"].curvature)


def test_the_baseline_keeps_its_plate_flat(composed, tmp_path):
    run(
        composed(
            "experiment=wavefront_coding_baseline", *TINY, *TINY_NETWORK, *UNTESTED, *UNPICTURED
        )
    )
    lens = load_lens(tmp_path / "run" / "lens" / "final.yaml")
    assert all(float(p) == 0.0 for p in lens.surfaces["5"].parameters())


def test_bounds_hold_by_projection(composed, tmp_path):
    run(composed(*WAVEFRONT_CODING, *UNTESTED, *UNPICTURED, "learning_rates.optics=100.0"))
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    plate = [v for name, v in metrics.items() if name.startswith("variables/surfaces.5")]
    assert max(abs(v) for v in plate) == pytest.approx(4e-5, rel=1e-6)


@pytest.mark.parametrize(
    ("stops", "settings"),
    [
        ((1, 2, 3), WAVEFRONT_CODING),
        ((1, 2, 3), [*BY_PLAN, *UNPICTURED]),
        ((3,), [*BY_LEAST_SQUARES, *UNPICTURED]),
    ],
    ids=["rays", "plan", "least_squares"],
)
def test_a_resumed_run_ends_with_the_same_weights_to_the_bit(composed, tmp_path, stops, settings):
    # Stops 1 and 3 are in the middle of an epoch of two steps, 2 is the end of the first; a plan is
    # made at an epoch's start.
    # Least squares, every two steps, has gathered the gradient of one.
    # The whole run makes figures, the resumed ones none: that too must change nothing.
    each = ["+callbacks.last.every_n_train_steps=1", "+callbacks.last.save_top_k=-1"]
    run(composed(*settings, *UNTESTED, *each, "callbacks.last.filename='{step}'", folder="whole"))
    checkpoints = tmp_path / "whole" / "checkpoints"
    whole = torch.load(checkpoints / "step=4.ckpt", weights_only=True)["state_dict"]
    for stop in stops:
        last = f"ckpt_path='{checkpoints / f'step={stop}.ckpt'}'"
        run(composed(*settings, *UNTESTED, *UNPICTURED, last, folder=f"resumed_{stop}"))
        again = last_state(tmp_path / f"resumed_{stop}")
        assert whole.keys() == again.keys()
        for name, value in whole.items():
            assert torch.equal(value, again[name]), (stop, name)


def test_a_run_that_was_stopped_after_some_steps_goes_on_to_the_same_weights(composed, tmp_path):
    """At the end of the first epoch of two steps, and in the middle of the second."""
    settings = [*TINY_DOUBLET, *FIXED_WINDOWS, *UNTESTED, *UNPICTURED]
    run(composed(*settings, folder="whole"))
    whole = last_state(tmp_path / "whole")
    for stop in (2, 3):
        # Stopped by hand after some steps: the schedule is the whole run's.
        steps = [f"+callbacks.last.every_n_train_steps={stop}", f"+trainer.max_steps={stop}"]
        run(composed(*settings, *steps, folder=f"part_{stop}"))
        last = f"ckpt_path={tmp_path / f'part_{stop}' / 'checkpoints' / 'last.ckpt'}"
        run(composed(*settings, last, folder=f"resumed_{stop}"))
        again = last_state(tmp_path / f"resumed_{stop}")
        assert whole.keys() == again.keys()
        for name, value in whole.items():
            assert torch.equal(value, again[name]), (stop, name)


def test_the_plan_of_the_renderer_is_among_the_metrics(composed, tmp_path):
    run(composed(*BY_PLAN, *UNPICTURED, "trainer.max_epochs=1"))
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["auto/error_grey_levels"] <= metrics["auto/tolerance_grey_levels"] == 4.0
    assert metrics["auto/plans"] == 1


def test_a_camera_of_a_wide_field_trains_by_a_plan(composed, tmp_path):
    short = [
        "renderer=auto",
        "trainer.max_epochs=1",
        "data.steps_per_epoch=1",
        "renderer.tolerance=8.0",
    ]
    settings = (o for o in TINY_DOUBLET if not o.startswith(("psf_size", "data.margin")))
    run(composed(*settings, *short, *UNTESTED, *UNPICTURED))
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["auto/plans"] == 1
    assert metrics["auto/error_grey_levels"] <= metrics["auto/tolerance_grey_levels"] == 8.0


def test_every_epoch_looks_at_the_lens_anew(composed, tmp_path, caplog):
    """A plan for the lens that training began with would err unnoticed."""
    with caplog.at_level("INFO", "dolens.rendering.auto"):
        run(composed(*BY_PLAN, *UNPICTURED, *UNTESTED, "trainer.max_epochs=3"))
    looked = [r for r in caplog.messages if "still serves" in r or "the lens has changed" in r]
    assert len(looked) == 2


def test_a_float64_lens_works_beside_a_float32_network(composed, tmp_path):
    run(composed(*WAVEFRONT_CODING, "lens_dtype=float64", "trainer.max_epochs=1"))
    state = last_state(tmp_path / "run")
    assert state["variables.scaled"].dtype == torch.float64
    assert {v.dtype for k, v in state.items() if k.startswith("network.")} <= {
        torch.float32,
        torch.int64,
    }


def test_the_plain_unet_trains_too(composed, tmp_path):
    run(composed(*WAVEFRONT_CODING, "network=unet", "trainer.max_epochs=1"))
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["variables/surfaces.5.x3"] != 1e-5


READOUTS = sorted(p.stem for p in (Path(__file__).parents[2] / "conf/readout").glob("*.yaml"))


@pytest.mark.parametrize("name", READOUTS)
def test_read_noise_is_one_key_for_every_readout(composed, name):
    cfg = composed("experiment=wavefront_coding", f"readout={name}", "read_noise=0.005")
    assert instantiate(cfg.views).readout.read_noise == 0.005


def test_the_gaussian_readout_is_its_read_noise_alone(composed):
    overrides = ["readout=gaussian", "readout.reference_f_number=null"]
    cfg = composed("experiment=wavefront_coding", *overrides)
    assert instantiate(cfg.views).readout == Readout(read_noise=0.003)


def test_the_default_readout_counts_the_electrons_of_its_light(composed):
    cfg = composed("experiment=wavefront_coding", "light=250.0")
    readout = instantiate(cfg.views).readout
    assert readout.exposure * readout.full_well == pytest.approx(250.0, rel=1e-12)
    assert readout.read_noise * readout.full_well == pytest.approx(3.0, rel=0.02)


def test_a_camera_behind_colour_filters_trains_too(composed, tmp_path):
    run(composed(*WAVEFRONT_CODING, "readout=bayer_12bit", "trainer.max_epochs=1"))
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert all(math.isfinite(value) for value in metrics.values())
    initial = load_lens(tmp_path / "run" / "lens" / "initial.yaml", dtype=torch.float32)
    for name in ("x3", "x2y", "xy2", "y3"):
        start = float(getattr(initial.surfaces["5"], name).detach())
        assert metrics[f"variables/surfaces.5.{name}"] != start


def test_the_paper_scale_composes_and_runs_two_steps(composed, tmp_path):
    images, generator = tmp_path / "images", np.random.default_rng(0)
    images.mkdir()
    for i in range(6):
        pixels = generator.integers(0, 256, (340, 360, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(images / f"{i}.png")
    # The perceptual term is required; random features stand in for the 500 MB of real ones.
    from torchvision.models.vgg import cfgs, make_layers

    with torch.random.fork_rng():
        features = make_layers(cfgs["D"])[:15].state_dict()
    weights = {f"features.{name}": value for name, value in features.items()}
    torch.save(weights, tmp_path / "vgg16.pth")
    run(
        composed(
            "experiment=wavefront_coding_paper",
            f"data.root={images}",
            f"loss.vgg16_weights={tmp_path / 'vgg16.pth'}",
            # 256×256 pixels and the whole path; fewer rays and channels, to take seconds.
            "renderer.pupil_samples=2",
            "evaluation_renderer.pupil_samples=2",
            "network.width=4",
            "+trainer.max_steps=2",
            "+trainer.limit_val_batches=1",
            "+trainer.limit_test_batches=1",
            "+trainer.enable_progress_bar=false",
            "callbacks.pictures=null",
            # Checkpoints go by the clock, for machines where an epoch takes hours.
            "callbacks.last.train_time_interval.minutes=0",
        )
    )
    checkpoint = tmp_path / "run" / "checkpoints" / "last.ckpt"
    assert torch.load(checkpoint, weights_only=True)["global_step"] == 2
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["loss/perceptual_available"] == 1
    assert metrics["train/perceptual"] > 0


def test_a_sweep_leaves_a_folder_for_each_job(dolens_train, tmp_path):
    """Each under its own experiment's name, as the README's sweep over two of them."""
    dolens_train(
        tmp_path,
        "-m",
        "experiment=wavefront_coding,wavefront_coding_baseline",
        # Keys of an experiment's own are unknown to Hydra before it has chosen one.
        *("++" + entry if entry.startswith("module.") else entry for entry in WAVEFRONT_CODING[1:]),
        "trainer.max_epochs=1",
        "data.steps_per_epoch=1",
        "test=false",
        "objective=train/loss",
        "callbacks.pictures=null",
        "loss.tv_weight=0,1e-4",
    )
    (several,) = (tmp_path / "outputs" / "several" / "sweeps").iterdir()
    assert (several / "multirun.yaml").exists()
    for name, jobs in (("wavefront_coding", "01"), ("wavefront_coding_baseline", "23")):
        sweep = tmp_path / "outputs" / name / "sweeps" / several.name
        assert sorted(path.name for path in sweep.iterdir()) == list(jobs)
        losses = []
        for job, weight in zip(jobs, ("0", "0.0001"), strict=True):
            assert json.loads((sweep / job / "run.json").read_text())["status"] == "finished"
            overrides = (sweep / job / ".hydra/overrides.yaml").read_text()
            assert f"loss.tv_weight={weight}" in overrides
            assert (sweep / job / "log.txt").exists()
            losses.append(json.loads((sweep / job / "metrics.json").read_text())["train/loss"])
        assert losses[0] < losses[1]


def test_ctrl_c_keeps_the_last_checkpoint_and_says_how_to_resume(root, tmp_path):
    process = subprocess.Popen(
        [
            sys.executable,
            str(root / "train.py"),
            *WAVEFRONT_CODING,
            "trainer.max_epochs=1000",
            "callbacks.pictures=null",
            f"hydra.run.dir={tmp_path}",
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=root,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
        # A test run in the background of a shell ignores Ctrl-C, and its children would too.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    last = tmp_path / "checkpoints" / "last.ckpt"
    deadline = time.monotonic() + 200
    try:
        while not last.exists() and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode != 0
    assert re.search(r"Resume with: python .*train\.py .*ckpt_path=.*last\.ckpt", output), output
    assert json.loads((tmp_path / "run.json").read_text())["status"] == "interrupted"
    torch.load(last, weights_only=True)


BAD_INPUT = {
    "misspelt key": (["lens.surfaces.1.radus=3"], "radus"),
    "unknown material": (["lens.surfaces.1.material=ari"], "surface 1: unknown material 'ari'"),
    "missing thickness": (["~lens.surfaces.2.thickness"], "surface 2: 'thickness' is missing"),
    "aperture beyond its sphere": (
        ["lens.surfaces.1.radius=5"],
        "surface 1: semi_diameter 6.35 mm exceeds the surface",
    ),
    "depth inside the lens": (["scene.depths=[8000,-1]"], "depth -1 mm lies inside the lens"),
    "code in a prescription": (["+lens.surfaces.1._target_=os.system"], "unknown key '_target_'"),
    "objective without its test": (["test=false"], "needs test=true"),
    "unknown precision": (["lens_dtype=float16"], "allowed: float32, float64"),
    "missing checkpoint": (["ckpt_path=nowhere.ckpt"], "nowhere.ckpt does not exist"),
    "unknown perceptual loss": (
        ["loss.perceptual=vgg"],
        "auto, vgg16, download, vgg16_edges, none",
    ),
    "missing weights": (
        ["loss.perceptual=vgg16", "loss.vgg16_weights=nowhere.pth"],
        "nowhere.pth",
    ),
    "unknown colour filters": (["readout.pattern=RGBG"], "'RGBG' is unknown; allowed: RGGB"),
    "a converter of no bits": (["readout.bits=0"], "bits is 0; allowed: null, or a whole number"),
    "unknown variable": (
        ["+variables={surfaces.5.x4: {scale: 1.0}}"],
        "has no parameter 'surfaces.5.x4'",
    ),
}


@pytest.mark.parametrize("case", BAD_INPUT)
def test_bad_input_gives_one_clear_line(composed, case):
    overrides, expected = BAD_INPUT[case]
    with pytest.raises(Exception) as caught:
        run(composed(*WAVEFRONT_CODING, *overrides))
    error = caught.value.__cause__ if caught.value.__cause__ else caught.value
    if case != "misspelt key":  # Hydra's own error, which train.py joins to one line
        assert isinstance(error, InputError)
        assert "\n" not in str(error)
    assert expected in str(caught.value)


def test_an_empty_image_folder_is_named(composed, tmp_path):
    (tmp_path / "empty").mkdir()
    overrides = [o for o in WAVEFRONT_CODING if not o.startswith("data.")]
    with pytest.raises(Exception, match="empty") as caught:
        run(composed(*overrides, "data=image_folder", f"data.root={tmp_path / 'empty'}"))
    assert isinstance(caught.value.__cause__ or caught.value, InputError)


def test_a_checkpoint_of_another_experiment_is_refused(composed, tmp_path):
    asked = [*WAVEFRONT_CODING, *UNTESTED, *UNPICTURED, "trainer.max_epochs=1"]
    run(composed(*asked, folder="first"))
    checkpoint = tmp_path / "first" / "checkpoints" / "last.ckpt"
    with pytest.raises(InputError, match="experiment is 'wavefront_coding'"):
        run(
            composed(
                "experiment=wavefront_coding_baseline",
                *TINY,
                *TINY_NETWORK,
                f"ckpt_path={checkpoint}",
                folder="second",
            )
        )


def test_a_pickled_object_is_no_checkpoint(composed, tmp_path):
    torch.save({"state_dict": Path("x")}, tmp_path / "bad.ckpt")
    with pytest.raises(InputError, match="not a safe checkpoint"):
        run(composed(*WAVEFRONT_CODING, f"ckpt_path={tmp_path / 'bad.ckpt'}"))


def test_the_command_line_prints_one_line_and_fails(root, tmp_path, monkeypatch):
    """Hydra refuses the one before a run begins, and the lens the other in a run of its own."""
    asked = [*WAVEFRONT_CODING, f"hydra.run.dir={tmp_path}"]
    monkeypatch.setattr(sys, "argv", [])
    monkeypatch.setattr(sys, "path", [*sys.path])
    misspelt = CliRunner().invoke(app, ["train", *asked, "loss.tv_wieght=1"])
    unknown = train_py(root, *asked, "lens.surfaces.1.material=ari")
    assert (misspelt.exit_code, unknown.returncode) == (1, 1)
    for said, named in ((misspelt.output, "tv_wieght"), (unknown.stderr, "'ari'")):
        errors = [line for line in said.splitlines() if line.strip()]
        assert len(errors) == 1, said
        assert named in errors[0]
