"""`dolens experiments`: what every experiment says of itself, and what one is made of."""

import json
import re

import pytest
from typer.testing import CliRunner

from dolens.cli.app import app
from dolens.experiments.running.catalogue import experiments, read_experiment

# "about": estimated from a part of the run, not measured whole.
COST = re.compile(
    r"(about )?(\d+ (seconds|minutes|hours)|hours|days) on (one core|two cores|a GPU)"
)


def invoked(*arguments, width=110):
    return CliRunner().invoke(app, ["experiments", *arguments], env={"COLUMNS": str(width)})


def test_every_packaged_experiment_says_what_it_does_costs_and_writes(root):
    found = experiments([root / "conf"])
    assert len(found) >= 29
    for entry in found:
        assert re.fullmatch(r"[A-Z].{20,100}\.", entry.summary), (entry.name, entry.summary)
        assert COST.fullmatch(entry.cost), (entry.name, entry.cost)
        assert len(entry.writes) > 20, entry.name
        # The first sentence is the first line, whole.
        assert f"\n# {entry.summary}\n" in entry.path.read_text(), entry.name


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A working folder with an experiment of the user's own."""
    (tmp_path / "conf/experiment").mkdir(parents=True)
    (tmp_path / "conf/experiment/mine.yaml").write_text(
        "# @package _global_\n# A lens of\n# mine, and more. Other words.\n# dolens train x=[a]\n"
        "# Cost: 3 minutes on two cores\n# Writes: a table,\n#   and a figure\n# A note.\n"
        "defaults: [asphere, override /lens: nikon, _self_]\n"
    )
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_comment_may_go_over_several_lines(own):
    found = read_experiment(own / "conf/experiment/mine.yaml", own=True)
    assert (found.summary, found.cost, found.writes) == (
        "A lens of mine, and more.",
        "3 minutes on two cores",
        "a table, and a figure",
    )


def test_the_list_has_the_user_s_own_experiments_and_the_packaged_ones(own):
    done = invoked()
    assert done.exit_code == 0
    assert re.search(r"mine +yours +A lens of mine, and more\. +3 minutes", done.output)
    assert re.search(r"\nasphere +Table I: design an aspheric singlet", done.output)
    rows = {row["name"]: row for row in json.loads(invoked("--json").stdout)}
    assert rows["mine"]["own"] and not rows["asphere"]["own"]
    assert rows["mine"]["cost"] == "3 minutes on two cores"


def test_an_experiment_shows_its_choices_command_and_what_it_writes(own):
    done = invoked("mine")
    assert done.exit_code == 0
    for text in (
        "dolens train experiment=mine",
        "a table, and a figure",
        "rms_spot_um/final",
        "asphere",
        "the prescription: surfaces",
    ):
        assert text in done.output, text
    shown = json.loads(invoked("mine", "--json").stdout)
    assert shown["choices"]["lens"] == "nikon"
    assert shown["parents"] == ["asphere"]


def test_a_setting_that_must_be_given_stands_in_the_command(own):
    assert "data.root=<...>" in invoked("wavefront_coding_paper").output


def test_a_misspelt_experiment_is_one_line_with_the_nearest_name(own):
    done = invoked("asfere")
    assert done.exit_code == 1
    assert "'asfere' is no experiment; did you mean 'asphere'?" in str(done.exception)
