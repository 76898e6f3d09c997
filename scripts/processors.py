"""Run tests as other processors would, and say what differs.

    python scripts/processors.py                          # the whole suite, three times
    python scripts/processors.py tests/lens_search -n 0   # arguments are pytest's

OpenBLAS, MKL, PyTorch and Numba each choose their instructions by the processor, and round
differently with each choice.  What fails under one setting and passes under another hangs on
rounding.  A setting that this processor cannot run is named and left out.  The exit status is 1
where tests fail or differ.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import torch

ROOT = Path(__file__).resolve().parents[1]
# Of each setting, what PyTorch calls the least processor that it needs, and its variables.
SETTINGS = {
    "generic": (
        "DEFAULT",
        {
            "OPENBLAS_CORETYPE": "Haswell",
            "MKL_CBWR": "COMPATIBLE",
            "ATEN_CPU_CAPABILITY": "default",
            "NUMBA_CPU_NAME": "generic",
        },
    ),
    "AVX2": (
        "AVX2",
        {
            "OPENBLAS_CORETYPE": "Haswell",
            "MKL_CBWR": "AVX2",
            "ATEN_CPU_CAPABILITY": "avx2",
            "NUMBA_CPU_NAME": "haswell",
        },
    ),
    "AVX-512": (
        "AVX512",
        {
            "OPENBLAS_CORETYPE": "SkylakeX",
            "MKL_CBWR": "AVX512",
            "ATEN_CPU_CAPABILITY": "avx512",
            "NUMBA_CPU_NAME": "skylake-avx512",
        },
    ),
}
_LEVELS = ("DEFAULT", "AVX2", "AVX512")


def able(needs: str) -> bool:
    """Return whether this processor has the instructions of a setting."""
    has = torch.backends.cpu.get_cpu_capability().upper()
    return has in _LEVELS and _LEVELS.index(has) >= _LEVELS.index(needs)


def outcomes(variables: dict[str, str], arguments: Sequence[str]) -> dict[str, str]:
    """Run pytest with variables in its environment, and return test → passed, failed or skipped.

    Raises:
        SystemExit: pytest could not run.
    """
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        # Numba may take up what another setting compiled, were it to look in the same place.
        environment = os.environ | variables | {"NUMBA_CACHE_DIR": folder}
        command = [sys.executable, "-m", "pytest", "-q", f"--junitxml={report}", *arguments]
        status = subprocess.run(command, cwd=ROOT, env=environment).returncode
        if status > 1 or not report.is_file():
            raise SystemExit(f"pytest ended with status {status}")
        found = {}
        for case in ElementTree.parse(report).getroot().iter("testcase"):
            kinds = {child.tag for child in case}
            failed = kinds & {"failure", "error"}
            word = "failed" if failed else "skipped" if "skipped" in kinds else "passed"
            found[f"{case.get('classname')}::{case.get('name')}"] = word
    return found


def main() -> int:
    """Run all settings that this processor has, print a summary, and return the exit status."""
    by_setting = {}
    for name, (needs, variables) in SETTINGS.items():
        if not able(needs):
            print(f"{name}: this processor has no such instructions; left out")
            continue
        print(f"{name}: {' '.join(f'{k}={v}' for k, v in variables.items())}", flush=True)
        by_setting[name] = outcomes(variables, sys.argv[1:])
    for name, found in by_setting.items():
        words = list(found.values())
        print(name, *(f"{words.count(w)} {w}" for w in ("passed", "failed", "skipped")), sep=", ")
    bad = 0
    for test in sorted({test for found in by_setting.values() for test in found}):
        words = {name: found.get(test, "missing") for name, found in by_setting.items()}
        if len({*words.values()}) > 1 or "failed" in words.values():
            bad += 1
            print(test, *(f"{name} {word}" for name, word in words.items()), sep=", ")
    if not bad:
        print("nothing failed, and nothing differs")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
