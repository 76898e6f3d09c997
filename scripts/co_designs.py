"""Compare optimizers of a camera's lens at equal process time, over thirty co-designs.

    python scripts/co_designs.py run --folder outputs/co_designs --seconds 12
    python scripts/co_designs.py show --folder outputs/co_designs

Each optimizer has four settings, of which validation photographs choose one for each co-design,
with a seed of its own; then three other seeds are tested.  A run takes the same process time of one
thread whatever it does, so that other programs on the machine do not count.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dolens.errors import InputError
from scripts.co_design.cases import CASES, candidates
from scripts.co_design.results import table
from scripts.co_design.training import Trainings, file_of, photographs_in

_TUNING_SEED = 100


def run(
    folder: Path, names: Sequence[str], seconds: float, seeds: Sequence[int], data: Sequence[str]
) -> None:
    """Tune, train and judge what has no file yet; a line each."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        case, trainings = CASES[name], Trainings(data, seconds)
        for optimizer, settings in candidates(case).items():
            tuned = []
            for number, chosen in enumerate(settings):
                file = folder / file_of(name, optimizer, f"tuning_{number}")
                overrides = [*case.overrides, *chosen]
                if not file.is_file():
                    found = trainings.scores(overrides, _TUNING_SEED, "val")
                    file.write_text(json.dumps({**found, "settings": list(chosen)}))
                found = json.loads(file.read_text())
                tuned.append(found["score"])
                print(f"{name}, {optimizer}, {' '.join(chosen)}: {found['score']:.2f}", flush=True)
            chosen = settings[tuned.index(max(tuned))]
            for seed in seeds:
                file = folder / file_of(name, optimizer, f"seed_{seed}")
                if not file.is_file():
                    found = trainings.scores([*case.overrides, *chosen], seed, "test")
                    about = {"case": name, "optimizer": optimizer, "seed": seed}
                    file.write_text(json.dumps({**about, **found, "settings": list(chosen)}))
                found = json.loads(file.read_text())
                print(f"{name}, {optimizer}, seed {seed}: {found['score']:.2f}", flush=True)


def main(arguments: Sequence[str]) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("what", choices=("run", "show"))
    parser.add_argument("--folder", type=Path, default=Path("outputs/co_designs"))
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--seconds", type=float, default=12.0, help="process time of a training")
    parser.add_argument("--seeds", nargs="*", type=int, default=[1, 2, 3])
    parser.add_argument("--package-folders", nargs="*", default=[], help="of unpacked photographs")
    given = parser.parse_args(arguments)
    try:
        if given.what == "run":
            data = photographs_in(given.package_folders)
            run(given.folder, given.cases, given.seconds, given.seeds, data)
        else:
            files = sorted(given.folder.glob("*_seed_*.json"))
            print("\n".join(table([json.loads(file.read_text()) for file in files])))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
