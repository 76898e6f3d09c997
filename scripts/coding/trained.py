"""Gains of trained cameras over the best plain lens, from run folders."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dolens.errors import InputError
from dolens.experiments.comparison.gains import gain
from dolens.experiments.comparison.run import Run, read_run
from dolens.reconstruction.intervals import Interval

CODED = "wavefront_coding"
PLAIN = ("wavefront_coding_refocused", "wavefront_coding_stopped_down")
_FULL = 6.35  # mm, semi-diameter of the stop

Seeds = dict[int, Run]


@dataclass(frozen=True)
class TrainedGain:
    """A condition, and what coding gains in it.

    Attributes:
        light: electrons of a white pixel at full aperture.
        depths: mm.
        stops: semi-diameter (mm) of each plain lens tried → its mean score on validation.
        chosen: the semi-diameter that is best on validation.
        coded: mean test score of the coded camera over the seeds that both have.
        plain: that of the chosen plain one.
        interval: of the gain, paired over seeds and photographs.
    """

    light: float
    depths: tuple[float, ...]
    stops: Mapping[float, float]
    chosen: float
    coded: float
    plain: float
    interval: Interval


def trained_gains(
    folders: Sequence[Path], judge: str | None, view: str = "worst", metric: str = "psnr_db"
) -> list[TrainedGain]:
    """Gains of all conditions that have coded and plain runs; see `TrainedGain`.

    Args:
        folders: of finished runs; those of other experiments are passed over.
        judge: whose scores choose on validation and count in the test; None: `val` and `test`.
        view: a depth, or `worst`.
        metric: of the test.

    Raises:
        InputError: a folder is none of a run, or the validation has no such metric.
    """
    conditions: dict[tuple, dict[str | float, Seeds]] = {}
    for folder in folders:
        run = read_run(folder, judge)
        if run.experiment != CODED and run.experiment not in PLAIN:
            continue
        light = float(json.loads(run.config["light"]))
        depths = tuple(json.loads(run.config["scene.depths"]))
        stop = float(json.loads(run.config.get("stop_semi_diameter", str(_FULL))))
        camera = CODED if run.experiment == CODED else stop
        conditions.setdefault((light, depths), {}).setdefault(camera, {})[run.seed] = run
    found = []
    for (light, depths), cameras in sorted(conditions.items()):
        coded = cameras.pop(CODED, {})
        plain = {stop: seeds for stop, seeds in cameras.items() if seeds.keys() & coded.keys()}
        if not plain:
            continue
        key = f"val_{judge}/{metric}/{view}" if judge else f"val/{metric}/{view}"
        stops = {stop: _mean(seeds.values(), key) for stop, seeds in sorted(plain.items())}
        chosen = max(stops, key=stops.__getitem__)
        interval = gain(coded, plain[chosen], metric, view)
        both = sorted(coded.keys() & plain[chosen].keys())
        test = f"test/{metric}/{view}"
        found.append(
            TrainedGain(
                light,
                depths,
                stops,
                chosen,
                _mean([coded[seed] for seed in both], test),
                _mean([plain[chosen][seed] for seed in both], test),
                interval,
            )
        )
    return found


def _mean(runs: Iterable[Run], key: str) -> float:
    values = []
    for run in runs:
        if key not in run.metrics:
            raise InputError(f"{run.folder}: metrics.json has no {key}")
        values.append(run.metrics[key])
    return sum(values) / len(values)
