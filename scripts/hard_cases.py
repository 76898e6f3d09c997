"""The hard cases of tests/optics/hard_cases.py as a table: errors against 80 digits.

python scripts/hard_cases.py
"""

import sys
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.optics.hard_case_errors import measure
from tests.optics.hard_cases import CASES


def main() -> None:
    """Print value error (mm) and relative gradient error; in brackets, in roundings of inputs."""
    print(f"{'':50s} float64: value, gradient (roundings)      float32")
    for name, case in CASES.items():
        if not case.rays:
            continue
        cells = []
        for dtype in (torch.float64, torch.float32):
            e = measure(case, dtype)
            roundings = f"({e.value_roundings:.1f}, {e.gradient_roundings:.1f})"
            cells.append(f"{e.value:.1e} {e.gradient:.1e} {roundings:12s}")
        print(f"{name:50s}", "   ".join(cells))


if __name__ == "__main__":
    main()
