"""The camera of a run is tested again, without training: on other photographs, depths, noise."""

import logging
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import lightning
from hydra.core.override_parser.overrides_parser import OverridesParser
from lightning.pytorch.callbacks import ModelCheckpoint, ProgressBar
from omegaconf import OmegaConf

from dolens.errors import InputError
from dolens.experiments.data.camera_data import CropDataModule
from dolens.experiments.running.command_line import read_override
from dolens.experiments.running.configuration import changed_places, with_overrides
from dolens.experiments.running.finished_run import FinishedRun, load_recorded
from dolens.experiments.running.process_settings import set_matmul_precision, set_threads
from dolens.experiments.running.recorded_run import RecordedRun, read_record
from dolens.experiments.running.run_files import (
    INFO,
    METRICS,
    OVERRIDES,
    RESOLVED,
    metrics_of,
    write_json,
)
from dolens.experiments.running.run_folder import describe_run, peak_memory_mb, plain_metrics
from dolens.experiments.running.trainer import quiet_lightning
from dolens.experiments.running.training import summary_of
from dolens.experiments.running.trust import own_folder
from dolens.files import resolved_path
from dolens.prescriptions import save_lens

logger = logging.getLogger(__name__)

_FORMAT = "[%(asctime)s] %(levelname)s %(name)s: %(message)s"


@dataclass(frozen=True)
class Evaluated:
    """An evaluation that is done.

    Attributes:
        folder: what it has written.
        metrics: those of its metrics.json.
        objective: the name of the metric that counts.
        run: what was evaluated.
    """

    folder: Path
    metrics: Mapping[str, float]
    objective: str
    run: FinishedRun


def evaluate(
    folder: str | Path,
    overrides: Sequence[str] = (),
    checkpoint: str | Path = "last",
    name: str | None = None,
    perturb_lens: bool = False,
    command: Sequence[str] = (),
    trust: bool = False,
) -> Evaluated:
    """Test a run's module again, with the weights of a checkpoint.

    Without overrides the numbers are those of the run's own test.  Overrides say what is different,
    as `data=package_photographs`, `scene.depths=[5000]`, `light=50` or `evaluation_renderer=wave`.
    A network that deconvolves is given the point spread functions of the lens as it is evaluated,
    at the depths of the run: `views.psf_depths` says otherwise.

    The evaluation's folder, `<run>/evaluation/<name>`, has the files of a run that is tested:
    `metrics.json` with the same names, `run.json`, `.hydra/resolved.yaml`, `figures`, tables of
    photographs, `lens/final.yaml` and `log.txt`.

    Args:
        folder: of the run.
        overrides: as of the command line.
        checkpoint: `last`, `best`, or the path of a file.
        name: of the evaluation's folder; None: the time.
        perturb_lens: whether overrides may set parameters of the lens to other values, for a lens
            that was made a little differently.
        command: what was typed, for run.json.
        trust: whether the run may call, import and write what it names; see `load_run`.

    Raises:
        InputError: the folder is none of a run, or needs trust; an override makes another camera,
            or changes what only training reads; or a folder of that name is there.
    """
    started = time.perf_counter()
    output = _new_folder(Path(folder), name)
    record = read_record(folder, output, trust)
    refuse_other_work(overrides)
    given, overrides = list(overrides), with_own_calibration(record, overrides)
    with record.importable():
        config = with_overrides(record, overrides)
    changed = changed_places(record.config, config)
    refuse_another_camera(changed, config, perturb_lens)
    own = metrics_of(record.folder)
    # A run that found no classifier for its loss had none; it is not looked for again.
    with_loss = own.get("loss/perceptual_available") != 0.0
    run = load_recorded(record, config, checkpoint, with_loss)
    (output / ".hydra").mkdir(parents=True)
    with _log_file(output / "log.txt"):
        _say(run, changed)
        OmegaConf.save(run.cfg, output / RESOLVED)
        written = [*record.overrides, *overrides]
        OmegaConf.save(OmegaConf.create(written), output / OVERRIDES)
        metrics = _tested(run, output, _evaluated(run, given, changed), command)
        if "network/pretrained" in own:  # of where the run began
            metrics["network/pretrained"] = own["network/pretrained"]
        metrics["cost/wall_s"] = time.perf_counter() - started
        numbers = plain_metrics(metrics)
        write_json(output / METRICS, numbers)
        logger.info("Evaluation: %s", output)
    return Evaluated(output, numbers, run.settings.objectives[0], run)


