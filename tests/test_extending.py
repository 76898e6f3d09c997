"""The examples of docs/extending.md do what the document says when they are run as printed."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests import printed
from tests.experiments.runs import rows_of

ROOT = Path(__file__).resolve().parents[1]
DOCUMENT = (ROOT / "docs/extending.md").read_text(encoding="utf-8")
# All but the last, which runs these tests.
BLOCKS = [
    block
    for block in printed.BLOCKS
    if block.page == "docs/extending.md" and not block.text.startswith("python -m pytest")
]
FILES = {block.title.removeprefix("mine/"): block.text for block in BLOCKS if block.title}
COMMANDS = [block for block in BLOCKS if block.language == "sh"]
SCRIPTS = [block for block in BLOCKS if block.language == "python" and not block.title]
# A command, and the experiment that it runs.
TRAININGS = [(block, re.search(r"experiment=(\w+)", block.text)[1]) for block in COMMANDS]


# Runs lists of command lines, those of `dolens` and scripts, and leaves how they ended: each list
# in one process, a copy of one that has imported PyTorch and Lightning, which takes longer.
IN_TWO_PROCESSES = """
import json, os, runpy, sys, traceback
from dolens.cli.app import main
from dolens.cli.extras import import_extra
import_extra("dolens.experiments.running.main", "train", "dolens train")
for number, commands in enumerate(json.loads(sys.argv[1])):
    sys.stdout.flush()
    if os.fork():
        os.wait()
        continue
    ends = []
    for sys.argv in commands:
        try:
            if sys.argv[0] == "dolens":
                main()
            else:
                runpy.run_path(sys.argv[0], run_name="__main__")
            ends.append(None)
        except SystemExit as end:
            ends.append(end.code)
        except Exception as error:
            ends.append(traceback.format_exc())
    with open(f"ends{number}.json", "w") as file:
        json.dump(ends, file)
    sys.exit()
"""


@pytest.fixture(scope="module")
def mine(tmp_path_factory):
    """The folder `mine` of the document, with its files and nothing else."""
    folder = tmp_path_factory.mktemp("mine")
    for path, text in FILES.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def ended(mine):
    """How all scripts ended, and all commands, and what they said on their way.

    What is registered in one serves no other: each is of a section, whose files it alone uses.
    """
    scripts = [f"script{number}.py" for number in range(len(SCRIPTS))]
    for name, block in zip(scripts, SCRIPTS, strict=True):
        (mine / name).write_text(block.text, encoding="utf-8")
    commands = []
    for block in COMMANDS:
        words = shlex.split(block.text)
        assert words[:2] == ["dolens", "train"]
        commands.append(words)
    lists = [[[name] for name in scripts], commands]
    done = subprocess.run(
        [sys.executable, "-c", IN_TWO_PROCESSES, json.dumps(lists)],
        cwd=mine,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    said = done.stdout[-2000:] + done.stderr[-4000:]
    assert done.returncode == 0, said
    return *(json.loads((mine / f"ends{n}.json").read_text()) for n in (0, 1)), said


def a_camera_of_nearer_objects_with_its_network_and_loss(folder, metrics):
    assert {"test/psnr_db/worst", "test/psnr_db/6m", "test/psnr_db/5m"} <= set(metrics)
    plate = yaml.safe_load((folder / "lens/final.yaml").read_text())["surfaces"]["5"]
    assert float(plate["x3"]) > 1.9e-5  # the child's start, not the parent's of 1.5e-5
    assert float(plate.get("x2y", 0.0)) == 0.0  # dropped
    assert metrics["network/pretrained"] == 0.0
    assert "loss/perceptual_available" not in metrics  # of the repository's own loss alone
    assert any(b"train/l1" in file.read_bytes() for file in folder.rglob("events.out.tfevents.*"))


def a_design_with_less_astigmatism(folder, metrics):
    assert metrics["rms_spot_um/final"] < 0.5 * metrics["rms_spot_um/initial"]
    front = yaml.safe_load((folder / "lens/final.yaml").read_text())["surfaces"]["1"]
    assert front["type"] == "paraboloid"
    assert abs(float(front["twist"])) < 1e-6


def an_operand_in_the_history(folder, metrics):
    columns = {f"{kind}/telephoto_ratio" for kind in ("operand", "operand_slope", "merit")}
    assert columns <= set(rows_of(folder / "history.csv")[0])
    assert "telephoto_ratio" in (folder / "operands.csv").read_text()


def a_camera_trained_with_another_renderer(folder, metrics):
    assert "test/psnr_db/worst" in metrics
    assert metrics["cost/rays"] == 0.0


def a_number_a_table_and_a_figure(folder, metrics):
    rows = rows_of(folder / "chromatic_focus.csv")
    distances = [float(row["bfd_mm"]) for row in rows]
    spread = max(distances) - min(distances)
    assert metrics["chromatic_focus/range_mm"] == pytest.approx(spread, abs=2e-4)
    assert (folder / "figures/chromatic_focus.png").stat().st_size > 5000


# Section and experiment of a command → what the text promises of its run folder.
PROMISES = {
    ("A surface", "astigmatic"): a_design_with_less_astigmatism,
    ("A loss", "near_field"): a_camera_of_nearer_objects_with_its_network_and_loss,
    ("A merit", "short_triplet"): an_operand_in_the_history,
    ("A renderer", "wavefront_coding"): a_camera_trained_with_another_renderer,
    ("An analysis", "chromatic_focus"): a_number_a_table_and_a_figure,
}


@pytest.mark.parametrize(
    ("block", "experiment"), TRAININGS, ids=[block.section for block in COMMANDS]
)
def test_a_command_leaves_what_the_text_promises(mine, ended, block, experiment):
    _, commands, said = ended
    assert not commands[COMMANDS.index(block)], said
    (folder,) = (mine / "outputs" / experiment).iterdir()
    metrics = json.loads((folder / "metrics.json").read_text())
    PROMISES[block.section, experiment](folder, metrics)


def test_the_scripts_run(ended):
    scripts, _, said = ended
    assert scripts and not any(scripts), said


def test_every_command_has_a_promise():
    assert {(block.section, experiment) for block, experiment in TRAININGS} == set(PROMISES)


def test_every_block_is_a_file_or_is_run():
    """A block that is neither would be an example that nobody has tried."""
    assert len(FILES) == sum(bool(block.title) for block in BLOCKS)  # no file is printed twice
    for block in BLOCKS:
        assert block.title.startswith("mine/") or block.language in ("sh", "python"), block


def test_the_table_names_the_files_of_the_document_and_counts_them():
    rows = [
        line.split("|")[1:-1] for line in DOCUMENT.split("## ")[0].splitlines() if "`mine/" in line
    ]
    named = [
        (re.findall(r"`(mine/[\w./]+)`", row[1]), int(row[2])) for row in rows if len(row) == 3
    ]
    assert len(named) >= 7
    for paths, count in named:
        assert len(paths) == count
        assert {path.removeprefix("mine/") for path in paths} <= set(FILES)
