"""Compare cameras that were judged as built: tolerances against the PSNR of the worst tenth.

    python scripts/as_built_front.py --arm "as drawn" RUN RUN --arm "as built" RUN RUN \
        --figure front.png --title "A telephone's camera"

A run is the folder of a camera with `as_built.judged_factors`; the runs of an arm are its seeds,
in the same order for all arms.  The first arm is what the others are compared with.  For each
factor a row gives, as means over seeds: the lens as drawn; the mean of the lenses made; their worst
tenth, with an interval of 95 % over lenses and seeds for these crops; and what the arm wins there,
with an interval over lenses, photographs and seeds, all paired.  Then, for each factor, at how wide
tolerances the first arm has the same worst tenth.
"""

import argparse
import csv
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from dolens.experiments.camera.made_lenses import worst_decile
from dolens.plotting import save_figure
from dolens.plotting.tolerances import made_front_figure

_RESAMPLES, _ENDS = 2000, (0.025, 0.975)


@dataclass(frozen=True)
class Judged:
    """PSNR of lenses that were made, dB, by factor.

    Attributes:
        by_factor: factor → (S, N, B, V): seeds, lenses, crops, views.
        photograph: (B,), number of the photograph of each crop.
        drawn: mean over seeds of the worst view of the lens as drawn.
    """

    by_factor: dict[float, Tensor]
    photograph: Tensor
    drawn: float


def judged(folders: Sequence[Path]) -> Judged:
    """Read runs of one camera, which differ by their seeds."""
    tables: dict[float, list[Tensor]] = {}
    drawn: list[float] = []
    names: list[str] = []
    for folder in folders:
        with (folder / "made_crops.csv").open() as file:
            rows = list(csv.DictReader(file))
        views = [name for name in rows[0] if name.startswith("psnr_db/")]
        for factor in dict.fromkeys(row["factor"] for row in rows):
            own = [row for row in rows if row["factor"] == factor]
            names = [row["photograph"] for row in own if row["lens"] == "0"]
            values = torch.tensor([[float(row[v]) for v in views] for row in own]).double()
            tables.setdefault(float(factor), []).append(values.unflatten(0, (-1, len(names))))
        metrics = json.loads((folder / "metrics.json").read_text())
        drawn.append(metrics["made/psnr_db/as_drawn"])
    known = list(dict.fromkeys(names))
    photograph = torch.tensor([known.index(name) for name in names])
    stacked = {factor: torch.stack(found) for factor, found in tables.items()}
    return Judged(stacked, photograph, sum(drawn) / len(drawn))


def worst_view(scores: Tensor) -> Tensor:
    """Return the PSNR of the worst view of each lens, (S, N), from (S, N, B, V)."""
    return scores.mean(2).amin(2)


def worst_tenth(scores: Tensor) -> Tensor:
    """Return the mean over seeds of the worst tenth, (), from (S, N, B, V)."""
    return worst_decile(worst_view(scores)).mean()


def resampled(arms: Sequence[Tensor], photograph: Tensor | None) -> Tensor:
    """Return the worst tenths of arms, (resamples, arms), over lenses, seeds and photographs.

    All arms are drawn alike: they share lenses, photographs and seeds.

    Args:
        arms: (S, N, B, V) of each.
        photograph: number of the photograph of each crop; None: the crops stay the same.
    """
    generator = torch.Generator().manual_seed(0)
    seeds, lenses, b = arms[0].shape[0], arms[0].shape[1], torch.arange(arms[0].shape[2])
    count = 0 if photograph is None else int(photograph.max()) + 1
    crops = [torch.nonzero(photograph == p)[:, 0] for p in range(count)]
    found = []
    for _ in range(_RESAMPLES):
        s = torch.randint(seeds, (seeds,), generator=generator)
        n = torch.randint(lenses, (lenses,), generator=generator)
        if crops:
            p = torch.randint(count, (count,), generator=generator).tolist()
            b = torch.cat([crops[number] for number in p])
        found.append(torch.stack([worst_tenth(arm[s][:, n][:, :, b]) for arm in arms]))
    return torch.stack(found)


def ends(values: Tensor) -> tuple[float, float]:
    """Return the ends of the interval of 95 %."""
    low, high = values.quantile(torch.tensor(_ENDS).double()).tolist()
    return low, high


def factor_at(curve: dict[float, float], wanted: float) -> float:
    """Return the factor at which a falling curve has a PSNR, linear between its points' logarithms.

    Beyond the last point: NaN.
    """
    factors = sorted(curve)
    for low, high in pairwise(factors):
        if curve[low] >= wanted >= curve[high]:
            share = (curve[low] - wanted) / (curve[low] - curve[high])
            return math.exp(math.log(low) + share * math.log(high / low))
    return math.nan


def main() -> None:
    """Print the table, and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arm", action="append", nargs="+", required=True)
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--title", default="Cameras as built")
    given = parser.parse_args()
    arms = {name: judged([Path(f) for f in folders]) for name, *folders in given.arm}
    reference = next(iter(arms))
    curves: dict[str, dict[float, tuple[float, float, float]]] = {name: {} for name in arms}
    print("| factor | trained | as drawn | mean | worst tenth | wins |\n|---|---|---|---|---|---|")
    for factor in sorted(arms[reference].by_factor):
        scores = [arm.by_factor[factor] for arm in arms.values()]
        alone, drawn = resampled(scores, None), resampled(scores, arms[reference].photograph)
        for number, (name, arm) in enumerate(arms.items()):
            middle, (low, high) = float(worst_tenth(scores[number])), ends(alone[:, number])
            curves[name][factor] = (middle, low, high)
            wins = ""
            if number:
                gain = middle - curves[reference][factor][0]
                of_gain = ends(drawn[:, number] - drawn[:, 0])
                wins = f"{gain:+.2f} [{of_gain[0]:+.2f}, {of_gain[1]:+.2f}]"
            mean = float(worst_view(scores[number]).mean())
            print(
                f"| {factor:g} | {name} | {arm.drawn:.2f} | {mean:.2f} "
                f"| {middle:.2f} [{low:.2f}, {high:.2f}] | {wins} |"
            )
    known = {factor: point[0] for factor, point in curves[reference].items()}
    for name in list(arms)[1:]:
        for factor, (middle, _, _) in curves[name].items():
            same = factor_at(known, middle)
            if not math.isnan(same):
                print(f"{name} at {factor:g} is '{reference}' at {same:.2f}: {factor / same:.2f}×")
    if given.figure is not None:
        figure = made_front_figure(
            curves, {name: arm.drawn for name, arm in arms.items()}, given.title
        )
        save_figure(figure, given.figure)


if __name__ == "__main__":
    main()
