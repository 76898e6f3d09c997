"""Measure the training time of a camera to a PSNR, by the model that renders its images.

    python scripts/training_time.py train --folder runs --models auto auto_geometric rays wave
    python scripts/training_time.py show runs/* --figure training_time.png

A row gives the seconds of planning and of a step, the seconds and steps to a validation PSNR at the
worst depth (by rays for all of them), and what the test by waves says in the end.  Seconds are the
median step's and the plans', without validation, so that a busy machine does not decide.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dolens.errors import InputError
from dolens.experiments.comparison.runs import read_run
from dolens.plotting import save_figure
from dolens.plotting.style import SMALL, ruled_axes
from scripts.finished_runs import train_unless_finished

MODELS = ("auto", "auto_geometric", "psf", "rays", "wave")
_TAG = "val/psnr_db/worst"
# Short epochs, for a validation every few seconds of training.
_EPOCHS, _STEPS = 12, 40


@dataclass(frozen=True)
class Training:
    """A camera's training.

    Attributes:
        model: of the training images, a choice of `renderer`.
        plan_seconds: for choosing the model, in all epochs.
        step_seconds: the median step's.
        optics_seconds: of that for images and their gradients.
        curve: step → PSNR (dB) at the worst depth, on validation.
        test: dB at the worst depth, by rays.
        test_wave: likewise by waves; NaN where they did not judge.
    """

    model: str
    plan_seconds: float
    step_seconds: float
    optics_seconds: float
    curve: dict[int, float]
    test: float
    test_wave: float

    def seconds(self, step: int) -> float:
        """Return the seconds of training up to a step; plans are spread over the steps."""
        return step * (self.step_seconds + self.plan_seconds / max(self.curve))

    def first(self, psnr: float) -> int | None:
        """The step at which the curve, linear between validations, first reaches a PSNR."""
        before: tuple[int, float] | None = None
        for step, value in sorted(self.curve.items()):
            if value >= psnr:
                if before is None:
                    return step
                share = (psnr - before[1]) / (value - before[1])
                return round(before[0] + share * (step - before[0]))
            before = step, value
        return None


def read_training(folder: Path) -> Training:
    """Read the training of a run folder.

    Raises:
        InputError: no finished run with a validation curve.
    """
    run = read_run(folder)
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    if _TAG not in events.Tags()["scalars"]:
        raise InputError(f"{folder}: TensorBoard's file has no {_TAG}")
    curve = {scalar.step + 1: scalar.value for scalar in events.Scalars(_TAG)}
    metrics = run.metrics
    return Training(
        run.choices["renderer"],
        metrics.get("auto/plan_s", 0.0),
        metrics["cost/step_s"],
        metrics["cost/optics_s"],
        curve,
        metrics["test/psnr_db/worst"],
        metrics.get("test_wave/psnr_db/worst", float("nan")),
    )


def table(found: Sequence[Training], psnr: float | None) -> list[str]:
    """Lines of Markdown; the PSNR is by default what all reach, less 0.05 dB."""
    if psnr is None:
        psnr = min(max(training.curve.values()) for training in found) - 0.05
    lines = [
        f"| model | step, s | of which optics, s | plans, s | to {psnr:.2f} dB, s | steps "
        "| test, dB | by waves, dB |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for t in found:
        step = t.first(psnr)
        reached = ("–", "–") if step is None else (f"{t.seconds(step):.0f}", f"{step}")
        lines.append(
            f"| {t.model} | {t.step_seconds:.3f} | {t.optics_seconds:.3f} | {t.plan_seconds:.1f} "
            f"| {reached[0]} | {reached[1]} | {t.test:.2f} | {t.test_wave:.2f} |"
        )
    return lines


def figure_of(found: Sequence[Training]) -> Figure:
    """Validation PSNR at the worst depth against seconds of training."""
    figure = Figure(figsize=(5.0, 3.6), layout="constrained")
    axes = figure.subplots()
    for training in found:
        steps = sorted(training.curve)
        seconds = [training.seconds(step) for step in steps]
        axes.plot(seconds, [training.curve[s] for s in steps], marker=".", label=training.model)
    axes.set_xlabel("seconds of training", fontsize=SMALL)
    axes.set_ylabel("validation PSNR at the worst depth (dB)", fontsize=SMALL)
    axes.legend(frameon=False, fontsize=SMALL)
    ruled_axes(axes)
    return figure


def train(folder: Path, models: Sequence[str], overrides: Sequence[str]) -> None:
    """Train the default camera by each model; finished ones are left."""
    for model in models:
        own = [
            "experiment=wavefront_coding",
            f"renderer={model}",
            f"data.steps_per_epoch={_STEPS}",
            f"trainer.max_epochs={_EPOCHS}",
            f"callbacks.pictures.every_n_epochs={_EPOCHS}",
            "miscalibrations=none",
        ]
        train_unless_finished(folder / model, [*own, *overrides])


def main(arguments: Sequence[str]) -> int:
    """Train, or print the table and write the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    training = commands.add_parser("train", help="train a camera by each model")
    training.add_argument("--folder", type=Path, required=True)
    training.add_argument("--models", nargs="+", default=MODELS, choices=MODELS)
    training.add_argument("--overrides", nargs="*", default=[], help="of train.py")
    show = commands.add_parser("show", help="table and figure of finished runs")
    show.add_argument("folders", nargs="+", type=Path)
    show.add_argument("--psnr", type=float, help="dB; default: what all of them reach")
    show.add_argument("--figure", type=Path)
    given = parser.parse_args(arguments)
    try:
        if given.command == "train":
            train(given.folder, given.models, given.overrides)
            return 0
        found = [read_training(folder) for folder in given.folders]
        print("\n".join(table(found, given.psnr)))
        if given.figure:
            save_figure(figure_of(found), given.figure)
    except InputError as problem:
        parser.error(str(problem))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