def own_metrics(found: Evaluated) -> dict[str, float]:
    """Return the metrics of the run itself; none where it has not come to its end."""
    return metrics_of(found.run.folder)


def _new_folder(folder: Path, name: str | None) -> Path:
    name = datetime.now().strftime("%Y-%m-%d_%H-%M-%S") if name is None else name
    if not name or Path(name).name != name or not name.isprintable():
        raise InputError(f"--name: '{name}'; allowed: the name of a folder, without /")
    try:
        found = resolved_path(own_folder(folder, "evaluation") / name)
    except InputError as error:
        raise InputError(f"--name: {error}") from None
    if found.exists():
        raise InputError(f"--name: {found} is there already; give another name")
    return found


def _say(run: FinishedRun, changed: Sequence[tuple[Any, ...]]) -> None:
    """Log what is evaluated, and loudly what is not the run's own camera or state."""
    logger.info(
        "%s (%s, %s): checkpoint %s after %d steps",
        run.folder,
        run.experiment,
        run.status,
        run.checkpoint and run.checkpoint.name,
        run.step,
    )
    if run.status != "finished":
        logger.warning("The run is %s: its training may not have come to its end", run.status)
    lens = [".".join(map(str, place)) for place in changed if place[0] == "lens"]
    if lens:
        logger.warning(
            "The lens is not the trained one: %s; the network is given the point spread functions "
            "of this lens",
            ", ".join(lens),
        )


def _evaluated(
    run: FinishedRun, overrides: Sequence[str], changed: Sequence[tuple[Any, ...]]
) -> dict[str, Any]:
    return {
        "run": str(run.folder),
        "experiment": run.experiment,
        "status": run.status,
        "checkpoint": run.checkpoint and str(run.checkpoint),
        "step": run.step,
        "epoch": run.epoch,
        "overrides": list(overrides),
        "perturbed_lens": any(place[0] == "lens" for place in changed),
    }


def _tested(
    run: FinishedRun, output: Path, evaluated: Mapping[str, Any], command: Sequence[str]
) -> dict[str, Any]:
    """Test, and return the metrics; run.json says how it ended."""
    settings = run.settings
    set_threads(settings.threads)
    lightning.seed_everything(settings.seed, workers=True, verbose=False)
    set_matmul_precision(settings.matmul_precision)
    entries = (settings.callbacks or {}).items()
    callbacks = [run.made(f"callbacks.{name}", entry) for name, entry in entries if entry]
    quiet_lightning()
    unwanted: tuple[type, ...] = (ModelCheckpoint,)
    if not settings.trainer.get("enable_progress_bar", True):
        unwanted = (ModelCheckpoint, ProgressBar)
    kept = [callback for callback in callbacks if not isinstance(callback, unwanted)]
    own = {"callbacks": kept, "logger": False, "enable_checkpointing": False}
    trainer: lightning.Trainer = run.made(
        "trainer", settings.trainer, **own, **_one_process(settings.trainer)
    )
    if isinstance(run.data, CropDataModule):
        # The crops are the same by any number of processes that cut them.
        run.data.num_workers = min(run.data.num_workers, os.cpu_count() or 1)
    device = trainer.strategy.root_device
    info = describe_run(settings.seed, str(device), settings.lens_dtype, list(command))
    info["evaluated"] = dict(evaluated)
    write_json(output / INFO, {**info, "status": "running"})
    status = "failed"
    try:
        trainer.test(run.module, run.data, verbose=False)
        status = "finished"
    except (KeyboardInterrupt, SystemExit):
        status = "interrupted"
        raise
    finally:
        write_json(output / INFO, {**info, "status": status})
    (output / "lens").mkdir(exist_ok=True)
    save_lens(run.lens, output / "lens" / "final.yaml")
    metrics = dict(trainer.callback_metrics) | summary_of(run.module)
    metrics["cost/peak_memory_mb"] = peak_memory_mb(device)
    return metrics


