"""Optiland's global optimizers on the specification of a search, with its own lens and tracer.

    python scripts/lens_search/optiland_on_merit.py search_triplet --stop 2 --seconds 115 \
        --optiland PYTHON_WITH_OPTILAND --out FOLDER [--seeds 1] [--methods BasinHopping,CMAES]

The rows compare with those of `scipy_on_merit.py`: spots, rays, limits and bounds are the same, and
what is found is finished as the search finishes its lenses.  Optiland has a process of its own
(`optiland_search.py`), which gets the task in plain numbers and so many seconds of processor time
on one core.  Runs that FOLDER has are not repeated.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from lens_search.on_merit import Run, Task, kept, table
from lens_search.optiland_search import METHODS


def main() -> None:
    """Run what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("experiment")
    parser.add_argument("--stop", type=int, required=True, help="behind so many groups")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--methods", default=",".join(METHODS), help="names with commas")
    parser.add_argument("--curved", type=float, default=5.0, help="curvatures over 1/f at most")
    parser.add_argument("--optiland", required=True, help="a Python that has Optiland")
    parser.add_argument("--out", type=Path, required=True, help="folder of what is found")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    of = Task.of(arguments.experiment, arguments.stop)
    for seed, name in product(range(arguments.seeds), arguments.methods.split(",")):
        run = Run(arguments.experiment, f"Optiland {name}", seed, arguments.seconds, 0, None, None)
        if not run.path(arguments.out).exists():
            _searched(of, arguments, run, name).keep(arguments.out)
    print(table(kept(arguments.out, arguments.experiment)), flush=True)


def _searched(of: Task, arguments: argparse.Namespace, run: Run, name: str) -> Run:
    """Return a run with what Optiland found."""
    with tempfile.TemporaryDirectory() as folder:
        task, found = Path(folder) / "task.json", Path(folder) / "found.json"
        task.write_text(json.dumps(of.as_plain(arguments.curved)))
        script = str(Path(__file__).with_name("optiland_search.py"))
        command = [arguments.optiland, script, "--task", str(task), "--method", name]
        command += ["--seconds", str(run.seconds), "--seed", str(run.seed), "--out", str(found)]
        subprocess.run(command, check=True)
        data = json.loads(found.read_text())
    values = data["values"]
    spot = of.finished(None if values is None else np.array(values))
    return replace(run, lenses=data["lenses"], values=values, spot=spot)


if __name__ == "__main__":
    main()
