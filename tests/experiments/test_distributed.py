"""Training by several processes, by accumulated batches and in half precision, against one run."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from hydra.utils import instantiate
from lightning.pytorch.strategies import DDPStrategy
from omegaconf import OmegaConf

from dolens.errors import InputError
from dolens.experiments.camera.views.fields import FieldViews
from dolens.experiments.data.crop_loading import ResumableSampler
from dolens.experiments.data.package_photographs import PhotosDataModule
from dolens.experiments.running.configuration import checked
from dolens.experiments.running.run_settings import RunSettings
from dolens.experiments.running.trainer import _Started, made_trainer
from dolens.experiments.running.training import build_lens, run
from dolens.rendering.auto.choice import Choice
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.noise import BatchShare
from dolens.sensor.pixels import Sensor
from dolens.sensor.readout import Readout
from tests.experiments.run_tables import rows_of
from tests.experiments.test_field_views import LINES, WHOLE, doublet
from tests.experiments.tiny_experiment import TINY, TINY_NETWORK

UNTESTED = ["test=false", "objective=train/loss"]
# Plain gradient descent: Adam makes a whole step of a gradient that is all rounding.
DESCENT = ["optimizer.network._target_=torch.optim.SGD", "~optimizer.network.betas"]
CAMERA = [
    "experiment=wavefront_coding",
    *(setting for setting in TINY if "limit" not in setting and "crops_per" not in setting),
    *TINY_NETWORK,
    *DESCENT,
    "learning_rates.network=0.05",
    "trainer.accelerator=cpu",
    "trainer.max_epochs=1",
    "scheduler=null",
    "callbacks.pictures=null",
    "data.batch_size=4",
    "data.evaluation_crops_per_photograph=2",
    "optimizer.lens=dls",
    "optimizer.least_squares.every=2",
]


def weights(folder):
    return torch.load(folder / "checkpoints/last.ckpt", weights_only=True)["state_dict"]


def agree(one, other, tolerance=1e-5):
    """Whether the networks differ by rounding, and the lens's variables too.

    Weights together: a bias that began at zero may be all rounding.
    """
    assert one.keys() == other.keys()
    of_network = [n for n in one if n.startswith("network.") and one[n].is_floating_point()]
    first, second = (
        torch.cat([state[name].double().flatten() for name in of_network]) for state in (one, other)
    )
    scaled = one["variables.scaled"], other["variables.scaled"]
    same_lens = torch.allclose(*scaled, rtol=tolerance, atol=tolerance)
    return same_lens and float((first - second).norm()) < tolerance * float(first.norm())


def metrics_of(folder):
    return json.loads((folder / "metrics.json").read_text())


@pytest.fixture(scope="module")
def two(root, tmp_path_factory) -> Path:
    """The folder of a run by two processes, which start as a user starts them."""
    folder = tmp_path_factory.mktemp("processes") / "two"
    settings = [*CAMERA, "trainer.devices=2", f"hydra.run.dir={folder}"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, str(root / "train.py"), *settings],
        capture_output=True,
        text=True,
        cwd=root,
        timeout=400,
        env={key: value for key, value in environment.items() if "PYTEST" not in key},
    )
    assert done.returncode == 0, done.stderr
    (folder / "terminal.txt").write_text(done.stdout + done.stderr)
    return folder


def test_two_processes_train_and_test_as_one(composed, tmp_path, two):
    run(composed(*CAMERA, folder="one"))
    one = tmp_path / "one"
    # Sums in another order, in single precision.
    assert agree(weights(one), weights(two))
    first, second = metrics_of(one), metrics_of(two)
    assert first.keys() == second.keys()
    for name, value in first.items():
        if name.startswith(("train/", "val/", "test/", "error/", "variables/")):
            # A gain is the difference of two PSNRs of some 20 dB, each known to rel=1e-4.
            absolute = 1e-3 if "/gain_over_" in name else 1e-6
            assert second[name] == pytest.approx(value, rel=1e-4, abs=absolute), name
    # Every photograph once, of batches that the processes took in turns.
    tables = [rows_of(folder / "test_photographs.csv") for folder in (one, two)]
    for row, other in zip(*tables, strict=True):
        assert (row["photograph"], row["view"]) == (other["photograph"], other["view"])
        assert float(other["psnr_db"]) == pytest.approx(float(row["psnr_db"]), abs=1e-3)
    # One process goes on with what two have begun.
    more = [*CAMERA, *UNTESTED, "trainer.max_epochs=2", "callbacks.validation_pictures=null"]
    for name, folder in {"resumed": two, "whole": one}.items():
        last = folder / "checkpoints/last.ckpt"
        run(composed(*more, f"ckpt_path={last}", folder=name))
    assert agree(weights(tmp_path / "whole"), weights(tmp_path / "resumed"))


def test_the_first_process_alone_writes(two):
    log = (two / "log.txt").read_text()
    assert log.count("Run folder:") == 1
    terminal = (two / "terminal.txt").read_text()
    assert terminal.count("Run folder:") == 1
    assert "sync_dist" not in terminal
    rows = rows_of(two / "metrics.csv")
    assert [row["step"] for row in rows] == sorted({row["step"] for row in rows}, key=int)
    assert {path.name for path in (two / "checkpoints").iterdir()} == {"best.ckpt", "last.ckpt"}
    assert json.loads((two / "run.json").read_text())["status"] == "finished"


def of_views(root, renderer):
    views = FieldViews(PlanarScene((1e5,), LINES), WHOLE, renderer, Readout(read_noise=0.01))
    return doublet(root), views, torch.rand(4, 3, 72, 80)


@pytest.mark.parametrize("kind", ["rays", "functions"])
def test_parts_of_a_batch_are_imaged_as_in_the_whole(root, kind):
    sensor = Sensor(24, 32, 0.08)
    renderer = RayRenderer(sensor, 2) if kind == "rays" else PsfRenderer(sensor, (2, 2), 6, 11)
    lens, views, textures = of_views(root, renderer)
    whole = views.take(lens, textures, "train", 3)
    for first in (0, 2):
        own = slice(first, first + 2)
        share = BatchShare(first, 4)
        part = views.take(lens, textures[own], "train", 3, None, share)
        # One readout: nothing beside these.
        assert part[3:] == whole[3:] == (None, None)
        for mine, all_of_it in zip(part[:3], whole[:3], strict=True):
            torch.testing.assert_close(mine, all_of_it[own], rtol=1e-4, atol=1e-5)


def test_accumulated_batches_are_one_larger_batch(composed, tmp_path):
    """Where nothing is taken over a batch: no batch normalisation, and the mean over views."""
    common = [*CAMERA, *UNTESTED, "view_norm=1", "callbacks.validation_pictures=null"]
    large = ["data.batch_size=4", "data.steps_per_epoch=2"]
    small = ["data.batch_size=2", "data.steps_per_epoch=4", "trainer.accumulate_grad_batches=2"]
    for name, settings in {"large": large, "small": small}.items():
        cfg = composed(*common, *settings, "+trainer.limit_val_batches=1", folder=name)
        cfg.network = {
            "_target_": "torch.nn.Conv2d",
            "in_channels": 3,
            "out_channels": 3,
            "kernel_size": 3,
            "padding": 1,
        }
        run(cfg)
    files = (tmp_path / name / "checkpoints/last.ckpt" for name in ("large", "small"))
    found = [torch.load(file, weights_only=True) for file in files]
    assert [checkpoint["global_step"] for checkpoint in found] == [2, 2]
    assert agree(*(checkpoint["state_dict"] for checkpoint in found))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_optics_know_nothing_of_half_precision(composed, dtype):
    cfg = composed(*CAMERA, f"lens_dtype={str(dtype).partition('.')[2]}", "readout=gaussian")
    settings = RunSettings.of(checked(cfg))
    module = instantiate(settings.module)(lens=build_lens(settings))
    textures = torch.rand(2, 3, 56, 56)

    def images_and_slope():
        values = module.variables()
        taken, functions = module.take(values, textures, "train", 0)
        slope = torch.autograd.grad(
            taken.raw.sum() + functions.square().sum(), values["sensor_distance"]
        )
        return taken.raw, functions, *slope

    alone = images_and_slope()
    with torch.autocast("cpu", torch.bfloat16):
        mixed = images_and_slope()
        taken, functions = module.take(module.variables(), textures, "train", 0)
        rows = []
        module.network.network.output.register_forward_hook(lambda *seen: rows.append(seen[2]))
        restored = module.restore(taken, functions)
    for one, other in zip(alone, mixed, strict=True):
        assert one.dtype == dtype and torch.equal(one, other)
    assert rows[0].dtype == torch.bfloat16 and restored.dtype == torch.float32


class _Second:
    """What a module of the second process sees of its trainer."""

    is_global_zero, current_epoch = False, 0

    def __init__(self, plan):
        self.strategy = SimpleNamespace(broadcast=lambda own: plan)


def test_processes_render_by_the_plan_of_the_first(composed, monkeypatch):
    """What each found by itself might differ: a plan is a choice between models."""
    rays = "renderer=rays", "renderer.pupil_samples=2"
    settings = [entry for entry in CAMERA if entry not in rays]
    settings = RunSettings.of(checked(composed(*settings, "renderer=auto")))
    module = instantiate(settings.module)(lens=build_lens(settings))
    chosen = PsfRenderer(module.views.sensor, (1, 1), 6, 33)
    plan = Choice(chosen, torch.float64, (), {"": 0.5}, 0.1, 1.0).state()
    monkeypatch.setattr("dolens.experiments.camera.camera.processes", lambda: 2)
    module.trainer = second = _Second(plan)  # of which a module has a weak reference
    module.on_train_epoch_start()
    assert module.views.state() == plan and not second.is_global_zero


REFUSED = {
    "half-precision weights": ({"precision": "bf16-true"}, "allowed: 32-true, or bf16-mixed"),
    "half precision of the CPU": ({"precision": "16-mixed"}, "optics are computed in lens_dtype"),
    "double precision": ({"precision": "64-true"}, "trainer.precision: 64-true; allowed"),
    "an unknown strategy": ({"strategy": "dpp"}, "trainer.strategy"),
    "a strategy of forks": ({"strategy": "ddp_fork"}, "trainer.strategy"),
    "no devices": ({"devices": 0}, "trainer: "),
    "devices by a word": ({"devices": "many"}, "trainer: "),
    "no batches": ({"accumulate_grad_batches": 0}, "accumulate_grad_batches: 0; allowed: 1"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_trainer_that_cannot_be_is_one_clear_line(case):
    settings, expected = REFUSED[case]
    settings = {"_target_": "lightning.Trainer", "accelerator": "cpu", "devices": 1} | settings
    with pytest.raises(InputError) as caught:
        made_trainer(OmegaConf.create(settings), [], [])
    assert expected in str(caught.value) and "\n" not in str(caught.value)


def test_several_processes_are_chosen_as_lightning_does():
    settings = {"_target_": "lightning.Trainer", "accelerator": "cpu", "devices": 2}
    trainer = made_trainer(OmegaConf.create(settings), [], [])
    assert isinstance(trainer.strategy, DDPStrategy) and trainer.world_size == 2


def test_batches_that_cannot_be_accumulated_are_one_clear_line(refused):
    expected = "accumulate_grad_batches: 3 does not divide the batches of an epoch, 2"
    refused(expected, *CAMERA, "trainer.accumulate_grad_batches=3")
    twice = ["trainer.accumulate_grad_batches=2", "discriminator=double_scale"]
    refused("allowed with a discriminator: 1", *CAMERA, *twice)


def test_a_batch_that_cannot_be_shared_is_one_clear_line():
    data = PhotosDataModule(crop_size=8, batch_size=3, steps_per_epoch=1)
    data.trainer = SimpleNamespace(
        global_rank=0, world_size=2, accumulate_grad_batches=1, overfit_batches=0
    )
    with pytest.raises(InputError, match="3 cannot be shared equally by 2 processes"):
        data.train_dataloader()


@pytest.mark.parametrize("processes", [1, 2, 4])
def test_processes_see_the_samples_of_one_in_its_order(processes):
    parts = [
        list(ResumableSampler(8, lambda: (20, 8), 4, rank, processes)) for rank in range(processes)
    ]
    size = 4 // processes
    batches = [[part[b : b + size] for part in parts] for b in range(0, 2 * size, size)]
    assert [n for batch in batches for part in batch for n in part] == list(range(20, 28))


def test_a_design_is_the_work_of_one_process(refused):
    refused("allowed for DesignModule: 1", "experiment=asphere", "trainer.devices=2")
    refused("allowed for DesignModule", "experiment=asphere", "+trainer.precision=bf16-mixed")


def test_a_process_that_fails_is_named(tmp_path):
    """What it has said of itself; else how it ended."""
    ends = "import sys; sys.exit(3)", "import os; os.kill(os.getpid(), 9)"
    processes = [subprocess.Popen([sys.executable, "-c", code]) for code in ends]
    for process in processes:
        process.wait()
    lost = {"line": "RuntimeError: gloo", "lost": True, "trace": ""}
    fault = {"line": "a bad number", "lost": False, "trace": ""}
    assert (
        _Started(processes[:1], tmp_path).reason()
        == "process 1 of 2 (from 0) was ended with code 3"
    )
    (tmp_path / "1.json").write_text(json.dumps(lost))
    assert _Started(processes, tmp_path).reason() == "process 2 of 3 (from 0) was ended by SIGKILL"
    (tmp_path / "2.json").write_text(json.dumps(fault))
    assert _Started(processes, tmp_path).reason() == "process 2 of 3 (from 0) failed: a bad number"
