"""A table of two optimizers over all co-designs, with their wins and the median gain."""

import statistics
from collections.abc import Mapping, Sequence

import torch

OPTIMIZERS = ("adam", "least squares")
_RESAMPLED = 10000


def gains(runs: Sequence[Mapping[str, object]]) -> dict[str, list[float]]:
    """Return what least squares win over Adam, dB, by co-design: a number for each seed."""
    scores = {(str(r["case"]), str(r["optimizer"]), str(r["seed"])): r["score"] for r in runs}
    found: dict[str, list[float]] = {}
    for (case, optimizer, seed), score in scores.items():
        other = scores.get((case, OPTIMIZERS[0], seed))
        if optimizer == OPTIMIZERS[1] and other is not None:
            found.setdefault(case, []).append(float(str(score)) - float(str(other)))
    return found


def table(runs: Sequence[Mapping[str, object]]) -> list[str]:
    """Return lines of Markdown: scores by co-design, gains, and their sum at the end."""
    lines = [
        "| co-design | Adam, dB | least squares, dB | gain by seed, dB | steps | seconds |",
        "|---|---|---|---|---|---|",
    ]
    by_case = gains(runs)
    for case, found in by_case.items():
        of_case = [r for r in runs if r["case"] == case]
        means = {
            key: [
                statistics.fmean(float(str(r[key])) for r in of_case if r["optimizer"] == optimizer)
                for optimizer in OPTIMIZERS
            ]
            for key in ("score", "steps", "seconds")
        }
        lines.append(
            f"| {case} | {means['score'][0]:.2f} | {means['score'][1]:.2f} | "
            f"{', '.join(f'{g:+.2f}' for g in found)} | "
            f"{means['steps'][0]:.0f}, {means['steps'][1]:.0f} | "
            f"{means['seconds'][0]:.1f}, {means['seconds'][1]:.1f} |"
        )
    return [*lines, "", summary(by_case)]


def summary(by_case: Mapping[str, Sequence[float]]) -> str:
    """Return wins and the median gain, with an interval over co-designs and their seeds."""
    every = [g for found in by_case.values() for g in found]
    generator = torch.Generator().manual_seed(0)
    values = [torch.tensor(list(found)) for found in by_case.values()]
    medians = []
    for _ in range(_RESAMPLED):
        cases = torch.randint(len(values), (len(values),), generator=generator).tolist()
        drawn = []
        for case in cases:
            count = len(values[case])
            drawn.append(values[case][torch.randint(count, (count,), generator=generator)])
        medians.append(torch.cat(drawn).median())
    low, high = torch.stack(medians).quantile(torch.tensor([0.025, 0.975])).tolist()
    return (
        f"Least squares win {sum(g > 0.0 for g in every)} of {len(every)}, median "
        f"{statistics.median(every):+.2f} dB [{low:+.2f}, {high:+.2f}] over co-designs and seeds."
    )


def against(runs: Sequence[Mapping[str, object]], theirs: str) -> list[str]:
    """Return lines of Markdown: every method's mean score by co-design, and what the best of the
    others wins over one by seed.

    Only co-designs and seeds that every method has are counted.

    Args:
        runs: with `case`, `optimizer`, `seed`, `score` and `seconds`.
        theirs: the method that the others are compared with.
    """
    scores = {(str(r["case"]), str(r["seed"]), str(r["optimizer"])): r for r in runs}
    methods = list(dict.fromkeys(sorted(key[2] for key in scores)))
    ours = [method for method in methods if method != theirs]
    whole = [
        key
        for key in dict.fromkeys(key[:2] for key in scores)
        if all((*key, method) in scores for method in methods)
    ]

    def score(key: tuple[str, str], method: str) -> float:
        return float(str(scores[(*key, method)]["score"]))

    lines = [
        f"| co-design | {theirs}, dB | {', dB | '.join(ours)}, dB | best of ours, by seed, dB |",
        "|" + "---|" * (len(methods) + 2),
    ]
    won: list[float] = []
    for case in dict.fromkeys(case for case, _ in whole):
        keys = [key for key in whole if key[0] == case]
        found = [max(score(key, m) for m in ours) - score(key, theirs) for key in keys]
        won += found
        means = [statistics.fmean(score(key, m) for key in keys) for m in (theirs, *ours)]
        lines.append(
            f"| {case} | {' | '.join(f'{m:.2f}' for m in means)} | "
            f"{', '.join(f'{g:+.2f}' for g in found)} |"
        )
    singles = []
    for method in ours:
        gained = [score(key, method) - score(key, theirs) for key in whole]
        singles.append(f"{method} {sum(g >= 0.0 for g in gained)}")
    return [
        *lines,
        "",
        f"The best of ours is at least as good in {sum(g >= 0.0 for g in won)} of {len(won)}, by "
        f"{statistics.median(won):+.2f} dB in the median; each alone: {', '.join(singles)}.",
    ]
