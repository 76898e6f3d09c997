"""Results of trained networks: files, a table, and curves."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from dolens.experiments.camera.photograph_scores import format_interval
from dolens.plotting.runs import Curve
from dolens.reconstruction.quality import Interval, bootstrap_interval, gain_interval


@dataclass(frozen=True)
class Result:
    """A trained network and its scores.

    Attributes:
        name: of the network.
        seed: of its training.
        limit: process time that it was to train for, seconds.
        seconds: that it did.
        steps: of training.
        parameters: their number.
        scores: judge → PSNR in dB of photographs at depths, (P, D).
    """

    name: str
    seed: int
    limit: float
    seconds: float
    steps: int
    parameters: int
    scores: dict[str, Tensor]


def write(result: Result, file: Path) -> None:
    """Write a result as JSON."""
    values = {**vars(result), "scores": {k: v.tolist() for k, v in result.scores.items()}}
    file.write_text(json.dumps(values), encoding="utf-8")


def read(folder: Path) -> list[Result]:
    """Return all results of a folder."""
    found = []
    for file in sorted(folder.glob("*.json")):
        values = json.loads(file.read_text(encoding="utf-8"))
        values["scores"] = {k: torch.tensor(v) for k, v in values["scores"].items()}
        found.append(Result(**values))
    return found


def table(results: Sequence[Result], baseline: str) -> list[str]:
    """Return lines of Markdown: PSNR at the worst depth, and gains over the baseline."""
    judges = list(results[0].scores)
    lines = [
        f"| network | seconds | ms a step | parameters | seeds | {' | '.join(judges)} | gain |",
        "|" + "---|" * (6 + len(judges)),
    ]
    for limit in sorted({r.limit for r in results}):
        groups = _groups(results, limit)
        for name, by_seed in sorted(groups.items(), key=lambda g: _worst_of(g[1], judges[-1])):
            one = next(iter(by_seed.values()))
            worst = [f"{_worst_of(by_seed, judge):.2f}" for judge in judges]
            gain = ""
            if name != baseline and baseline in groups:
                gain = format_interval(_gain(by_seed, groups[baseline], judges[-1]), 2)
            lines.append(
                f"| {name} | {limit:g} | {1000 * one.seconds / one.steps:.0f} | {one.parameters} "
                f"| {len(by_seed)} | {' | '.join(worst)} | {gain} |"
            )
    return lines


def curves(results: Sequence[Result]) -> list[Curve]:
    """Return PSNR at the worst depth against seconds, by network, for the last judge."""
    judge = list(results[0].scores)[-1]
    found: dict[str, list[tuple[float, Interval]]] = {}
    for limit in sorted({r.limit for r in results}):
        for name, by_seed in _groups(results, limit).items():
            scores = torch.stack([r.scores[judge] for r in by_seed.values()])
            generator = torch.Generator().manual_seed(0)
            interval = bootstrap_interval(scores, _worst, generator)
            found.setdefault(name, []).append((limit, interval))
    return [
        Curve(
            name,
            [limit for limit, _ in points],
            [i.estimate for _, i in points],
            [i.low for _, i in points],
            [i.high for _, i in points],
        )
        for name, points in found.items()
    ]


def _groups(results: Sequence[Result], limit: float) -> dict[str, dict[int, Result]]:
    found: dict[str, dict[int, Result]] = {}
    for result in results:
        if result.limit == limit:
            found.setdefault(result.name, {})[result.seed] = result
    return found


def _worst(means: Tensor) -> Tensor:
    return means.amin(dim=-1)


def _worst_of(by_seed: dict[int, Result], judge: str) -> float:
    scores = torch.stack([r.scores[judge] for r in by_seed.values()])
    return float(_worst(scores.mean(1)).mean())


def _gain(by_seed: dict[int, Result], against: dict[int, Result], judge: str) -> Interval:
    seeds = sorted(by_seed.keys() & against.keys())
    ours, theirs = (
        torch.stack([group[seed].scores[judge] for seed in seeds]) for group in (by_seed, against)
    )
    return gain_interval(ours, theirs, _worst, torch.Generator().manual_seed(0))
