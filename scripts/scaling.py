"""Compute what a training and a search cost on other machines from a few measured steps.

    python scripts/scaling.py measure --output measured.json    # about 3 minutes on a quiet machine
    python scripts/scaling.py show measured.json                 # the tables of docs/scaling.md
    python scripts/scaling.py show measured.json --page docs/scaling.md   # writes them there

`measure` trains the default camera and the large field of view for some steps on one and two
threads, and two at once on one thread each.  `show` computes: Amdahl's law in each part of a step
on more cores, and on GPUs the assumptions that it prints.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from scripts.scaling_model import (
    ASSUMED,
    PARTS,
    Experiment,
    machine_lines,
    measured_lines,
    search_lines,
)

ROOT = Path(__file__).resolve().parents[1]
# Renderers that need no plan, which would take longer than the steps.
EXPERIMENTS = {
    "wavefront_coding": ["renderer=psf", "reference_renderers=none", "miscalibrations=none"],
    "large_fov_doublet": ["network=field_pyramid", "optimizer.lens=adam"],
}
_STEPS = 12
# Steps before the medians begin: kernels are loaded, and memory is fetched.
_WARM_UP = 4
# Between these marks a page has the tables.
_BEGIN, _END = "<!-- tables -->", "<!-- end of tables -->"
QUICK = [
    *("trainer.max_epochs=1", f"data.steps_per_epoch={_STEPS}", "+trainer.limit_val_batches=0"),
    *("test=false", "objective=train/loss", "callbacks.pictures=null"),
    *("callbacks.validation_pictures=null", "+trainer.enable_progress_bar=false"),
]


class _Operators(TorchDispatchMode):
    """Counts the operators that PyTorch runs."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(
        self,
        func: Callable[..., Any],
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        """Count an operator, and run it."""
        self.count += 1
        return func(*args, **(kwargs or {}))


class Parts(lightning.Callback):
    """Writes the medians of the parts of a step, in seconds, and counts its work once.

    Args:
        path: of the JSON file.
    """

    def __init__(self, path: str) -> None:
        self.path = Path(path)
        self.started = time.perf_counter()
        self.steps: dict[str, list[float]] = {name: [] for name in (*PARTS, "loop", "processor")}
        self._began = self._processor = self._updating = self._update = 0.0
        self._modes: tuple[FlopCounterMode, _Operators] | None = None
        self._step = 0
        self._first_step = 0.0

    def on_train_batch_start(self, trainer: lightning.Trainer, module: Any, *_: Any) -> None:
        """Take the times since the last step began; count the work of the last, untimed one."""
        now = time.perf_counter()
        self._step += 1
        if self._step == 1:
            self._first_step = now - self.started
        elif self._step > _WARM_UP:
            costs, data = module.costs.latest, trainer.datamodule.waiting.latest
            loop = now - self._began
            found = {
                "optics": costs["cost/optics_s"],
                "network": costs["cost/network_s"] - self._update,
                "optimizer": self._update,
                "data": data,
                "rest": loop - costs["cost/step_s"] - data,
                "loop": loop,
                "processor": time.process_time() - self._processor,
            }
            for name, seconds in found.items():
                self.steps[name].append(max(seconds, 0.0))
        if self._step == _STEPS:
            self._modes = FlopCounterMode(display=False), _Operators()
            for mode in self._modes:
                mode.__enter__()
        self._began, self._processor = time.perf_counter(), time.process_time()

    def on_before_optimizer_step(self, *arguments: Any) -> None:
        """Begin the update."""
        self._updating = time.perf_counter()

    def on_train_batch_end(self, *arguments: Any) -> None:
        """End the update."""
        self._update = time.perf_counter() - self._updating
        if self._modes is not None:
            for mode in reversed(self._modes):
                mode.__exit__(None, None, None)

    def on_train_end(self, trainer: lightning.Trainer, module: Any) -> None:
        """Write what was found, by the first process alone."""
        if not trainer.is_global_zero:
            return
        low, _, high = statistics.quantiles(self.steps["loop"], n=4)
        parameters = sum(p.numel() for p in module.network.parameters())
        flops, operators = self._modes or (None, None)
        found = {
            "seconds": {name: statistics.median(self.steps[name]) for name in PARTS},
            "processor": sum(self.steps["processor"]) / sum(self.steps["loop"]),
            "spread": (high - low) / statistics.median(self.steps["loop"]),
            "start_s": self._first_step,
            "flops": flops.get_total_flops() if flops else 0,
            "operators": operators.count if operators else 0,
            "parameters": parameters,
            "batch": trainer.datamodule.batch_size,
            "rays": float(module.views.rays()),
        }
        self.path.write_text(json.dumps(found, indent=1), encoding="utf-8")


