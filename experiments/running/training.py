"""From a composed configuration to a finished run folder."""

import logging
import shlex
import sys
import time
from pathlib import Path
from typing import Any

import lightning
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from lightning.pytorch.loggers import TensorBoardLogger
from omegaconf import DictConfig, OmegaConf

from dolens.errors import InputError
from dolens.prescriptions import lens_from_prescription, save_lens
from experiments.callbacks.interruption import InterruptionNotice
from experiments.running.checkpoints import SettingsInCheckpoints, checked_checkpoint, settings_of
from experiments.running.extensions import import_extensions
from experiments.running.run_folder import describe_run, peak_memory_mb, plain_metrics, write_json
from experiments.running.unread_settings import refuse_unread

logger = logging.getLogger(__name__)

# Arithmetic that configurations need: the number of steps of a whole training.
OmegaConf.register_new_resolver("total_steps", lambda epochs, steps: epochs * steps, replace=True)

# And the iterations of stages together.
OmegaConf.register_new_resolver(
    "iterations", lambda stages: sum(stage["iterations"] for stage in stages), replace=True
)
OmegaConf.register_new_resolver("count", len, replace=True)

# The top-level keys that `run` itself takes; all others must be read by one of these.
TAKEN = (
    *("lens", "module", "data", "callbacks", "logger", "trainer"),
    *("extensions", "seed", "backend", "lens_dtype", "threads", "matmul_precision"),
    *("train", "test", "ckpt_path", "objective"),
)

_DTYPES = {"float32": torch.float32, "float64": torch.float64}


def run(cfg: DictConfig) -> float:
    """Train, test, and write the run folder; return the objective that the config names."""
    started = time.perf_counter()
    folder = Path(HydraConfig.get().runtime.output_dir)
    refuse_subprocess_ddp_in_sweep(cfg)
    refuse_unread(cfg, TAKEN)
    import_extensions(cfg.extensions)
    settings = settings_of(cfg)  # before Hydra resolves in place what it instantiates
    if str(cfg.objective).startswith("test/") and not cfg.test:
        raise InputError(f"objective: '{cfg.objective}' needs test=true, or name another metric")
    if cfg.threads:
        torch.set_num_threads(cfg.threads)
    # The basic launcher runs a sweep's jobs in one process: seed at each start.
    lightning.seed_everything(cfg.seed, workers=True, verbose=False)
    torch.set_float32_matmul_precision(cfg.matmul_precision)
    lens = build_lens(cfg)
    module = instantiate(cfg.module)(lens=lens)
    checkpoint = cfg.ckpt_path
    if checkpoint is not None:
        refuse_idle_checkpoint(cfg, module)
        checkpoint = checked_checkpoint(checkpoint, module, settings, cfg.train)
    data = instantiate(cfg.data)
    callbacks = [instantiate(c) for c in (cfg.callbacks or {}).values() if c]
    callbacks.append(InterruptionNotice(folder / "checkpoints", resume_command()))
    callbacks.append(SettingsInCheckpoints(settings))
    loggers = [instantiate(entry) for entry in (cfg.logger or {}).values() if entry]
    trainer: lightning.Trainer = instantiate(cfg.trainer, callbacks=callbacks, logger=loggers)
    (folder / "lens").mkdir(exist_ok=True)
    (folder / ".hydra").mkdir(exist_ok=True)
    OmegaConf.save(cfg_without_hydra(cfg), folder / ".hydra" / "resolved.yaml", resolve=True)
    save_lens(lens, folder / "lens" / "initial.yaml")
    device = str(trainer.strategy.root_device)
    info = describe_run(cfg.seed, device, cfg.lens_dtype, sys.argv)
    write_json(folder / "run.json", {**info, "status": "running"})
    status = "failed"
    try:
        if cfg.train:
            trainer.fit(module, data, ckpt_path=checkpoint, weights_only=True)
        metrics: dict[str, Any] = dict(trainer.callback_metrics)
        if cfg.test:
            # The weights as the last step left them: every run is judged after the same work.
            # Where nothing was trained, they are the checkpoint's.
            trained = None if cfg.train else checkpoint
            trainer.test(module, data, ckpt_path=trained, weights_only=True, verbose=False)
            metrics.update(trainer.callback_metrics)
        status = "finished"
    except (KeyboardInterrupt, SystemExit):  # Lightning turns Ctrl-C into an exit
        status = "interrupted"
        raise
    finally:
        save_lens(module.lens, folder / "lens" / "final.yaml")
        write_json(folder / "run.json", {**info, "status": status})
    metrics.update(summary_of(module))
    metrics["cost/wall_s"] = time.perf_counter() - started
    metrics["cost/peak_memory_mb"] = peak_memory_mb(trainer.strategy.root_device)
    numbers = plain_metrics(metrics)
    write_json(folder / "metrics.json", numbers)
    for entry in loggers:
        # Once, at the end and with the metrics, or TensorBoard's HPARAMS tab stays empty.
        if isinstance(entry, TensorBoardLogger):
            # At the last step: a loader takes a step back for a restart, and drops all before it.
            entry.log_hyperparams(hyperparameters(cfg), numbers, step=trainer.global_step)
        entry.finalize("success")
    logger.info("Run folder: %s", folder)
    if cfg.objective not in numbers:
        raise InputError(
            f"objective: '{cfg.objective}' is not among the metrics ({', '.join(numbers)})"
        )
    logger.info("%s = %.4g", cfg.objective, numbers[cfg.objective])
    return numbers[cfg.objective]


