"""Train a co-design for seconds of one processor, and judge it."""

import logging
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import lightning
from hydra.utils import instantiate

from dolens.experiments.camera.camera import CameraModule
from dolens.experiments.running.configuration import checked
from dolens.experiments.running.process_settings import set_threads
from dolens.experiments.running.run_settings import RunSettings
from dolens.experiments.running.training import build_lens
from scripts.composed import composed

CallbacksOf = Callable[[], list[lightning.Callback]]

# Steps of two short trainings, whose difference tells what a step costs.
_SHORT, _LONG = 5, 20
# How often they are made, for the faster one.
_REPEATS = 2


class Trainings:
    """Trains co-designs, each for the same process time of one thread.

    Args:
        data: overrides that choose the photographs.
        seconds: of process time; a design before the first step is part of it.
    """

    def __init__(self, data: Sequence[str], seconds: float) -> None:
        set_threads(1)
        warnings.filterwarnings("ignore")
        logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
        self._data, self._seconds = tuple(data), seconds
        self._step_costs: dict[tuple[str, ...], float] = {}

    def scores(
        self, overrides: Sequence[str], seed: int, split: str, callbacks: CallbacksOf = list
    ) -> dict[str, float]:
        """Train, and return scores with what it cost.

        Args:
            overrides: of `train.py`.
            seed: of the run.
            split: `val` or `test`.
            callbacks: makes those of a training, which may move the lens in dolens's place.
        """
        module, _, _ = self._made([*overrides, *_steps(1)], seed)
        begun = time.process_time()
        module.lens_steps.begin(module.network.needs_point_spread_function, module.view_norm)
        left = self._seconds - (time.process_time() - begun)
        steps = max(1, round(left / self._step_cost(list(overrides), callbacks)))
        module, data, score = self._made([*overrides, *_steps(steps)], seed)
        seconds = _fit(module, data, steps, callbacks())
        trainer = _trainer(steps)
        if split == "val":
            trainer.validate(module, data, verbose=False)
        else:
            trainer.test(module, data, verbose=False)
        found = {k: float(v) for k, v in trainer.callback_metrics.items()}
        return {
            "score": found[f"{split}/{score}"],
            "psnr_db": found[f"{split}/psnr_db"],
            "worst": found[f"{split}/psnr_db/worst"],
            "raw_psnr_db": found[f"{split}/raw_psnr_db"],
            "steps": float(steps),
            "seconds": seconds,
        }

    def _step_cost(self, overrides: list[str], callbacks: CallbacksOf) -> float:
        """Return process seconds of a step; a lens that stands still after a share costs less."""
        until = [o for o in overrides if o.startswith("optimizer.until=")]
        share = float(until[0].split("=")[1]) if until else 1.0
        # What a design before the first step costs is known apart.
        dropped = ["optimizer.until", "learning_rates"]
        dropped += [] if callbacks() else ["optimizer.least_squares"]
        others = [o for o in overrides if not o.startswith(tuple(dropped))]
        parts = {"1.0": share, "0.0": 1.0 - share}
        return sum(
            part * self._measured(others, moves, callbacks) for moves, part in parts.items() if part
        )

    def _measured(self, overrides: list[str], until: str, callbacks: CallbacksOf) -> float:
        key = (*overrides, until, *(type(callback).__name__ for callback in callbacks()))
        if key not in self._step_costs:
            whole = [*overrides, f"optimizer.until={until}"]
            costs = []
            for _ in range(_REPEATS):
                times = []
                for steps in (_SHORT, _LONG):
                    module, data, _ = self._made([*whole, *_steps(steps)], 0)
                    times.append(_fit(module, data, steps, callbacks()))
                costs.append((times[1] - times[0]) / (_LONG - _SHORT))
            self._step_costs[key] = min(costs)
        return self._step_costs[key]

    def _made(self, overrides: Sequence[str], seed: int) -> tuple[CameraModule, Any, str]:
        with composed([*overrides, *self._data, f"seed={seed}", "threads=1"]) as found:
            cfg = checked(found)
            settings = RunSettings.of(cfg)
            lightning.seed_everything(seed, workers=True, verbose=False)
            module = instantiate(settings.module)(lens=build_lens(settings))
            return module, instantiate(settings.data), cfg.score


def photographs_in(folders: Sequence[str]) -> list[str]:
    """Return overrides that choose the package photographs, with folders where they lie too."""
    found = ["data=package_photographs", "data.evaluation_crops_per_photograph=1"]
    return [*found, f"data.folders=[{','.join(folders)}]"] if folders else found


def _steps(count: int) -> tuple[str, str]:
    return f"data.steps_per_epoch={count}", "trainer.max_epochs=1"


def _trainer(steps: int, callbacks: Sequence[lightning.Callback] = ()) -> lightning.Trainer:
    return lightning.Trainer(
        callbacks=list(callbacks),
        accelerator="cpu",
        max_epochs=1,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        limit_train_batches=steps,
    )


def _fit(
    module: CameraModule, data: Any, steps: int, callbacks: Sequence[lightning.Callback]
) -> float:
    """Train, without validation, and return the process seconds."""
    trainer = _trainer(steps, callbacks)
    trainer.limit_val_batches = 0
    begun = time.process_time()
    trainer.fit(module, data)
    return time.process_time() - begun