def _one_process(trainer: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings of the trainer by which no other process is started, whatever the run had.

    One device that is chosen by its number stays.
    """
    devices = trainer.get("devices")
    chosen = isinstance(devices, Sequence) and not isinstance(devices, str) and len(devices) == 1
    return {"devices": list(devices) if chosen else 1, "num_nodes": 1, "strategy": "auto"}


@contextmanager
def _log_file(path: Path) -> Iterator[None]:
    """Write what is logged into a file besides, from INFO on."""
    root = logging.getLogger()
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter(_FORMAT))
    before = root.level
    root.addHandler(handler)
    root.setLevel(min(before, logging.INFO) if before else logging.INFO)
    try:
        yield
    finally:
        root.setLevel(before)
        root.removeHandler(handler)
        handler.close()


# What decides the work of a run, and not what is evaluated.
_OF_THE_RUN = {
    "experiment": "another experiment is another run: train it",
    "module": "another module is another run: train it",
    "train": "an evaluation does not train",
    "test": "an evaluation is a test",
    "ckpt_path": "name the checkpoint by --checkpoint",
}
# Places of the configuration whose change makes another camera, or changes training alone.
_CAMERA = (
    ("network",),
    ("variables",),
    ("module", "variables"),
    ("module", "reconstruction", "network"),
)
_TRAINING = ("optimizer", "scheduler", "learning_rates", "operands", "discriminator")


def refuse_other_work(overrides: Sequence[str]) -> None:
    """Refuse overrides that decide the work of a run, and not what is evaluated.

    Raises:
        InputError: for the first of them; or an override cannot be read, or is a sweep.
    """
    for text in overrides:
        read_override(text)
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    for override in parsed:
        key = override.key_or_group
        if override.is_sweep_override():
            raise InputError(
                f"{override.input_line}: an evaluation is one; give one value at a time"
            )
        if key.startswith("hydra"):
            raise InputError(f"{key}: Hydra has no job here; --name names the folder")
        if key in _OF_THE_RUN:
            raise InputError(f"{key}: {_OF_THE_RUN[key]}")


def with_own_calibration(record: RecordedRun, overrides: Sequence[str]) -> list[str]:
    """Return the overrides, with the depths that the run's network has its functions of.

    A camera does not know the depth of what it looks at: were its functions those of the scene that
    it is judged by, a scene of one depth would tell it.
    """
    found, views = list(overrides), (record.config["module"] or {}).get("views")
    if not found or not isinstance(views, Mapping) or "psf_size" not in views:
        return found
    scene = views.get("scene")
    depths = views.get("psf_depths") or (scene.get("depths") if isinstance(scene, dict) else None)
    asked = any(text.lstrip("+").startswith("views.psf_depths=") for text in found)
    if depths is None or asked:
        return found
    return [f"views.psf_depths={list(depths)}", *found]


def refuse_another_camera(
    changed: Sequence[tuple[Any, ...]], config: Mapping[str, Any], perturb_lens: bool
) -> None:
    """Refuse settings that make another camera than the run has trained, or only training reads.

    Args:
        changed: places of the configuration that have another value than in the run.
        config: the configuration of the evaluation.
        perturb_lens: whether parameters of the lens may have other values.

    Raises:
        InputError: for the first of them.
    """
    for place in changed:
        name = ".".join(map(str, place))
        if any(place[: len(part)] == part for part in _CAMERA):
            raise InputError(
                f"{name}: another value makes another camera than the run has trained; train it"
            )
        if place[0] in _TRAINING:
            raise InputError(f"{name}: this setting is of training alone, and nothing is trained")
        if place[0] == "lens" and not perturb_lens:
            raise InputError(
                f"{name}: another value makes another lens than the run has trained; "
                "--perturb-lens evaluates the camera with it all the same"
            )
        judged = config.get("evaluation_renderer") is not None
        if judged and place[0] == "renderer" and place[1:2] != ("sensor",):
            raise InputError(
                f"{name}: renderer makes images for training; test images are made by "
                "evaluation_renderer"
            )
