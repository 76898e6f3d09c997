"""What the parts of a search contribute: each is left out in turn, at equal processor time.

    python scripts/search_parts.py --seconds 60 --seeds 2

The task is that of experiment=search_quartet; one thread.  A row is a search without one part, and
each figure the median over the seeds with its range: lenses that keep the specification, the best
mean RMS spot (µm), different forms within 25 % of the best of the whole table, and below 8.5 µm.
"""

import argparse
import statistics
import time
from collections.abc import Iterator
from dataclasses import replace

import torch

from dolens.lens_search.growth import STAGES, Stage
from dolens.lens_search.search import SearchPlan, Step, search, with_step
from dolens.lens_search.specification import Limits, Specification
from dolens.tasks import in_turn

QUARTET = Specification(
    focal_length=100.0,
    f_number=3.0,
    fields=(0.0, 10.5, 15.0),
    wavelengths=(587.5618,),
    groups=(1, 1, 1, 1),
    glasses=("1.5168/64.17",),
    limits=Limits(glass=(2.0, 120.0), glass_edge=0.5, back_focus=30.0, track=250.0),
)
MANY = 1_000_000
# Batches small enough that a minute has a dozen of them.
WHOLE = SearchPlan(starts=MANY, batch=500, escapes=0)


def variants() -> dict[str, SearchPlan]:
    """Return the plans by what they lack."""
    every = tuple(replace(stage, kept=1.0) for stage in STAGES)
    return {
        "the whole, random starts only": WHOLE,
        "without growth: f/3 and 15° at once": replace(
            WHOLE, stages=(Stage(iterations=90, kept=0.25),)
        ),
        "without halving": replace(WHOLE, stages=every, finished=1.0),
        "without a choice of starts": replace(WHOLE, drawn=1),
        "2500 starts, then escapes": replace(WHOLE, escapes=MANY, starts=2500),
    }


def limited(steps: Iterator[Step], seconds: float) -> Iterator[Step]:
    """Yield steps until the processor time is used up."""
    started = time.process_time()
    for step in steps:
        yield step
        if time.process_time() - started > seconds:
            return


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="of processor time, each")
    parser.add_argument("--seeds", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    found: dict[str, list[tuple[int, list[float]]]] = {}
    for name, plan in variants().items():
        for seed in range(arguments.seeds):
            own, pool, count = replace(plan, seed=seed), {}, 0
            for step in limited(search(QUARTET, own, in_turn), arguments.seconds):
                pool = with_step(pool, step, QUARTET, own)
                count += sum(len(designs.values) for designs in step.designs)
            merits = [1e3 * float(m) for designs in pool.values() for m in designs.merit]
            found.setdefault(name, []).append((count, sorted(merits)))
    best = min(merits[0] for runs in found.values() for _, merits in runs if merits)
    print("| search | lenses | best, µm | forms within 25 % of the best of all | below 8.5 µm |")
    print("|---|---|---|---|---|")
    for name, runs in found.items():
        cells = (
            [count for count, _ in runs],
            [merits[0] for _, merits in runs],
            [sum(m <= 1.25 * best for m in merits) for _, merits in runs],
            [sum(m <= 8.5 for m in merits) for _, merits in runs],
        )
        words = [f"{statistics.median(c):.4g} [{min(c):.4g}, {max(c):.4g}]" for c in cells]
        print(f"| {name} | {' | '.join(words)} |")


if __name__ == "__main__":
    main()
