"""From a composed configuration to a finished run folder."""

import inspect
import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from lightning.pytorch.callbacks import ProgressBar
from omegaconf import DictConfig, OmegaConf

from dolens.errors import InputError, one_line
from dolens.experiments.callbacks.checkpoints import (
    LogsBeforeCheckpoints,
    ResumedEpochs,
    ResumedSchedules,
)
from dolens.experiments.callbacks.interruption import (
    InterruptionNotice,
    LoggedObjectives,
    StarvationWarning,
)
from dolens.experiments.experiment import Experiment, check_experiment
from dolens.experiments.loggers.protocol import (
    RunSummary,
    all_settings,
    choices_of,
    require_package,
    summarise,
)
from dolens.experiments.loggers.trackers import History
from dolens.experiments.running.checkpoints import (
    SettingsInCheckpoints,
    WholeCheckpoints,
    checked_checkpoint,
    settings_of,
)
from dolens.experiments.running.command_line import command
from dolens.experiments.running.configuration import checked
from dolens.experiments.running.process_settings import set_matmul_precision, set_threads
from dolens.experiments.running.refused_settings import names_of_targets
from dolens.experiments.running.run_files import INFO, METRICS, RESOLVED, write_json
from dolens.experiments.running.run_folder import (
    describe_run,
    peak_memory_mb,
    plain_metrics,
)
from dolens.experiments.running.run_settings import RunSettings, refuse_unknown, returned
from dolens.experiments.running.trainer import all_processes, made_trainer
from dolens.experiments.running.user_configuration import import_extensions
from dolens.experiments.search.pruning import TrialPruned, trial_callbacks
from dolens.experiments.settings import check_sensor_distance, register_resolvers
from dolens.experiments.watch.started import start_page
from dolens.files import written_whole
from dolens.optics.lens import Lens
from dolens.prescriptions import lens_from_prescription, save_lens

logger = logging.getLogger(__name__)

# What may log metrics.
_LOGGING = ("module", "data", "callbacks")

register_resolvers()


def run(cfg: DictConfig) -> float | tuple[float, ...]:
    """Train, test, and write the run folder; return the objectives that the config names.

    Args:
        cfg: the composed configuration, as Hydra gives it to the job.

    Raises:
        InputError: what the configuration asks for cannot be done; see `checked`.
        TrialPruned: the run is one of a search, and hopeless there.
    """
    started = time.perf_counter()
    folder = Path(HydraConfig.get().runtime.output_dir)
    cfg = checked(cfg)
    settings = RunSettings.of(cfg)
    import_extensions(settings.extensions)
    written = settings_of(cfg)  # before Hydra resolves in place what it instantiates
    set_threads(settings.threads)
    # The basic launcher runs a sweep's jobs in one process: seed at each start.
    lightning.seed_everything(settings.seed, workers=True, verbose=False)
    set_matmul_precision(settings.matmul_precision)
    module = build_module(settings)
    check_experiment(module, settings.train)
    module.place(str(HydraConfig.get().runtime.choices.get("experiment")), folder)
    refuse_unknown(settings.objectives, module.metric_names(), names_of_targets(cfg, _LOGGING))
    checkpoint = settings.ckpt_path
    refuse_untrained(settings, module)
    if checkpoint is not None:
        refuse_idle_checkpoint(settings, module)
        checkpoint = checked_checkpoint(checkpoint, module, written, settings.train)
    data = instantiate(settings.data)
    callbacks = [instantiate(entry) for entry in (settings.callbacks or {}).values() if entry]
    if not settings.trainer.get("enable_progress_bar", True):
        callbacks = [c for c in callbacks if not isinstance(c, ProgressBar)]
    callbacks.append(InterruptionNotice(folder / "checkpoints", resume_command()))
    epochs = ResumedEpochs()
    callbacks += [epochs, ResumedSchedules(), LogsBeforeCheckpoints()]
    callbacks.append(SettingsInCheckpoints(written))
    if settings.live:
        require_package("starlette", "live", "live: true")
    starvation = StarvationWarning()
    callbacks += [starvation, LoggedObjectives(settings.objectives), *trial_callbacks()]
    loggers = [instantiate(entry) for entry in (settings.logger or {}).values() if entry]
    loggers.append(History(folder / "metrics.csv"))
    trainer = made_trainer(settings.trainer, callbacks, loggers)
    refuse_in_sweep(trainer, settings.live)
    module.check_trainer(trainer)
    if not settings.trainer.get("plugins"):  # which may bring a writer of their own
        trainer.strategy.checkpoint_io = WholeCheckpoints()
    (folder / "lens").mkdir(exist_ok=True)
    (folder / ".hydra").mkdir(exist_ok=True)
    with written_whole(folder / RESOLVED) as aside:
        OmegaConf.save(cfg, aside, resolve=True)
    save_lens(module.lens, folder / "lens" / "initial.yaml")
    device = str(trainer.strategy.root_device)
    info = describe_run(settings.seed, device, settings.lens_dtype, sys.argv)
    write_json(folder / INFO, {**info, "status": "running"})
    if settings.live and trainer.is_global_zero:
        start_page(folder)
    status = "failed"
    try:
        with all_processes(trainer, settings.threads):
            if settings.train:
                trainer.fit(module, data, ckpt_path=checkpoint, weights_only=True)
                if not epochs.trained and any(n.startswith("val/") for n in settings.objectives):
                    trainer.validate(module, data, verbose=False)
            metrics: dict[str, Any] = dict(trainer.callback_metrics)
            if settings.test:
                # The weights as the last step left them: every run is judged after the same work.
                # Where nothing was trained, they are the checkpoint's.
                trained = None if settings.train else checkpoint
                trainer.test(module, data, ckpt_path=trained, weights_only=True, verbose=False)
                metrics.update(trainer.callback_metrics)
        status = "finished"
    except TrialPruned as pruned:
        status, info["reason"] = "pruned", str(pruned)
        raise
    except BaseException as error:
        # Lightning turns Ctrl-C into an exit.
        stopped = isinstance(error, KeyboardInterrupt | SystemExit)
        status = "interrupted" if stopped else "failed"
        raise
    finally:
        # An error on its way out is the one to be heard of.
        with logged_if(status != "finished"):
            write_json(folder / INFO, {**info, "status": status})
        with logged_if(status != "finished"):
            save_lens(module.lens, folder / "lens" / "final.yaml")
    if trainer.is_global_zero:
        metrics.update(summary_of(module))
    metrics.update(starvation.numbers())
    metrics["cost/wall_s"] = time.perf_counter() - started
    metrics["cost/peak_memory_mb"] = peak_memory_mb(trainer.strategy.root_device)
    numbers = plain_metrics(metrics)
    write_json(folder / METRICS, numbers)
    summary = RunSummary(
        choices=choices_of(cfg),
        settings=all_settings(cfg),
        objective=settings.objectives[0],
        numbers=numbers,
        step=trainer.global_step,
    )
    for entry in loggers:
        summarise(entry, summary)
        entry.finalize("success")
    logger.info("Run folder: %s", folder)
    found = returned(settings.objectives, numbers)
    for objective in settings.objectives:
        logger.info("%s = %.4g", objective, numbers[objective])
    return found


