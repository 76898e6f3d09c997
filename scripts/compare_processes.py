"""Train cameras by one process and by two, and compare what they come to.

    python scripts/compare_processes.py                  # all cases, some minutes
    python scripts/compare_processes.py auto bf16 --folder runs

All train a tiny camera by plain gradient descent: Adam makes whole steps of gradients that are all
rounding.  A row gives the difference of the network's weights over their norm, and over the way
that training moved them; that of the lens's variables over their way; that of the training's loss.
The exit status is 1 where a difference over the way is above a case's limit.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import lightning
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.experiments.tiny_experiment import TINY, TINY_DOUBLET, TINY_NETWORK

ROOT = Path(__file__).resolve().parents[1]
_DESCENT = (
    *("optimizer.network._target_=torch.optim.SGD", "~optimizer.network.betas"),
    *("trainer.accelerator=cpu", "data.batch_size=4", "data.steps_per_epoch=4"),
    *("test=false", "objective=train/loss"),
    *("callbacks.pictures=null", "callbacks.validation_pictures=null"),
)
_CAMERA = ("experiment=wavefront_coding", *TINY, *TINY_NETWORK, "learning_rates.network=0.05")
_OF_RAYS = ("renderer=rays", "renderer.pupil_samples=2")
_AUTO = tuple(setting for setting in _CAMERA if setting not in _OF_RAYS)
_DOUBLET = (*TINY_DOUBLET, "learning_rates.network=0.01")
_AVERAGE = "+callbacks.average={_target_: lightning.pytorch.callbacks."
_STOPPING = (
    "+callbacks.stopping={_target_: lightning.pytorch.callbacks.EarlyStopping, monitor: val/loss, "
    "patience: 0, min_delta: 10.0}"
)
_ONE_CYCLE = (
    *("~scheduler.T_max", "~scheduler.eta_min", "+scheduler.total_steps=8"),
    *("+scheduler.max_lr=0.1", "scheduler._target_=torch.optim.lr_scheduler.OneCycleLR"),
)
_STATE = ("+lens.states.near.surfaces.3.thickness=1.7", "state=near")


@dataclass(frozen=True)
class Case:
    """A camera that is trained by one process and by two.

    Attributes:
        settings: of the run, beside those of descent.
        limit: of differences over the way; of single precision's sums in another order.
    """

    settings: tuple[str, ...]
    limit: float = 1e-3


CASES = {
    "descent": Case(_CAMERA),
    "least_squares": Case((*_CAMERA, "optimizer.lens=dls", "optimizer.least_squares.every=2")),
    "auto": Case((*_AUTO, "renderer=auto_geometric")),
    "auto_diffraction": Case((*_AUTO, "renderer=auto")),
    "auto_windows": Case(_DOUBLET),
    "float64": Case((*_CAMERA, "lens_dtype=float64")),
    # Each process rounds its gradient to 8 bits.
    "bf16": Case((*_CAMERA, "trainer.precision=bf16-mixed"), 3e-2),
    "accumulated": Case((*_CAMERA, "trainer.accumulate_grad_batches=2")),
    "clipped": Case((*_CAMERA, "+trainer.gradient_clip_val=0.01")),
    "discriminators": Case(
        (*_DOUBLET, "discriminator=double_scale", "learning_rates.discriminator=1e-5")
    ),
    "moving_average": Case((*_CAMERA, _AVERAGE + "EMAWeightAveraging, decay: 0.5}")),
    "weight_averaging": Case(
        (*_CAMERA, _AVERAGE + "StochasticWeightAveraging, swa_lrs: 0.01, swa_epoch_start: 1}")
    ),
    "early_stopping": Case((*_CAMERA, "trainer.max_epochs=4", _STOPPING)),
    "one_cycle": Case((*_CAMERA, *_ONE_CYCLE)),
    "state": Case((*_CAMERA, *_STATE)),
    "layers": Case((*_CAMERA, "scene=layers", "views=layers")),
    "bayer": Case((*_CAMERA, "readout=bayer_12bit")),
    "data_workers": Case((*_CAMERA, "data.num_workers=2")),
    # A minute of compilation, two of them at once.
    "compiled": Case((*_CAMERA, "compile_network=true")),
}


class Beginning(lightning.Callback):
    """Keeps the state in which training begins.

    Args:
        path: of the file.
    """

    def __init__(self, path: str) -> None:
        self.path = path

    def on_train_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Write the state, by the first process alone."""
        if trainer.is_global_zero:
            torch.save({"state_dict": pl_module.state_dict()}, self.path)


