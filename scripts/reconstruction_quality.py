"""Compare networks behind one fixed lens: image quality against seconds of training.

    python scripts/reconstruction_quality.py images --folder outputs/reconstruction
    python scripts/reconstruction_quality.py train --folder outputs/reconstruction --seconds 20 70
    python scripts/reconstruction_quality.py show --folder outputs/reconstruction --figure FILE.png

Images are made once; then every network trains for the same process time of one thread, so that
other programs on the machine do not count.
"""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.experiments.camera.photograph_scores import format_interval
from dolens.plotting import save_figure
from dolens.plotting.runs import Curve, quality_figure
from dolens.reconstruction import Restoration
from dolens.reconstruction.quality import Interval, bootstrap_interval, gain_interval
from scripts.fixed_optics import (
    FixedOptics,
    TrainedFor,
    composed_network,
    fixed_optics,
    known_depth,
    scores,
    train_for,
)

# The lens that `experiment=wavefront_coding` learns with its default seed, before this comparison.
LENS = (
    "variables={sensor_distance: {initial: 95.8045}, surfaces.5.x3: {initial: 8.788e-6}, "
    "surfaces.5.x2y: {initial: 5.430e-6}, surfaces.5.xy2: {initial: 3.936e-6}, "
    "surfaces.5.y3: {initial: 8.345e-6}}"
)
EXPERIMENT = (
    "experiment=wavefront_coding",
    "renderer=psf_narrow",
    "loss.perceptual=none",
    "miscalibrations=none",
    "reference_renderers=none",
    "data.steps_per_epoch=300",
    LENS,
)
PACKAGES = ("data=package_photographs", "data.evaluation_crops_per_photograph=1")
NETWORKS: dict[str, tuple[str, ...]] = {
    "unet": ("network=unet",),
    "nafnet": ("network=nafnet",),
    "wiener_unet": ("network=wiener_unet",),
    "wiener_nafnet": ("network=wiener_nafnet",),
    "unrolled_splitting": ("network=unrolled_splitting",),
    "feature_wiener": ("network=feature_wiener",),
    "feature_wiener, features": (
        "network=feature_wiener",
        "network.features=4",
        "network.scales=2",
    ),
    "feature_wiener, depths": ("network=feature_wiener", "network.depths=3"),
    "feature_wiener, width 24": ("network=feature_wiener", "network.width=24"),
    "wiener_tv": ("network=wiener_tv",),
    "wiener_bm3d": ("network=wiener_bm3d",),
}
ORACLE = "feature_wiener, depth known"
BASELINE = "wiener_unet"


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


def images(folder: Path, package_folders: Sequence[str]) -> dict[str, FixedOptics]:
    """Return the lens's images of the default's photographs, and of 42 others if they are there."""
    found = {"photos": fixed_optics(folder / "photos.pt", EXPERIMENT)}
    file = folder / "packages.pt"
    if package_folders or file.is_file():
        folders = [f"data.folders=[{','.join(package_folders)}]"] if package_folders else []
        found["packages"] = fixed_optics(file, [*EXPERIMENT, *PACKAGES, *folders], training=False)
    return found


def maker(name: str) -> Callable[[], Restoration]:
    """Return what makes the network of a name in `NETWORKS`, or the oracle."""
    if name == ORACLE:
        return known_depth
    return partial(composed_network, [*EXPERIMENT, *NETWORKS[name]])


def train(
    folder: Path, names: Sequence[str], seconds: Sequence[float], seeds: Sequence[int]
) -> None:
    """Train and judge what has no file yet; a line each."""
    optics = images(folder, [])
    for seed in seeds:
        for name in names:
            for limit in seconds:
                file = folder / f"{name.replace(', ', '_').replace(' ', '_')}_{limit:g}_{seed}.json"
                if file.is_file():
                    continue
                done = train_for(maker(name), optics["photos"], limit, seed)
                result = _judged(name, seed, limit, done, optics)
                write(result, file)
                worst = {k: f"{v.mean(0).min():.2f}" for k, v in result.scores.items()}
                print(f"{name}, seed {seed}: {done.steps} steps, {done.seconds:.0f} s, {worst}")


def _judged(
    name: str, seed: int, limit: float, done: TrainedFor, optics: dict[str, FixedOptics]
) -> Result:
    found = {
        "validation": scores(done.network, optics["photos"], "validation"),
        "test": scores(done.network, optics["photos"], "test"),
    }
    if "packages" in optics:
        found["packages"] = scores(done.network, optics["packages"], "test")
    parameters = sum(p.numel() for p in done.network.parameters())
    return Result(name, seed, limit, done.seconds, done.steps, parameters, found)


def main(arguments: Sequence[str]) -> int:
    """Make images, train, or show a table and a figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    making = commands.add_parser("images", help="the lens's images of photographs")
    making.add_argument("--package-folders", nargs="*", default=[], help="of data.folders")
    training = commands.add_parser("train", help="train networks")
    usual = [name for name in NETWORKS if name != "wiener_bm3d"]  # whose package is not for all
    training.add_argument("--networks", nargs="+", default=usual, choices=[*NETWORKS, ORACLE])
    training.add_argument("--seconds", nargs="+", type=float, default=[20.0, 70.0])
    training.add_argument("--seeds", nargs="+", type=int, default=[0])
    show = commands.add_parser("show", help="a table, and a figure")
    show.add_argument("--figure", type=Path)
    for part in (making, training, show):
        part.add_argument("--folder", type=Path, default=Path("outputs/reconstruction"))
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    try:
        if given.command == "images":
            images(given.folder, given.package_folders)
        elif given.command == "train":
            train(given.folder, given.networks, given.seconds, given.seeds)
        else:
            found = read(given.folder)
            print("\n".join(table(found, BASELINE)))
            if given.figure:
                save_figure(quality_figure(curves(found)), given.figure)
    except InputError as problem:
        parser.error(str(problem))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
