"""Measure what one call of a trace takes, beside another checkout and plain PyTorch.

    git worktree add ../before COMMIT
    python scripts/calls.py --baseline ../before
    python scripts/calls.py --lenses cooke_triplet --rays 100,1e4 --threads 1,2 --reference

A call of 100 rays is nearly all Python and dispatch.  Each contender has a process of its own; they
take turns of some hundredths of a second, so that a busy machine slows all alike.  Numbers are
medians of the turns, µs; the shortest turn is in brackets; ratios are of neighbouring turns.
"""

import argparse
import itertools
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
CALLS = ("forward", "graph", "gradient")


class Contender:
    """A process that answers how long a call takes.

    Args:
        name: as the table says it.
        root: of the checkout.
        backend: of dolens.
        case: lens, dtype, rays and threads, as text.
    """

    def __init__(self, name: str, root: Path, backend: str, case: Sequence[str]) -> None:
        self.name = name
        probe = Path(__file__).with_name("benchmarks") / "call_probe.py"
        paths = {"PYTHONPATH": str(Path(__file__).parent)}
        command = [sys.executable, str(probe), str(root), backend, *case]
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | paths,
        )
        if self._line() != "ready":
            raise RuntimeError(f"{name} did not start")

    def microseconds(self, call: str, seconds: float, clock: str) -> float:
        """Return the mean time of one call, repeated for so many seconds."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{call} {seconds} {clock}\n")
        self._process.stdin.flush()
        return float(self._line())

    def close(self) -> None:
        """End the process."""
        self._process.communicate()

    def _line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()


def main(options: argparse.Namespace) -> None:
    """Measure, print, and write what was measured."""
    rows: list[dict[str, Any]] = []
    print(f"{'lens':14s} {'dtype':8s} {'threads':>7s} {'rays':>8s} {'call':9s} µs, and / ours")
    cases = itertools.product(options.lenses, options.dtypes, options.threads, options.rays)
    for name, dtype, threads, rays in cases:
        given = (name, dtype, str(int(float(rays))), threads)
        contenders = [Contender("ours", ROOT, options.backend, given)]
        if options.baseline is not None:
            baseline = options.baseline.resolve()
            contenders.append(Contender("baseline", baseline, options.backend, given))
        if options.reference:
            contenders.append(Contender("plain PyTorch", ROOT, "reference", given))
        for call in options.calls:
            taken: dict[str, list[float]] = {c.name: [] for c in contenders}
            for _ in range(options.turns):
                for contender in contenders:
                    time.sleep(options.pause)  # threads of the one before go to sleep
                    taken[contender.name].append(
                        contender.microseconds(call, options.seconds, options.clock)
                    )
            row = {"lens": name, "dtype": dtype, "threads": int(threads), "rays": int(float(rays))}
            rows.append(row | {"call": call, "microseconds": taken})
            print(f"{name:14s} {dtype:8s} {threads:>7s} {rays:>8s} {call:9s} {_text(taken)}")
        for contender in contenders:
            contender.close()
    if options.output is not None:
        options.output.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def _text(taken: dict[str, list[float]]) -> str:
    """Return medians, shortest turns and ratios to ours."""
    ours, parts = taken["ours"], []
    for name, turns in taken.items():
        text = f"{name} {statistics.median(turns):.0f} [{min(turns):.0f}]"
        if name != "ours":
            ratio = statistics.median(b / a for a, b in zip(ours, turns, strict=True))
            text += f" = {ratio:.2f} ×"
        parts.append(text)
    return "; ".join(parts)


def arguments(given: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--baseline", type=Path, help="folder of another checkout")
    parser.add_argument("--reference", action="store_true", help="plain PyTorch beside it")
    parser.add_argument("--backend", default="cpu", help="cpu, or auto as users have it")
    for name, default in (
        ("lenses", "cooke_triplet,nikon"),
        ("dtypes", "float32,float64"),
        ("rays", "100,1e4,1e5,1e6"),
        ("threads", "1"),
        ("calls", ",".join(CALLS)),
    ):
        parser.add_argument(f"--{name}", type=lambda text: text.split(","), default=default)
    parser.add_argument("--turns", type=int, default=15)
    parser.add_argument("--seconds", type=float, default=0.03, help="of a turn")
    parser.add_argument("--pause", type=float, default=0.005, help="seconds between turns")
    parser.add_argument(
        "--clock", default="wall", choices=("wall", "cpu"), help="cpu beside others"
    )
    parser.add_argument("--output", type=Path, help="a file for all turns, as JSON")
    return parser.parse_args(given)


if __name__ == "__main__":
    main(arguments())