def cfg_without_hydra(cfg: DictConfig) -> DictConfig:
    """The configuration less Hydra's own node, which only some callers leave in it."""
    return OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"])


def build_lens(cfg: DictConfig) -> Any:
    """The lens of the configuration; prescriptions are plain data and instantiate nothing."""
    if cfg.lens_dtype not in _DTYPES:
        raise InputError(f"lens_dtype: '{cfg.lens_dtype}' is unknown; allowed: float32, float64")
    prescription = OmegaConf.to_container(cfg.lens, resolve=True)
    where = f"lens={HydraConfig.get().runtime.choices.get('lens')}"
    return lens_from_prescription(
        prescription, _DTYPES[cfg.lens_dtype], where=where, backend=cfg.backend
    )


def refuse_idle_checkpoint(cfg: DictConfig, module: lightning.LightningModule) -> None:
    """Refuse a checkpoint that nothing would load.

    Raises:
        InputError: the run neither trains nor tests, or its module trains nothing.
    """
    if not (cfg.train or cfg.test):
        raise InputError("ckpt_path: train=false test=false loads no checkpoint; leave it out")
    if type(module).training_step is lightning.LightningModule.training_step:
        raise InputError(
            f"ckpt_path: {type(module).__name__} trains nothing that a checkpoint could hold; "
            "leave it out"
        )


def summary_of(module: lightning.LightningModule) -> dict[str, float]:
    """What a module says of the whole run; nothing where it fails, which is logged.

    The run is finished: what was measured before must not be lost with this.
    """
    try:
        return plain_metrics(getattr(module, "summary", dict)())
    except Exception:
        logger.exception(
            "%s.summary() failed: metrics.json is written without its numbers",
            type(module).__name__,
        )
        return {}


def refuse_subprocess_ddp_in_sweep(cfg: DictConfig) -> None:
    """Ranks started as subprocesses would train different samples of a sweep; refuse."""
    multirun = HydraConfig.get().mode is not None and HydraConfig.get().mode.name == "MULTIRUN"
    if multirun and "ddp" in str(cfg.trainer.get("strategy", "auto")):
        raise InputError("trainer.strategy: ddp starts processes and cannot be swept with -m")


def hyperparameters(cfg: DictConfig) -> dict[str, Any]:
    """The configuration as flat plain values, for TensorBoard's HPARAMS tab."""
    flat: dict[str, Any] = {}

    def visit(node: Any, name: str) -> None:
        if isinstance(node, dict):
            for key, value in node.items():
                visit(value, f"{name}.{key}" if name else str(key))
        elif isinstance(node, bool | int | float | str):
            flat[name] = node
        else:
            flat[name] = str(node)

    # What `module` holds refers to the other groups and would only repeat them.
    left_out = ("hydra", "module", "views", "lens", "callbacks", "logger", "trainer")
    chosen = [key for key in cfg if key not in left_out]
    visit(OmegaConf.to_container(OmegaConf.masked_copy(cfg, chosen), resolve=True), "")
    return {"experiment": HydraConfig.get().runtime.choices.get("experiment"), **flat}


def resume_command() -> str:
    """The command that started this run, for a notice."""
    return shlex.join(["python", *sys.argv])
