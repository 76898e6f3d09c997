"""What the parts of a search contribute: each is left out in turn, at equal processor time.

    python scripts/search_parts.py search_quartet --seconds 60 --seeds 3

The task and its plan are those of an experiment; one thread.  A row is a search without one part,
and each figure the median over the seeds with its range: lenses that are optimised to the end, the
best mean RMS spot (µm) of those that keep the specification, and different forms within 25 % and
within twice the best of the whole table.
"""

import argparse
import math
import statistics
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf

from dolens.lens_search.search import SearchPlan, Step, search, with_step
from dolens.lens_search.specification import Specification
from dolens.tasks import in_turn

MANY = 1_000_000
CONF = Path(__file__).resolve().parents[1] / "conf"


def task(experiment: str) -> tuple[Specification, SearchPlan]:
    """Return the specification and the plan of an experiment."""
    with initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        settings = compose("train", overrides=[f"experiment={experiment}"])
    settings = OmegaConf.to_container(settings, resolve=False)
    wanted = {name: settings[name] for name in ("seed", "specification", "plan")}
    made = instantiate(wanted, _convert_="all")
    return made["specification"], made["plan"]


def variants(plan: SearchPlan, batch: int, starts: int) -> dict[str, SearchPlan]:
    """Return the plans by what they lack.

    Args:
        plan: of the experiment.
        batch: starts of one task, few enough that the time has a dozen of them.
        starts: before the escapes.
    """
    stages = tuple(plan.stages)
    whole = replace(plan, starts=MANY, batch=batch, escapes=0)
    every = tuple(replace(stage, kept=1.0) for stage in stages)
    share = 1.0
    for stage in stages:
        share *= stage.kept
    iterations = sum(stage.iterations for stage in stages)
    at_once = (replace(stages[-1], iterations=iterations, kept=share),)
    return {
        "the whole, random starts only": whole,
        "without growth: the full aperture and field at once": replace(whole, stages=at_once),
        "without halving": replace(whole, stages=every, finished=1.0),
        "without a choice of starts": replace(whole, drawn=1),
        f"{starts} starts, then escapes": replace(whole, escapes=MANY, starts=starts),
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
    parser.add_argument("experiment", nargs="?", default="search_quartet")
    parser.add_argument("--batch", type=int, default=500, help="starts of one task")
    parser.add_argument("--starts", type=int, default=2500, help="before escapes")
    parser.add_argument("--seconds", type=float, default=60.0, help="of processor time, each")
    parser.add_argument("--seeds", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    found: dict[str, list[tuple[int, list[float]]]] = {}
    specification, every = task(arguments.experiment)
    for name, plan in variants(every, arguments.batch, arguments.starts).items():
        for seed in range(arguments.seeds):
            own, pool, count = replace(plan, seed=seed), {}, 0
            for step in limited(search(specification, own, in_turn), arguments.seconds):
                pool = with_step(pool, step, specification, own)
                count += sum(len(designs.values) for designs in step.designs)
            merits = [1e3 * float(m) for designs in pool.values() for m in designs.merit]
            found.setdefault(name, []).append((count, sorted(merits)))
    best = min(merits[0] for runs in found.values() for _, merits in runs if merits)
    print("| search | lenses | best, µm | forms within 25 % of the best of all | within twice |")
    print("|---|---|---|---|---|")
    for name, runs in found.items():
        cells = (
            [count for count, _ in runs],
            [merits[0] if merits else math.inf for _, merits in runs],
            [sum(m <= 1.25 * best for m in merits) for _, merits in runs],
            [sum(m <= 2.0 * best for m in merits) for _, merits in runs],
        )
        words = [f"{statistics.median(c):.4g} [{min(c):.4g}, {max(c):.4g}]" for c in cells]
        print(f"| {name} | {' | '.join(words)} |")


if __name__ == "__main__":
    main()
