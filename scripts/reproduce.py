"""Run an old run folder's experiment again, and compare the metrics.

    python scripts/reproduce.py outputs/wavefront_coding/<date_time> [--into FOLDER]

The overrides come from `.hydra/overrides.yaml`, the expected numbers from `metrics.json`.  When the
code is not the commit that `run.json` names, the script says so and goes on.
"""

import argparse
import subprocess
import sys
from pathlib import Path

from dolens.errors import InputError
from dolens.experiments.running.configuration import with_overrides
from dolens.experiments.running.recorded_run import read_record
from dolens.experiments.running.run_files import info_of, metrics_of, overrides_of

ROOT = Path(__file__).resolve().parents[1]


def main() -> int:
    """Return 0 when every metric but the costs is the same to 1e-6 relative."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="the run folder to repeat")
    parser.add_argument("--into", type=Path, help="where the new run goes (default: beside it)")
    parser.add_argument("--trust", action="store_true", help="let it call whatever it names")
    arguments = parser.parse_args()
    old = arguments.run.resolve()
    try:
        # Its overrides are composed once to see what they name, and nothing is made of that.
        with_overrides(read_record(old, trust=arguments.trust), ["seed=0"])
        overrides, expected = overrides_of(old), metrics_of(old)
        commit = (info_of(old).get("git") or {}).get("commit")
    except InputError as error:
        sys.exit(f"error: {error}")
    into = (arguments.into or old.with_name(old.name + "_again")).resolve()
    here = subprocess.run(
        ["git", "-C", str(ROOT), "rev-parse", "HEAD"], capture_output=True, text=True, check=False
    ).stdout.strip()
    if commit != here:
        print(f"note: the run was made by commit {commit}, this is {here}")
    overrides = [forced(override) for override in overrides]
    command = [sys.executable, str(ROOT / "train.py"), *overrides, f"hydra.run.dir={into}"]
    done = subprocess.run(command, cwd=ROOT, check=False)
    if done.returncode:
        return done.returncode
    found = metrics_of(into)
    differing = 0
    for name, value in expected.items():
        if name.startswith("cost/"):
            continue
        same = name in found and abs(found[name] - value) <= 1e-6 * abs(value)
        differing += not same
        if not same:
            print(f"{name}: {value} then, {found.get(name)} now")
    print("reproduced" if not differing else f"{differing} metrics differ")
    return int(differing > 0)


def forced(override: str) -> str:
    """An override that adds a setting, so that it also stands where the setting is there now."""
    key = override.removeprefix("+").partition("=")[0]
    is_setting = override[:1] == "+" != override[1:2] and not (ROOT / "conf" / key).is_dir()
    return f"+{override}" if is_setting and "@" not in key else override


if __name__ == "__main__":
    sys.exit(main())
