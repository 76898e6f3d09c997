"""Measure the gain of wavefront coding over the best plain lens, against light and depth range.

    python scripts/coding_gain.py bound                # by linear filters: seconds, no training
    python scripts/coding_gain.py train                # trains coded and plain cameras: hours
    python scripts/coding_gain.py show outputs/coding_gain/*/* --figure coding_gain.png

The plain lens is the same one without its plate, refocused, and stopped down as far as is best on
validation at equal exposure time; the coded one has learned plate and focus at full aperture.
"""

import argparse
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dolens.errors import InputError
from dolens.experiments.camera.photograph_scores import format_interval
from dolens.plotting import save_figure
from dolens.plotting.coding_gain import GainRange, coding_gain_figure
from scripts.coding.bound import BoundGain, bound_gains
from scripts.coding.trained import TrainedGain, trained_gains
from scripts.finished_runs import train_unless_finished

DEPTHS = {
    "4.5 to 8 m": (8000.0, 6000.0, 4500.0),
    "3 m to 116 m": (116000.0, 5760.0, 2953.0),
}
LIGHTS = (30.0, 100.0, 300.0, 1000.0, 3000.0, 8000.0)
# Semi-diameters of the stop, mm: F/8 to F/22 in whole stops.
STOPS = (6.35, 4.5, 3.18, 2.25)
_READ_NOISE = 3.0  # electrons, as conf/readout/electrons.yaml has it


def bounds(lights: Sequence[float]) -> dict[str, list[BoundGain]]:
    """Gains by linear filters, by depth range."""
    return {name: bound_gains(depths, lights, _READ_NOISE) for name, depths in DEPTHS.items()}


def bound_table(found: Mapping[str, Sequence[BoundGain]]) -> list[str]:
    """Lines of Markdown."""
    lines = [
        "| depths | electrons | one filter | a filter each | best plain | best plate, mm⁻² |",
        "|---|---|---|---|---|---|",
    ]
    for name, gains in found.items():
        lines += [
            f"| {name} | {g.light:g} | {g.common_filter:+.2f} | {g.filter_per_depth:+.2f} "
            f"| F/{g.plain_f_number:.1f} | {g.plate:.1e} |"
            for g in gains
        ]
    return lines


def trained_table(found: Sequence[TrainedGain]) -> list[str]:
    """Lines of Markdown."""
    lines = [
        "| depths (m) | electrons | validation by semi-diameter | coded | plain | gain | seeds "
        "| photographs |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for g in found:
        stops = ", ".join(
            f"{'**' if s == g.chosen else ''}{s:g} mm {v:.2f}{'**' if s == g.chosen else ''}"
            for s, v in g.stops.items()
        )
        depths = ", ".join(f"{depth / 1000.0:g}" for depth in g.depths)
        lines.append(
            f"| {depths} | {g.light:g} | {stops} | {g.coded:.2f} | {g.plain:.2f} "
            f"| {format_interval(g.interval, 2)} | {g.interval.seeds} | {g.interval.photographs} |"
        )
    return lines


def figure_of(
    found: Mapping[str, Sequence[BoundGain]], trained: Sequence[TrainedGain], path: Path
) -> None:
    """Write the figure: bounds as lines, trained cameras as points."""
    ranges = []
    for name, gains in found.items():
        points = [
            (g.light, g.interval.estimate, g.interval.low, g.interval.high)
            for g in trained
            if g.depths == DEPTHS[name]
        ]
        ranges.append(
            GainRange(
                name,
                [g.light for g in gains],
                [g.common_filter for g in gains],
                [g.filter_per_depth for g in gains],
                points,
            )
        )
    title = "Gain over the best plain lens"
    if trained:
        title += f"; bars: 95 % intervals over {_range_of(g.interval.photographs for g in trained)}"
        title += f" photographs, seeds: {_range_of(g.interval.seeds for g in trained)}"
    save_figure(coding_gain_figure(ranges, title), path)


def _range_of(counts: Iterable[int]) -> str:
    """Return `42`, or `1 to 5` of counts that differ."""
    found = sorted(set(counts))
    return f"{found[0]}" if len(found) == 1 else f"{found[0]} to {found[-1]}"


def train(folder: Path, lights: Sequence[float], seeds: int, others: Sequence[str]) -> None:
    """Train every camera of every condition one after another; finished ones are left."""
    for name, depths in DEPTHS.items():
        for light in lights:
            cameras = {"coded": ["experiment=wavefront_coding"]}
            for stop in STOPS:
                cameras[f"plain_{stop:g}"] = [
                    "experiment=wavefront_coding_stopped_down",
                    f"stop_semi_diameter={stop}",
                ]
            for camera, overrides in cameras.items():
                for seed in range(seeds):
                    run = folder / f"{name.replace(' ', '_')}_{light:g}" / f"{camera}_seed{seed}"
                    own = [
                        *overrides,
                        f"light={light:g}",
                        f"scene.depths={list(depths)}",
                        f"seed={seed}",
                    ]
                    train_unless_finished(run, [*own, *others])


def main(arguments: Sequence[str]) -> int:
    """Print tables, write the figure, or train."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    bound = commands.add_parser("bound", help="gains by linear filters")
    show = commands.add_parser("show", help="gains of run folders beside them")
    show.add_argument("folders", nargs="+", type=Path)
    show.add_argument("--judge", default="wave", help="whose scores count; '' for rays")
    training = commands.add_parser("train", help="train coded and plain cameras")
    training.add_argument("--folder", type=Path, default=Path("outputs/coding_gain"))
    training.add_argument("--seeds", type=int, default=1)
    training.add_argument("overrides", nargs="*", help="of train.py, as data=package_photographs")
    for part in (bound, show, training):
        part.add_argument("--lights", nargs="+", type=float, default=LIGHTS, help="electrons")
    for part in (bound, show):
        part.add_argument("--figure", type=Path)
    given = parser.parse_args(arguments)
    try:
        if given.command == "train":
            train(given.folder, given.lights, given.seeds, given.overrides)
            return 0
        trained: list[TrainedGain] = []
        if given.command == "show":
            trained = trained_gains(given.folders, given.judge or None)
            print("\n".join([*trained_table(trained), ""]))
        found = bounds(given.lights)
        print("\n".join(bound_table(found)))
        if given.figure:
            figure_of(found, trained, given.figure)
    except InputError as problem:
        parser.error(str(problem))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