@dataclass(frozen=True)
class _Run:
    """A run that measures.

    Attributes:
        process: the run.
        path: of what it writes.
    """

    process: subprocess.Popen[bytes]
    path: Path

    def result(self) -> dict[str, Any]:
        """Wait for the run, and return what it wrote."""
        if self.process.wait():
            log = self.path.with_suffix(".log").read_text(encoding="utf-8")
            raise SystemExit(f"{self.path.stem}: the run failed\n{log[-2000:]}")
        return json.loads(self.path.read_text(encoding="utf-8"))


def _started(experiment: str, threads: int, folder: Path, name: str) -> _Run:
    path = folder / f"{experiment}_{name}.json"
    command = [
        *(sys.executable, str(ROOT / "train.py"), f"experiment={experiment}", *QUICK),
        *EXPERIMENTS[experiment],
        *(f"threads={threads}", f"hydra.run.dir={path.with_suffix('')}"),
        f"+callbacks.parts={{_target_: scripts.scaling.Parts, path: {path}}}",
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": str(threads)}
    with path.with_suffix(".log").open("w") as log:
        return _Run(subprocess.Popen(command, env=environment, stdout=log, stderr=log), path)


def measure(folder: Path, busy: bool) -> dict[str, Any]:
    """Return the measured parts of every experiment, and the machine's load meanwhile.

    Args:
        folder: for the runs.
        busy: the machine has other work: one thread alone is measured, and the share of the time
            counts in which it had a processor.
    """
    began, found = os.getloadavg()[0], {}
    for experiment in EXPERIMENTS:
        one = _started(experiment, 1, folder, "one").result()
        if busy:
            share = one["processor"]
            seconds = {name: share * value for name, value in one["seconds"].items()}
            found[experiment] = {**one, "seconds": seconds}
            continue
        two = _started(experiment, 2, folder, "two").result()
        pair = [_started(experiment, 1, folder, f"pair{number}") for number in range(2)]
        together = [run.result() for run in pair]
        found[experiment] = {
            **one,
            "seconds_two_threads": two["seconds"],
            "spread_two_threads": two["spread"],
            "seconds_of_two_at_once": {
                name: statistics.fmean(run["seconds"][name] for run in together) for name in PARTS
            },
        }
    machine = {"cores": os.cpu_count(), "torch": torch.__version__, "load_before": began}
    return {"machine": machine, "experiments": found}


def show(measured: Mapping[str, Any], assumed: Mapping[str, float]) -> list[str]:
    """Return the tables in Markdown."""
    experiments = [Experiment.of(name, e) for name, e in measured["experiments"].items()]
    load = f"load {measured['machine']['load_before']:.0f} when measuring began"
    if any(e.two is None for e in experiments):
        text = (
            f"Measured on a machine with other work ({load}): one thread, and the time in which it "
            "had a processor. Rows of several threads need a quiet machine."
        )
    else:
        spread = 100.0 * max(e.spread for e in experiments)
        text = f"Measured on two cores ({load}); half of the steps lie within {spread:.0f} %."
    lines = [text]
    lines += ["", *measured_lines(experiments), "", *machine_lines(experiments, assumed)]
    return [*lines, "", *search_lines(experiments, assumed)]


def written_into(page: str, lines: Sequence[str]) -> str:
    """Return a page with other tables between its two marks.

    Raises:
        ValueError: the page has not both marks.
    """
    before, begin, rest = page.partition(_BEGIN)
    _, end, after = rest.partition(_END)
    if not begin or not end:
        raise ValueError(f"no {_BEGIN} … {_END}")
    return "".join((before, begin, "\n", "\n".join(lines), "\n", end, after))


def main(arguments: Sequence[str]) -> int:
    """Measure, or print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    measuring = commands.add_parser("measure", help="train some steps, and write their parts")
    measuring.add_argument("--output", type=Path, required=True)
    measuring.add_argument("--busy", action="store_true", help="one thread, processor's seconds")
    showing = commands.add_parser("show", help="compute the tables")
    showing.add_argument("measured", type=Path)
    showing.add_argument("--page", type=Path, help="whose tables are replaced")
    for name, (value, unit) in ASSUMED.items():
        showing.add_argument(f"--{name}", type=float, default=value, help=f"{unit} ({value:g})")
    given = parser.parse_args(arguments)
    if given.command == "measure":
        with tempfile.TemporaryDirectory() as folder:
            found = measure(Path(folder), given.busy)
        given.output.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        return 0
    assumed = {name: getattr(given, name.replace("-", "_")) for name in ASSUMED}
    lines = show(json.loads(given.measured.read_text(encoding="utf-8")), assumed)
    if given.page is None:
        print("\n".join(lines))
    else:
        page = written_into(given.page.read_text(encoding="utf-8"), lines)
        given.page.write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
