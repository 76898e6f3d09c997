"""Compare dolens's optimizers of a camera's lens with Côté, Tseng and Heide's residuals.

    python scripts/co_designs_of_others.py run --folder outputs/of_others --seconds 12
    python scripts/co_designs_of_others.py show --folder outputs/of_others

Each of thirty co-designs, ten cameras by three seeds, is trained by each method for the same
process time of one thread, and tested.  Nothing is tuned here: each method has one setting.  Runs
that the folder has are not made again.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dolens.errors import InputError
from scripts.co_design.cases import CASES
from scripts.co_design.methods import METHODS, THEIRS
from scripts.co_design.results import against
from scripts.co_design.training import Trainings, file_of, photographs_in


def run(
    folder: Path,
    names: Sequence[str],
    methods: Sequence[str],
    seconds: float,
    seeds: Sequence[int],
    data: Sequence[str],
) -> None:
    """Train and judge what has no file yet; a line each."""
    folder.mkdir(parents=True, exist_ok=True)
    trainings = Trainings(data, seconds)
    for seed in seeds:
        for name in names:
            case = CASES[name]
            for method in methods:
                how = METHODS[method]
                file = folder / file_of(name, method, f"seed_{seed}")
                if not file.is_file():
                    overrides = [*case.overrides, *how.overrides(case)]
                    found = trainings.scores(overrides, seed, "test", how.callbacks)
                    about = {"case": name, "optimizer": method, "seed": seed}
                    file.write_text(json.dumps({**about, **found}))
                found = json.loads(file.read_text())
                print(f"{name}, {method}, seed {seed}: {found['score']:.2f}", flush=True)


def main(arguments: Sequence[str]) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("what", choices=("run", "show"))
    parser.add_argument("--folder", type=Path, default=Path("outputs/of_others"))
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--methods", nargs="*", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--seconds", type=float, default=12.0, help="process time of a training")
    parser.add_argument("--seeds", nargs="*", type=int, default=[1, 2, 3])
    parser.add_argument("--package-folders", nargs="*", default=[], help="of unpacked photographs")
    given = parser.parse_args(arguments)
    try:
        if given.what == "run":
            data = photographs_in(given.package_folders)
            run(given.folder, given.cases, given.methods, given.seconds, given.seeds, data)
        else:
            files = sorted(given.folder.glob("*_seed_*.json"))
            print("\n".join(against([json.loads(f.read_text()) for f in files], THEIRS)))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
