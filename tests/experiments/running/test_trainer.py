"""Training by several processes, by accumulated batches and in half precision, against one run."""

import json
import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
import torch
from lightning.pytorch.strategies import DDPStrategy
from omegaconf import OmegaConf

from dolens.errors import InputError
from dolens.experiments.camera.views.base import Shot
from dolens.experiments.camera.views.fields import FieldViews
from dolens.experiments.data.crop_loading import ResumableSampler
from dolens.experiments.data.package_photographs import PhotosDataModule
from dolens.experiments.running.trainer import _Started, made_trainer
from dolens.rendering.auto.choice import Choice
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.noise import BatchShare
from dolens.sensor.pixels import Sensor
from dolens.sensor.readout import Readout
from tests.experiments.camera.test_field_views import LINES, WHOLE, doublet
from tests.experiments.camera.test_own_reconstruction import CONVOLUTION
from tests.experiments.conftest import finished_run
from tests.experiments.runs import Finished
from tests.experiments.tiny_experiment import (
    CAMERA,
    ONE_EPOCH,
    UNPICTURED,
    UNTESTED,
)

UNSEEN = "callbacks.validation_pictures=null"
# Plain gradient descent: Adam makes a whole step of a gradient that is all rounding.
DESCENT = ["optimizer.network._target_=torch.optim.SGD", "~optimizer.network.betas"]
SHARED = [
    *(setting for setting in CAMERA if "limit" not in setting and "crops_per" not in setting),
    *DESCENT,
    "learning_rates.network=0.05",
    "trainer.accelerator=cpu",
    ONE_EPOCH,
    "scheduler=null",
    UNPICTURED,
    "data.batch_size=4",
    "data.evaluation_crops_per_photograph=2",
    "optimizer.lens=dls",
    "optimizer.least_squares.every=2",
]


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


@pytest.fixture(scope="module")
def one(root, tmp_path_factory) -> Finished:
    """The folder of a run by this process."""
    return Finished(finished_run(root, tmp_path_factory.mktemp("process"), *SHARED, name="one"))


@pytest.fixture(scope="module")
def two(root, tmp_path_factory, one) -> Finished:
    """The folder of a run by two processes, which start as a user starts them.

    Behind that of one, whose kernels both read from disk: each would compile them all.
    """
    folder = tmp_path_factory.mktemp("processes") / "two"
    settings = [*SHARED, "trainer.devices=2", f"hydra.run.dir={folder}"]
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
    return Finished(folder)


def test_two_processes_train_and_test_as_one(trained, one, two):
    # Sums in another order, in single precision.
    assert agree(one.state, two.state)
    assert one.metrics.keys() == two.metrics.keys()
    for name, value in one.metrics.items():
        if name.startswith(("train/", "val/", "test/", "error/", "variables/")):
            # A gain is the difference of two PSNRs of some 20 dB, each known to rel=1e-4.
            absolute = 1e-3 if "/gain_over_" in name else 1e-6
            assert two.metrics[name] == pytest.approx(value, rel=1e-4, abs=absolute), name
    # Every photograph once, of batches that the processes took in turns.
    for row, other in zip(*(run.table("test_photographs") for run in (one, two)), strict=True):
        assert (row["photograph"], row["view"]) == (other["photograph"], other["view"])
        assert float(other["psnr_db"]) == pytest.approx(float(row["psnr_db"]), abs=1e-3)
    # One process goes on with what two have begun.
    more = [*SHARED, *UNTESTED, "trainer.max_epochs=2", UNSEEN]
    whole, resumed = (
        trained(*more, f"ckpt_path={run.last}", folder=f"more_{run.folder.name}")
        for run in (one, two)
    )
    assert agree(whole.state, resumed.state)


def test_the_first_process_alone_writes(two):
    assert (two.folder / "log.txt").read_text().count("Run folder:") == 1
    terminal = (two.folder / "terminal.txt").read_text()
    assert terminal.count("Run folder:") == 1
    assert "sync_dist" not in terminal
    rows = two.table("metrics")
    assert [row["step"] for row in rows] == sorted({row["step"] for row in rows}, key=int)
    assert {path.name for path in two.last.parent.iterdir()} == {"best.ckpt", "last.ckpt"}
    assert two.info["status"] == "finished"


def of_views(root, renderer):
    views = FieldViews(PlanarScene((1e5,), LINES), WHOLE, renderer, Readout(read_noise=0.01))
    return doublet(root), views, torch.rand(4, 3, 72, 80)


@pytest.mark.parametrize("kind", ["rays", "functions"])
def test_parts_of_a_batch_are_imaged_as_in_the_whole(root, kind):
    sensor = Sensor(24, 32, 0.08)
    renderer = RayRenderer(sensor, 2) if kind == "rays" else PsfRenderer(sensor, (2, 2), 6, 11)
    lens, views, textures = of_views(root, renderer)
    whole = views.take(lens, Shot(textures, "train", 3))
    for first in (0, 2):
        own = slice(first, first + 2)
        share = BatchShare(first, 4)
        part = views.take(lens, Shot(textures[own], "train", 3, None, share))
        # One readout: nothing beside these.
        assert part[3:] == whole[3:] == (None, None)
        for mine, all_of_it in zip(part[:3], whole[:3], strict=True):
            torch.testing.assert_close(mine, all_of_it[own], rtol=1e-4, atol=1e-5)


def test_accumulated_batches_are_one_larger_batch(trained):
    """Where nothing is taken over a batch: no batch normalisation, and the mean over views."""
    common = [*SHARED, *UNTESTED, "view_norm=1", UNSEEN, "+trainer.limit_val_batches=1"]
    common += ["optimizer.least_squares.first_iterations=0"]
    large = ["data.batch_size=4", "data.steps_per_epoch=2"]
    small = ["data.batch_size=2", "data.steps_per_epoch=4", "trainer.accumulate_grad_batches=2"]
    found = [
        trained(*common, *settings, network=CONVOLUTION, folder=name).checkpoint()
        for name, settings in {"large": large, "small": small}.items()
    ]
    assert [checkpoint["global_step"] for checkpoint in found] == [2, 2]
    assert agree(*(checkpoint["state_dict"] for checkpoint in found))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_optics_know_nothing_of_half_precision(made, dtype):
    module = made(*SHARED, f"lens_dtype={str(dtype).partition('.')[2]}", "readout=gaussian")
    textures = torch.rand(2, 3, 56, 56)

    def images_and_slope():
        values = module.variables()
        taken, functions = module.take(values, Shot(textures, "train", 0))
        slope = torch.autograd.grad(
            taken.raw.sum() + functions.square().sum(), values["sensor_distance"]
        )
        return taken.raw, functions, *slope

    alone = images_and_slope()
    with torch.autocast("cpu", torch.bfloat16):
        mixed = images_and_slope()
        taken, functions = module.take(module.variables(), Shot(textures, "train", 0))
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


def test_processes_render_by_the_plan_of_the_first(made, monkeypatch):
    """What each found by itself might differ: a plan is a choice between models."""
    rays = "renderer=rays", "renderer.pupil_samples=2"
    module = made(*(entry for entry in SHARED if entry not in rays), "renderer=auto")
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
    refused(expected, *SHARED, "trainer.accumulate_grad_batches=3")
    twice = ["trainer.accumulate_grad_batches=2", "discriminator=double_scale"]
    refused("allowed with a discriminator: 1", *SHARED, *twice)


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
