"""`dolens new` begins a camera of one's own; `dolens doctor` says what a machine has."""

import importlib.metadata
import tomllib

import pytest
from typer.testing import CliRunner

from dolens.cli import doctor
from dolens.cli.app import app
from dolens.errors import InputError
from tests.printed import ROOT


def ended(*words):
    return CliRunner(env={"COLUMNS": "200"}).invoke(app, list(words))


@pytest.mark.parametrize("name", ["my camera", "1st", "a-b", "ä"])
def test_a_camera_s_name_is_that_of_its_experiment(tmp_path, name):
    done = ended("new", str(tmp_path / name))
    assert isinstance(done.exception, InputError)
    assert "letters, digits" in str(done.exception)
    assert not any(tmp_path.iterdir())


def test_new_writes_over_nothing(tmp_path):
    mine = tmp_path / "mine.txt"
    mine.write_text("mine")
    for folder in (tmp_path, mine):
        done = ended("new", str(folder))
        assert isinstance(done.exception, InputError), done.output
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_another_name_is_another_experiment_s(tmp_path):
    assert ended("new", str(tmp_path / "telescope")).exit_code == 0
    found = sorted(path.stem for path in (tmp_path / "telescope/conf/experiment").iterdir())
    assert found == ["telescope"]


def test_each_extra_of_the_project_is_looked_for():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert {*doctor.EXTRAS} == {*project["optional-dependencies"]} - {"all", "test"}


def test_the_doctor_finds_what_is_missing_and_for_what(monkeypatch):
    versions = {"optuna": "4.1.0"}  # too old
    absent = {"cadquery-ocp-novtk"}
    installed = importlib.metadata.version

    def version(package):
        if package in absent:
            raise importlib.metadata.PackageNotFoundError(package)
        return versions.get(package) or installed(package)

    monkeypatch.setattr(importlib.metadata, "version", version)
    done = ended("doctor")
    assert done.exit_code == 0, done.exception
    rows = {line.split()[1]: line for line in done.output.splitlines() if len(line.split()) > 1}
    assert rows["train"].split()[0] == "✓" and rows["Trace"].split()[0] == "✓"
    assert rows["search"].split()[0] == "–"
    assert "optuna>=5.0 (an older optuna is installed)" in rows["search"]
    assert rows["cad"].split()[0] == "–" and "STEP" in rows["cad"]
