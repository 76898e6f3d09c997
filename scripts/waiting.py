"""Measure how OpenMP's threads should wait: alone, and beside other programs.

    python scripts/waiting.py                # some eight minutes
    python scripts/waiting.py --rounds 3 --policies default passive

A program of two threads beside a busy one shares two cores.  A thread that waits without sleeping
then uses the core that the one it waits for needs.  A training, a trace with its gradient, and
a convolution are run by turns under every policy, alone, beside a busy Python loop, and beside
another program that convolves.  Before each turn some seconds are not counted, since `dolens`
follows what else runs.  Times are medians in ms; in brackets, the shortest.
"""

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
WORKS = ("step", "trace", "convolution")
# What the environment says before OpenMP starts; without a word, `dolens train` sets its own.
POLICIES = {
    "dolens": {},
    "default": {"GOMP_SPINCOUNT": "300000"},  # of GNU's OpenMP, for some milliseconds
    "passive": {"OMP_WAIT_POLICY": "passive"},
    **{f"spin {n}": {"GOMP_SPINCOUNT": n} for n in ("0", "1000", "10000", "100000")},
}
_LOOP = "while True: pass"
_CONVOLUTIONS = """
import torch
layer, images = torch.nn.Conv2d(16, 16, 3, padding=1), torch.zeros(4, 16, 256, 256)
while True: layer(images).square().sum().backward()
"""
BESIDE = {"nothing": "", "a loop": _LOOP, "convolutions": _CONVOLUTIONS}
# A camera that is trained in steps of a tenth of a second.
TRAINING = (
    "experiment=wavefront_coding",
    "reference_renderers=none",
    "miscalibrations=none",
    "renderer=rays",
    "renderer.pupil_samples=3",
    "renderer.sensor.height=64",
    "renderer.sensor.width=64",
    "views.psf_size=33",
    "data.margin=16",
    "network=feature_wiener",
    "network.width=8",
    "loss.perceptual=none",
    "data.steps_per_epoch=1000000",
    "trainer.max_epochs=1",
    "+trainer.enable_progress_bar=false",
    "callbacks.progress=null",
    "+callbacks.orders._target_=benchmarks.waiting_probe.Orders",
)


class Probe:
    """A training under a policy, which waits for orders between its steps.

    Args:
        threads: of torch.
        variables: of its environment.
        folder: its run folder.
        overrides: of the training that is here.
    """

    def __init__(
        self, threads: int, variables: dict[str, str], folder: Path, overrides: Sequence[str] = ()
    ) -> None:
        answers, written = os.pipe()
        # A policy of the caller's own must not stand beside those that are compared.
        environment = {
            name: value
            for name, value in os.environ.items()
            if not name.startswith(("OMP_", "GOMP_", "KMP_"))
        }
        environment |= variables | {"DOLENS_ANSWERS": str(written)}
        environment["PYTHONPATH"] = str(ROOT / "scripts")
        program = [sys.executable, str(ROOT / "train.py"), *TRAINING, *overrides]
        self._process = subprocess.Popen(
            [*program, f"threads={threads}", f"hydra.run.dir={folder}"],
            env=environment, pass_fds=[written], stdin=subprocess.PIPE, text=True, cwd=ROOT,
            stdout=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(written)
        self._answers = os.fdopen(answers)

    def ask(self, work: str, seconds: float) -> dict[str, Any]:
        """Have it work for some seconds; return its answer."""
        assert self._process.stdin is not None
        print(work, seconds, file=self._process.stdin, flush=True)
        answer = self._answers.readline()
        if not answer:
            raise SystemExit("error: the training has ended; what it said stands above")
        return json.loads(answer)

    def close(self) -> None:
        """End it."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


@contextmanager
def neighbours() -> Iterator[dict[str, subprocess.Popen]]:
    """Other programs that sleep until they are told to go on."""
    found = {
        name: subprocess.Popen([sys.executable, "-c", program])
        for name, program in BESIDE.items()
        if program
    }
    for process in found.values():
        process.send_signal(signal.SIGSTOP)
    try:
        yield found
    finally:
        for process in found.values():
            process.kill()


def main(arguments: Sequence[str]) -> None:
    """Measure, and print a table for each neighbour."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policies", nargs="+", choices=POLICIES, default=list(POLICIES))
    parser.add_argument("--works", nargs="+", choices=WORKS, default=list(WORKS))
    parser.add_argument("--beside", nargs="+", choices=BESIDE, default=list(BESIDE))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--settle", type=float, default=1.5, help="seconds before each turn")
    parser.add_argument("--seconds", type=float, default=0.4, help="of each work in each round")
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="beside one alone")
    parser.add_argument("--overrides", nargs="+", default=[], help="of the training's settings")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as scratch, neighbours() as others:
        probes = {"1 thread": Probe(1, {}, Path(scratch, "one"), options.overrides)}
        for name in options.policies:
            folder = Path(scratch, name.replace(" ", "_"))
            probes[name] = Probe(options.threads, POLICIES[name], folder, options.overrides)
        for probe in probes.values():  # compiled, and warm
            for work in options.works:
                probe.ask(work, 1.0)
        seconds: dict[tuple[str, str, str], list[float]] = defaultdict(list)
        for _ in range(options.rounds):
            for beside in options.beside:
                if beside in others:
                    others[beside].send_signal(signal.SIGCONT)
                for name, probe in probes.items():
                    probe.ask("step", options.settle)
                    for work in options.works:
                        seconds[beside, name, work] += probe.ask(work, options.seconds)["seconds"]
                if beside in others:
                    others[beside].send_signal(signal.SIGSTOP)
        for probe in probes.values():
            probe.close()
    for beside in options.beside:
        print(f"\n{options.threads} threads, beside {beside}; load {os.getloadavg()[0]:.1f}")
        print(f"{'':14s}" + "".join(f"{work:>22s}" for work in options.works))
        for name in probes:
            cells = (seconds[beside, name, work] for work in options.works)
            texts = (f"{1e3 * statistics.median(s):.1f} ({1e3 * min(s):.1f})" for s in cells)
            print(f"{name:14s}" + "".join(f"{text:>22s}" for text in texts))


if __name__ == "__main__":
    main(sys.argv[1:])
