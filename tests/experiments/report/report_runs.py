"""Small plans and run folders for tests of the report."""

import json

import numpy as np
from PIL import Image

from dolens.experiments.report.checks import Check
from dolens.experiments.report.plan import Comparison, Item, Picture, Plan, Row, Section, System

SINGLET = System("singlet", "A <singlet>", 2.0, ("experiment=asphere",))
OTHER = System("other", "Another", 3.0, ("experiment=nikon", "data.iterations=3"))
ITEM = Item(
    "Table I",
    "Asphere & more",
    "Two <b>prescriptions</b>, see `conf/lens`.",
    tests=("tests/optics/test_surfaces.py",),
    runs=("singlet", "other"),
    why="The search goes on.",
    rows=(
        Row("Radius, mm", "20.94", "singlet", lens="surfaces.1.radius"),
        Row("RMS, µm", "4.3", "singlet", "rms_spot_um/final", bound="bound", low="lo", high="hi"),
        Row("Of the other", "-1", "other", "rms_spot_um/final"),
    ),
    pictures=(
        Picture("singlet", "layout", "The <lens>."),
        Picture("singlet", "absent", "None."),
    ),
)
PLAN = Plan((SINGLET, OTHER), (Comparison("gain", "g", "singlet", "other"),), (Section("One", (ITEM,)),))  # fmt: skip # noqa: E501
CHECKS = (
    Check("Table I", "singlet", "rms_spot_um/final", "Small", "exact", "80 digits", 2.9, 0.01),
    Check("Table I", "singlet", "rms_spot_um/final", "Tiny", "printed", "(b)", high=1.0),
    Check("Table I", "singlet", "renamed", "Renamed", "measured", "before", low=0.0),
    Check("Table I", "other", "rms_spot_um/final", "Other", "statement", "ours", low=0.0, high=1.0),
)


def finished_run(folder, overrides=("experiment=asphere",), metrics=None, status="finished"):
    """Write a run folder as a finished run leaves it, with a lens and a picture."""
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra/overrides.yaml").write_text(json.dumps(list(overrides)))
    numbers = metrics or {
        "rms_spot_um/final": 2.895,
        "bound": 0.01,
        "lo": 2.8,
        "hi": 3.0,
        "cost/wall_s": 75.0,
        "cost/rays": 12345.0,
        "cost/peak_memory_mb": 1536.0,
    }
    (folder / "metrics.json").write_text(json.dumps(numbers))
    (folder / "run.json").write_text(json.dumps({"status": status, "git": {"commit": "abcdef"}}))
    (folder / "lens").mkdir()
    (folder / "lens/final.yaml").write_text("surfaces: {'1': {radius: 20.5}}")
    (folder / "figures").mkdir()
    ramp = np.tile(np.arange(2000, dtype=np.uint8), (40, 1))
    Image.fromarray(ramp).save(folder / "figures/layout.png")
    return folder
