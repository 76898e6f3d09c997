"""Check and redesign lenses of Côté, Tseng and Heide's EISOPTX, from a folder of its design files.

    python scripts/designs_of_others.py check --folder CONFIGS
    python scripts/designs_of_others.py redesign --folder CONFIGS --out outputs/designs --seconds 10
    python scripts/designs_of_others.py show --out outputs/designs

CONFIGS has */defaults.yml and */designs/*.yml; nothing of it comes with dolens.  `check` prints
what is asked for beside what dolens's rays find, and why a design cannot be represented.
`redesign` takes each design that was made for spots to better ones, for so much process time of one
thread: from where it was published, and from a start beside it, there by dolens's least squares and
by the authors' rule of damping, under the same limits.  What `--out` has is not made again.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dolens.errors import InputError
from scripts.designs.files import design_files, read_design
from scripts.designs.lenses import lens_of, measures
from scripts.designs.redesign import least_squares, redesigned, start_of, their_rule
from scripts.designs.tables import WAYS, check_row, check_table, redesign_table


def check(folder: Path) -> list[str]:
    """Return a table of all designs, with a line for each that cannot be represented."""
    rows, refused = [], []
    for path in design_files(folder):
        try:
            design = read_design(path)
            rows.append(check_row(design, measures(lens_of(design), design)))
        except InputError as error:
            refused.append(f"- {error}")
    return [*check_table(rows), *(["", "Not represented:", *refused] if refused else [])]


def redesign(
    folder: Path, out: Path, seconds: float, chosen: Sequence[str], ways: Sequence[str]
) -> None:
    """Make every design that was made for spots again, and write what was found of each."""
    out.mkdir(parents=True, exist_ok=True)
    for path in design_files(folder):
        name = f"{path.parent.parent.name}/{path.stem}"
        file = out / f"{name.replace('/', '_')}.json"
        found = json.loads(file.read_text()) if file.is_file() else {"name": name}
        left = [way for way in ways if way not in found]
        if not left or (chosen and name not in chosen):
            continue
        try:
            design = read_design(path)
            if not design.is_spot_design:
                continue
            lens = lens_of(design)
            published = measures(lens, design)
            found["published"] = published.mean
            for way in left:
                begun, method = lens, least_squares
                if way != "from_published":
                    begun, found["away"] = start_of(design, published)
                    found["start"] = measures(begun, design).mean
                if way == "their_rule":
                    method = partial(their_rule, settings=design.damping)
                result = redesigned(begun, design, published, seconds, method)
                found[way] = {
                    "mean": result.measures.mean,
                    "largest": max(result.measures.spots),
                    "incidence": result.measures.incidence,
                    "slope": result.measures.slope,
                    "broken": result.broken,
                    "steps": result.steps,
                    "seconds": result.seconds,
                }
        except InputError as error:
            print(f"{name}: {error}", flush=True)
        if any(way in found for way in WAYS):
            file.write_text(json.dumps(found))
            print(json.dumps(found), flush=True)


def main(arguments: Sequence[str]) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("what", choices=("check", "redesign", "show"))
    parser.add_argument("--folder", type=Path, help="has */designs/*.yml")
    parser.add_argument("--out", type=Path, default=Path("outputs/designs"))
    parser.add_argument("--seconds", type=float, default=10.0, help="process time of each design")
    parser.add_argument("--ways", nargs="*", default=list(WAYS), choices=WAYS)
    parser.add_argument("--designs", nargs="*", default=[], help="some of them: specification/file")
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    try:
        if given.what == "show":
            found = [json.loads(f.read_text()) for f in sorted(given.out.glob("*.json"))]
            print("\n".join(redesign_table(found)))
            return 0
        if given.folder is None:
            raise InputError("--folder: missing; allowed: a folder with */designs/*.yml")
        if given.what == "check":
            print("\n".join(check(given.folder)))
        else:
            redesign(given.folder, given.out, given.seconds, given.designs, given.ways)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
