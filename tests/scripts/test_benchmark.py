"""scripts/benchmark.py in its smallest form: what it writes, and that errors stand beside times."""

import csv
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SMALLEST = {
    "--rays": "500",
    "--lenses": "cooke_triplet",
    "--dtypes": "float64",
    "--parts": "trace,memory",
    "--threads": "1",
    "--seconds": "0.01",
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Folder of one run, and what it printed."""
    folder = tmp_path_factory.mktemp("benchmark")
    options = [word for pair in SMALLEST.items() for word in pair]
    done = subprocess.run(
        [sys.executable, "scripts/benchmark.py", "--quick", *options, "--output", str(folder)],
        cwd=ROOT,
        env=dict(os.environ) | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder, done.stdout


def rows_of(folder):
    with (folder / "results.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_every_time_has_its_spread_its_ratio_and_a_small_error(run):
    rows = [row for row in rows_of(run[0]) if row["unit"] == "ns/ray/surface"]
    parts = {(row["part"], row["backend"]) for row in rows if row["device"] == "cpu"}
    assert parts == {
        (part, backend)
        for part in ("forward", "forward and gradient")
        for backend in ("reference", "cpu")
    }
    for row in rows:
        assert row["failed"] == "False", row["note"]
        assert 0.0 < float(row["low"]) <= float(row["value"]) <= float(row["high"])
        assert 0.0 < float(row["ratio_low"]) <= float(row["ratio"]) <= float(row["ratio_high"])
        assert float(row["error"]) < 1e-11
        assert float(row["golden_mm"]) < 1e-11
        assert float(row["valid"]) > 0.9
        if row["backend"] == "reference":
            assert float(row["ratio"]) == 1.0


def test_a_gradient_keeps_its_rays_and_no_more(run):
    (row,) = (
        row
        for row in rows_of(run[0])
        if row["part"] == "memory saved for backward" and row["backend"] == "cpu"
    )
    # Position and direction in double precision and a status: 49 bytes, and the table.
    assert 48.0 < float(row["value"]) < 64.0


def test_json_holds_the_same_rows(run):
    document = json.loads((run[0] / "results.json").read_text(encoding="utf-8"))
    assert {"processor", "cores", "torch", "load"} <= document["environment"].keys()
    written = rows_of(run[0])
    assert len(document["rows"]) == len(written)
    for mine, theirs in zip(document["rows"], written, strict=True):
        assert mine.keys() == theirs.keys()
        value = math.nan if mine["value"] is None else mine["value"]
        assert str(value) == theirs["value"]
