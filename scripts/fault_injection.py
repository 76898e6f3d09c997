"""Kill experiments, and take away what they need: what a checkpoint has must not be lost.

    python scripts/fault_injection.py kills --count 50    # of each kind
    python scripts/fault_injection.py kills --kind poses --count 5
    python scripts/fault_injection.py kills --folder F --minutes 5
    python scripts/fault_injection.py faults              # full disks and the like; some need root

With --folder, kills go on where the last call stopped, until all are done.  The exit status is 1
where anything fell.  What fell is kept in the folder, with its logs.
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # before torch: forked processes have one thread
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from scripts.faults.faults import FAULTS, done
from scripts.faults.kills import killed, table
from scripts.faults.kinds import KINDS
from scripts.faults.processes import warm_up


def kill(options: argparse.Namespace, folder: Path) -> int:
    """Kill runs of each kind, and print the table."""
    results = []
    end = time.monotonic() + 60.0 * options.minutes
    for kind in options.kind or KINDS:
        place = folder / str(list(KINDS).index(kind))
        found = killed(kind, KINDS[kind], options.count, place, options.first, end)
        results.append(found)
        print(
            "\n".join([*table([found])[2:], *(f"    {fault}" for fault in found.faults)]),
            flush=True,
        )
    print("\n".join(table(results)))
    return int(any(result.faults for result in results))


def break_things(options: argparse.Namespace, folder: Path) -> int:
    """Do each fault, and print what fell."""
    fallen = 0
    for name in options.fault or FAULTS:
        wrong = done(name, folder / name.replace(" ", "_").replace(":", "").replace("%", ""))
        skipped = wrong[:1] and wrong[0].startswith("skipped")
        fallen += bool(wrong) and not skipped
        print(f"{'held' if not wrong else 'skipped' if skipped else 'FELL'}  {name}", flush=True)
        for line in wrong[:8]:
            print(f"        {line}", flush=True)
    return int(fallen > 0)


def main() -> int:
    """Do what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("kills", "faults"))
    parser.add_argument("--count", type=int, default=50, help="kills of each kind")
    parser.add_argument("--first", type=int, default=0, help="number of the first kill")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="for kills, about")
    parser.add_argument("--kind", action="append", choices=list(KINDS), help="of experiment")
    parser.add_argument("--fault", action="append", choices=list(FAULTS), help="that is done")
    parser.add_argument("--folder", type=Path, help="for the runs; else a temporary one")
    options = parser.parse_args()
    folder = options.folder or Path(tempfile.mkdtemp(prefix="faults_"))
    warm_up()
    print(f"runs in {folder}", flush=True)
    return (kill if options.what == "kills" else break_things)(options, folder)


if __name__ == "__main__":
    sys.exit(main())
