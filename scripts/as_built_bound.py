"""Find what a network could win at most behind lenses of the worst tenth: it trains on each alone.

    python scripts/as_built_bound.py RUN --lenses 3 --steps 150

RUN is a camera that was trained as drawn and judged as built.  From its worst tenth lenses are
taken evenly, the worst first.  For each the network goes on training, from where it stands, through
this one lens, the optics held; the lens as drawn gets as many steps.  A row gives the PSNR of the
worst view behind the lens before and after.  A network that serves all lenses should restore this
one no better than a network that knows only it, so that what is won here estimates the most that
training through many lenses wins without other optics.
"""

import argparse
import copy
import csv
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dolens.experiments.camera.as_built import MadeLens, Manufacture
from dolens.experiments.camera.made_lenses import made_lens_scores
from dolens.experiments.running.finished_run import load_run

_RATE = 1.0e-3


class OneLens:
    """A manufacture whose only lens is a given one."""

    def __init__(self, manufacture: Manufacture, made: MadeLens) -> None:
        self._made = made
        self.settings = replace(manufacture.settings, tested=1)
        self.tolerances = manufacture.tolerances
        self.gives_the_design_s_functions = True

    def tested(self, lens: object, values: Mapping[str, Tensor], number: int) -> MadeLens:
        """Return the lens."""
        return self._made


def trained_on(camera: Any, values: Mapping[str, Tensor], batches: Any, steps: int) -> None:
    """Train a camera's network through one lens, whose parameters are held."""
    held = {name: value.detach() for name, value in values.items()}
    camera.network.train()
    optimizer = torch.optim.Adam(camera.network.parameters(), _RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for step in range(steps):
        with torch.no_grad(), camera.exact():
            taken = camera.views.take(camera.lens, held, next(batches), "train", step, None)
        restored = camera.restore(taken, None)
        loss = camera.loss_over_views(restored, taken.truth.to(restored.dtype))["total"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    camera.network.eval()


def main() -> None:
    """Print a row for each lens."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--lenses", type=int, default=3)
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--overrides", nargs="*", default=[])
    given = parser.parse_args()
    torch.set_num_threads(1)
    run = load_run(given.run, overrides=given.overrides)
    camera: Any = run.module
    if camera.network.needs_point_spread_function:
        parser.error("a network that is given functions: not written")
    data: Any = run.data
    data.setup("fit")
    data.setup("test")
    crops = next(iter(data.test_dataloader()))
    photographs = data.evaluation_photographs("test")[: len(crops)]
    with (given.run / "made_lenses.csv").open() as file:
        scores = [float(row["psnr_db/worst"]) for row in csv.DictReader(file)]
    worst = sorted(range(len(scores)), key=scores.__getitem__)[: max(1, len(scores) // 10)]
    chosen = [worst[i * len(worst) // given.lenses] for i in range(given.lenses)]
    start = copy.deepcopy(camera.network.state_dict())
    design = {name: value.detach() for name, value in camera.variables().items()}
    drawn = MadeLens(design, torch.zeros(len(camera.manufacture.tolerances.names)), 0)
    print("| lens | before | after |\n|---|---|---|")
    for number in [None, *chosen]:
        camera.network.load_state_dict(start)
        made = drawn
        if number is not None:
            made = camera.manufacture.tested(camera.lens, design, number)
        one = OneLens(camera.manufacture, made)
        found = []
        for steps in (0, given.steps):
            if steps:
                torch.manual_seed(0)
                trained_on(camera, made.values, _batches(data), steps)
            judged = made_lens_scores(camera, one, crops, photographs)  # type: ignore[arg-type]
            found.append(float(judged.worst_view[0]))
        name = "as drawn" if number is None else str(number)
        print(f"| {name} | {found[0]:.2f} | {found[1]:.2f} |", flush=True)


def _batches(data: Any) -> Any:
    """Yield batches without end."""
    while True:
        yield from data.train_dataloader()


if __name__ == "__main__":
    main()
