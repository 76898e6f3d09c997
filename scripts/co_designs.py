"""Compare optimizers of a camera's lens at equal process time, over thirty co-designs.

    python scripts/co_designs.py run --folder outputs/co_designs --seconds 12
    python scripts/co_designs.py run --folder outputs/of_others --seconds 12 --methods \\
        "generalized aberrations" "least squares" adam
    python scripts/co_designs.py show --folder outputs/co_designs

Each of ten cameras is trained with three seeds for the same process time of one thread, whatever it
does, so that other programs on the machine do not count, and tested.  Adam and least squares have
four settings each, of which validation photographs choose one for each camera, with a seed of its
own.  `--methods` compares ways that have one setting each, which nothing tunes, with the residuals
of Côté, Tseng and Heide among them.  Runs that the folder has are not made again.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dolens.errors import InputError
from scripts.co_design.cases import CASES, METHODS, THEIRS, candidates
from scripts.co_design.results import against, table
from scripts.co_design.training import CallbacksOf, Trainings, photographs_in

_TUNING_SEED = 100


class Runs:
    """Trainings whose scores are kept in a folder, a file each.

    Args:
        folder: of the files; it is made.
        trainings: that make what has no file yet.
    """

    def __init__(self, folder: Path, trainings: Trainings) -> None:
        self._folder, self._trainings = folder, trainings
        folder.mkdir(parents=True, exist_ok=True)

    def tuned(self, name: str, optimizer: str, settings: list[Sequence[str]]) -> Sequence[str]:
        """Return the settings that are best on validation photographs."""
        scores = []
        for number, chosen in enumerate(settings):
            file = self._file(name, optimizer, f"tuning_{number}")
            if not file.is_file():
                overrides = [*CASES[name].overrides, *chosen]
                found = self._trainings.scores(overrides, _TUNING_SEED, "val")
                file.write_text(json.dumps({**found, "settings": list(chosen)}))
            scores.append(json.loads(file.read_text())["score"])
            print(f"{name}, {optimizer}, {' '.join(chosen)}: {scores[-1]:.2f}", flush=True)
        return settings[scores.index(max(scores))]

    def tested(
        self, name: str, method: str, settings: Sequence[str], seed: int, callbacks: CallbacksOf
    ) -> None:
        """Train and test, and print the score."""
        file = self._file(name, method, f"seed_{seed}")
        if not file.is_file():
            overrides = [*CASES[name].overrides, *settings]
            found = self._trainings.scores(overrides, seed, "test", callbacks)
            about = {"case": name, "optimizer": method, "seed": seed, "settings": list(settings)}
            file.write_text(json.dumps({**about, **found}))
        print(f"{name}, {method}, seed {seed}: {json.loads(file.read_text())['score']:.2f}")

    def _file(self, name: str, method: str, rest: str) -> Path:
        return self._folder / f"{name}_{method}_{rest}.json".replace(", ", "_").replace(" ", "_")


def run_tuned(runs: Runs, names: Sequence[str], seeds: Sequence[int]) -> None:
    """Tune both optimizers for each camera, then train and test."""
    for name in names:
        for optimizer, settings in candidates(CASES[name]).items():
            chosen = runs.tuned(name, optimizer, settings)
            for seed in seeds:
                runs.tested(name, optimizer, chosen, seed, list)


def run_methods(
    runs: Runs, names: Sequence[str], methods: Sequence[str], seeds: Sequence[int]
) -> None:
    """Train and test by each method's one setting."""
    for seed in seeds:
        for name in names:
            for method in methods:
                how = METHODS[method]
                runs.tested(name, method, how.overrides(CASES[name]), seed, how.callbacks)


def shown(folder: Path) -> list[str]:
    """Return lines of Markdown: what a folder's runs come to."""
    runs = [json.loads(file.read_text()) for file in sorted(folder.glob("*_seed_*.json"))]
    return against(runs, THEIRS) if any(r["optimizer"] == THEIRS for r in runs) else table(runs)


def main(arguments: Sequence[str]) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("what", choices=("run", "show"))
    parser.add_argument("--folder", type=Path, default=Path("outputs/co_designs"))
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--methods", nargs="*", choices=list(METHODS), help="none: tuned ones")
    parser.add_argument("--seconds", type=float, default=12.0, help="process time of a training")
    parser.add_argument("--seeds", nargs="*", type=int, default=[1, 2, 3])
    parser.add_argument("--package-folders", nargs="*", default=[], help="of unpacked photographs")
    given = parser.parse_args(arguments)
    try:
        if given.what == "show":
            print("\n".join(shown(given.folder)))
            return 0
        trainings = Trainings(photographs_in(given.package_folders), given.seconds)
        runs = Runs(given.folder, trainings)
        if given.methods:
            run_methods(runs, given.cases, given.methods, given.seeds)
        else:
            run_tuned(runs, given.cases, given.seeds)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
