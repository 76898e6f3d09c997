"""Compare the training time of cameras to a PSNR, by the model that renders their images.

    dolens train -m experiment=wavefront_coding renderer=auto_geometric,rays,auto \\
        data.steps_per_epoch=40 trainer.max_epochs=12 miscalibrations=none
    python scripts/training_time.py outputs/wavefront_coding/sweeps/DATE_TIME/[0-9]*

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

from dolens.errors import InputError
from dolens.experiments.comparison.runs import read_run
from dolens.plotting import save_figure
from dolens.plotting.style import SMALL, ruled_axes

_TAG = "val/psnr_db/worst"


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


def main(arguments: Sequence[str]) -> int:
    """Print the table, and write the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path, help="of finished runs")
    parser.add_argument("--psnr", type=float, help="dB; default: what all of them reach")
    parser.add_argument("--figure", type=Path)
    given = parser.parse_args(arguments)
    try:
        found = [read_training(folder) for folder in given.folders]
        print("\n".join(table(found, given.psnr)))
        if given.figure:
            save_figure(figure_of(found), given.figure)
    except InputError as problem:
        parser.error(str(problem))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
