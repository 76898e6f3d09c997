"""Random lenses against what holds of every ray: a table of what breaks it, with seeds.

python scripts/fuzz_lenses.py --lenses 2000 --rays 2000
python scripts/fuzz_lenses.py --any --lenses 2000 --rays 2500     # 1e7 rays, value and gradient

With --any, prescriptions have all that they can hold (phases, mirrors, breaks, ...), some rays have
numbers that no light has, and values and gradients of the backends are compared as well.
"""

import argparse
import math
import sys
import time
from collections import Counter, defaultdict
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.optics.random_lenses import KINDS, SAG_KINDS
from tests.optics.ray_agreement import any_cases, disagreements
from tests.optics.ray_facts import PRECISIONS, cases, violations


def main() -> int:
    """Print the table; the exit status is 1 where anything is broken."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lenses", type=int, default=200, help="half of them wild")
    parser.add_argument("--rays", type=int, default=1000, help="of each lens, from either side")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop after so many")
    parser.add_argument(
        "--sags", action="store_true", help="odd aspheres, biconics, toroids, Zernike, ... instead"
    )
    parser.add_argument("--any", action="store_true", help="all that a prescription can hold")
    options = parser.parse_args()
    kinds = SAG_KINDS if options.sags else KINDS
    end, done = time.monotonic() + 60.0 * options.minutes, 0
    rays, lenses, seeds, drawn_rays = Counter(), defaultdict(set), defaultdict(dict), 0
    for number in range(options.first, options.first + options.lenses):
        if time.monotonic() > end:
            break
        done += 1
        seed, wild = divmod(number, 2)
        # The reference's take their time, with a column for every coefficient of a spline.
        jacobians = ("reference", "cpu") if seed % 100 == 0 else ("cpu",)
        drawn = (
            any_cases(seed, bool(wild), options.rays)
            if options.any
            else cases(seed, bool(wild), options.rays, kinds)
        )
        for way, lens, bundle, sense in drawn:
            drawn_rays += len(bundle.position)
            for dtype in PRECISIONS:
                found = violations(lens, bundle, sense, dtype, jacobians)
                if options.any:
                    found += disagreements(lens, bundle, sense, dtype)
                for rule, count in found.items():
                    place = (
                        rule,
                        str(dtype).removeprefix("torch."),
                        "wild" if wild else "ordinary",
                    )
                    rays[place] += count
                    lenses[place].add(number)
                    seeds[place].setdefault(number, f"{number} {way}")
    print(f"{done} lenses, {drawn_rays:.2e} rays, each by two backends in two precisions")
    print(f"{'rule':45s} {'precision':9s} {'numbers':9s} {'lenses':>6s} {'rays':>7s}  seeds")
    for place in sorted(rays):
        first = ", ".join(list(seeds[place].values())[:5])
        print(f"{place[0]:45s} {place[1]:9s} {place[2]:9s} {len(lenses[place]):6d} "
              f"{rays[place]:7d}  {first}")  # fmt: skip
    return int(any("within rounding" not in place[0] for place in rays))


if __name__ == "__main__":
    torch.set_num_threads(1)
    sys.exit(main())