@contextmanager
def logged_if(failing: bool) -> Iterator[None]:
    """Log what goes wrong in a block in the place of raising it, if a run is failing already."""
    try:
        yield
    except Exception as error:
        if not failing:
            raise
        logger.error("%s", one_line(error))


def build_module(settings: RunSettings) -> Experiment:
    """Return the experiment with its lens; a search for lenses makes its own."""
    make = instantiate(settings.module)
    lens = inspect.signature(make).parameters.get("lens")
    if settings.lens is None and lens is not None and lens.default is None:
        return make()
    return make(lens=build_lens(settings))


def build_lens(settings: RunSettings) -> Lens:
    """Return the lens of a run; prescriptions are plain data and instantiate nothing."""
    where = f"lens={HydraConfig.get().runtime.choices.get('lens')}"
    lens = lens_from_prescription(
        settings.prescription(), settings.dtype, where=where, backend=settings.backend
    )
    lens = lens.in_state(settings.state)
    check_sensor_distance(lens, "lens")
    return lens


def refuse_untrained(settings: RunSettings, module: Experiment) -> None:
    """Refuse to judge what was never trained as if it had been.

    Raises:
        InputError: there is something to train, and it is neither trained nor loaded.
    """
    if module.trains and not settings.train and settings.ckpt_path is None:
        raise InputError(
            f"train: false leaves {type(module).__name__} untrained, and no ckpt_path gives it a "
            "trained state; dolens evaluate RUN tests a finished run again, and "
            "trainer.max_epochs=0 tests what training begins with"
        )


def refuse_idle_checkpoint(settings: RunSettings, module: Experiment) -> None:
    """Refuse a checkpoint that nothing would load.

    Raises:
        InputError: the run neither trains nor tests, or its module trains nothing.
    """
    if not (settings.train or settings.test):
        raise InputError("ckpt_path: train=false test=false loads no checkpoint; leave it out")
    if not module.trains:
        raise InputError(
            f"ckpt_path: {type(module).__name__} trains nothing that a checkpoint could hold; "
            "leave it out"
        )


def summary_of(module: Experiment) -> dict[str, float]:
    """Return the numbers of the whole run; none where the module fails, which is logged.

    The run is finished: what was measured before must not be lost with this.
    """
    try:
        return plain_metrics(module.summary())
    except Exception:
        logger.exception(
            "%s.summary() failed: metrics.json is written without its numbers",
            type(module).__name__,
        )
        return {}


def refuse_in_sweep(trainer: lightning.Trainer, live: bool) -> None:
    """Refuse what a job of a sweep cannot have: processes of its own, each of which would train
    another sample of the sweep, and a page.

    Raises:
        InputError: there are several processes, or a page.
    """
    multirun = HydraConfig.get().mode is not None and HydraConfig.get().mode.name == "MULTIRUN"
    if multirun and trainer.world_size > 1:
        raise InputError(
            f"trainer.devices: {trainer.world_size} processes cannot be swept with -m; allowed: 1"
        )
    if multirun and live:
        raise InputError("live: true cannot be swept with -m; dolens watch RUN shows one run")


def resume_command() -> str:
    """The command that runs this run again, for a notice; it runs a job of a sweep alone."""
    hydra = HydraConfig.get()
    if hydra.mode is not None and hydra.mode.name == "MULTIRUN":
        return command(OmegaConf.to_container(hydra.overrides.task, resolve=False))
    return command(sys.argv[1:])