@dataclass(frozen=True)
class Run:
    """What a training came to.

    Attributes:
        begun: the state in which it began.
        ended: the state of its last checkpoint.
        steps: that it made.
        numbers: of `metrics.json`.
    """

    begun: Mapping[str, Tensor]
    ended: Mapping[str, Tensor]
    steps: int
    numbers: Mapping[str, float]


def trained(case: Case, processes: int, folder: Path) -> Run:
    """Train in a process of its own, which starts the others.

    Args:
        case: what is trained.
        processes: that train it.
        folder: of the run.
    """
    beginning = folder.with_suffix(".beginning")
    settings = [*case.settings, *_DESCENT, f"trainer.devices={processes}"]
    kind = "scripts.compare_processes.Beginning"
    callback = f"+callbacks.beginning={{_target_: {kind}, path: {beginning}}}"
    command = [sys.executable, str(ROOT / "train.py"), *settings, callback]
    with folder.with_suffix(".log").open("w") as log:
        subprocess.run(
            [*command, f"hydra.run.dir={folder}"],
            env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
            check=True,
            stdout=log,
            stderr=log,
        )
    begun = torch.load(beginning, weights_only=True)["state_dict"]
    last = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    numbers = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    return Run(begun, last["state_dict"], last["global_step"], numbers)


def of_network(state: Mapping[str, Tensor]) -> Tensor:
    """Return all weights and statistics of a network in one row."""
    names = [n for n, v in state.items() if n.startswith("network.") and v.is_floating_point()]
    return torch.cat([state[name].double().flatten() for name in sorted(names)])


def row_of(name: str, case: Case, one: Run, two: Run) -> tuple[str, bool]:
    """Return a line of Markdown, and whether the differences are within the limit."""
    weights, others = of_network(one.ended), of_network(two.ended)
    way = float((weights - of_network(one.begun)).norm())
    difference = float((weights - others).norm())
    lens, other = (run.ended["variables.scaled"].double() for run in (one, two))
    lens_way = float((lens - one.begun["variables.scaled"].double()).norm())
    of_lens = float((lens - other).norm()) / lens_way if lens_way else 0.0
    losses = [run.numbers["train/loss"] for run in (one, two)]
    of_loss = abs(losses[1] / losses[0] - 1.0)
    cells = (
        f"{difference / float(weights.norm()):.1e}",
        *(f"{difference / way:.1e}", f"{of_lens:.1e}", f"{of_loss:.1e}", f"{one.steps}"),
    )
    held = max(difference / way, of_lens) < case.limit and one.steps == two.steps
    return f"| {name} | {' | '.join(cells)} |{'' if held else ' <<<'}", held


def main(arguments: Sequence[str]) -> int:
    """Train and compare; print a row for each case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="*", choices=[*CASES, "all"], default="all")
    parser.add_argument("--folder", type=Path, help="for the runs; default: a temporary one")
    given = parser.parse_args(arguments)
    held = True
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        print("| case | network | over its way | lens over its way | loss | steps |", flush=True)
        print("|---|---|---|---|---|---|", flush=True)
        for name in CASES if "all" in given.cases else given.cases:
            try:
                one, two = (trained(CASES[name], n, folder / f"{name}_{n}") for n in (1, 2))
            except subprocess.CalledProcessError as error:
                held = False
                print(f"| {name} | a run ended with status {error.returncode} |", flush=True)
                continue
            row, within = row_of(name, CASES[name], one, two)
            held = held and within
            print(row, flush=True)
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
