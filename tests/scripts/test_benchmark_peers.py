"""scripts/benchmark.py --peers: where other programs lie, and what is said of those that do not."""

import csv
import importlib
import itertools
import sys
from pathlib import Path

import pytest
import torch

from dolens import InputError

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
NAMES = {"do": "diffoptics", "deeplens": "deeplens", "optiland": "optiland"}
SMALLEST = {
    "--rays": "200",
    "--lenses": "cooke_triplet",
    "--dtypes": "float64",
    "--threads": "1",
    "--seconds": "0.01",
}


@pytest.fixture
def scripts(monkeypatch):
    """Import a module of scripts/; what it does to the paths of imports is undone."""
    monkeypatch.setattr(sys, "path", [str(SCRIPTS), *sys.path])
    kept = dict(sys.modules)
    yield importlib.import_module
    for name in NAMES.values():
        if name not in kept:
            sys.modules.pop(name, None)


@pytest.fixture
def checkout(tmp_path):
    """Make a folder that looks like a peer's: its package, with what it says when imported."""

    def make(name, source=""):
        folder = tmp_path / f"{name} checkout"
        (folder / NAMES[name]).mkdir(parents=True)
        (folder / NAMES[name] / "__init__.py").write_text(source)
        return folder

    return make


def test_paths_are_taken_by_name(scripts, checkout):
    paths = scripts("benchmarks.peer_paths")
    words = [f"{name}={checkout(name)}" for name in NAMES]
    assert {n: p.name for n, p in paths.parse(words).items()} == {
        name: f"{name} checkout" for name in NAMES
    }
    assert paths.skipped(paths.parse(words)) == []


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("do", "'do' is not of the form NAME=PATH"),
        ("zemax=.", "NAME one of do, deeplens, optiland"),
        ("do=nowhere", "do: there is no 'diffoptics' in nowhere"),
        ("optiland=.", "optiland: there is no 'optiland' in ."),
    ],
)
def test_a_path_that_cannot_be_one(scripts, word, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as error:
        scripts("benchmarks.peer_paths").parse([word])
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_the_command_line_refuses_it_too(scripts, capsys):
    with pytest.raises(SystemExit):
        scripts("benchmark").arguments(["--peers", "do=nowhere"])
    assert "there is no 'diffoptics' in nowhere" in capsys.readouterr().err


def test_peers_are_measured_alone_unless_other_parts_are_asked_for(scripts):
    arguments = scripts("benchmark").arguments
    assert set(arguments(["--peers"]).parts) == {"peer_trace", "peer_render", "peer_design"}
    assert set(arguments(["--peers", "--parts", "trace,peer_trace"]).parts) == {
        "trace",
        "peer_trace",
    }
    assert "peer_trace" not in arguments([]).parts
    with pytest.raises(SystemExit):
        arguments(["--parts", "peer_trace"])


def run(scripts, tmp_path, peers):
    benchmark = scripts("benchmark")
    options = [word for pair in SMALLEST.items() for word in pair]
    given = ["--peers", *peers, *options, "--output", str(tmp_path / "out")]
    assert benchmark.main(benchmark.arguments(given)) == 0
    with (tmp_path / "out" / "results.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_who_is_not_given_is_skipped_loudly(scripts, tmp_path, capsys):
    rows = run(scripts, tmp_path, [])
    said = capsys.readouterr().out
    for program, word in (("dO", "do"), ("DeepLens", "deeplens"), ("Optiland", "optiland")):
        line = f"SKIPPED: {program}, because no path was given (--peers {word}=PATH)"
        # Where its rows would be, and again at the end.
        assert said.count(line) == 2
    assert {row["backend"] for row in rows} == {"cpu", "dO", "DeepLens", "Optiland"}
    for row in (row for row in rows if row["backend"] == "cpu"):
        assert float(row["times_ours"]) == 1.0
        assert float(row["error"]) < 1e-11


def test_a_program_that_fails_leaves_the_others_alone(scripts, checkout, tmp_path):
    folder = checkout("do", "raise RuntimeError('not on this machine')")
    rows = run(scripts, tmp_path, [f"do={folder}", "--parts", "peer_trace"])
    failed = [row for row in rows if row["backend"] == "dO"]
    assert len(failed) == 2
    for row in failed:
        assert row["note"] == "failed: RuntimeError: not on this machine"
    assert any(row["backend"] == "cpu" and row["failed"] == "False" for row in rows)


def test_a_release_of_deeplens_says_its_version_under_its_name_of_pypi(scripts, checkout):
    folder = checkout("deeplens")
    (folder / "deeplens_core-2.5.6.dist-info").mkdir()
    said = "Metadata-Version: 2.1\nName: deeplens-core\nVersion: 2.5.6\n"
    (folder / "deeplens_core-2.5.6.dist-info" / "METADATA").write_text(said)
    assert "DeepLens 2.5.6" in scripts("benchmarks.peer_paths").describe({"deeplens": folder})


@pytest.mark.parametrize("lens", ["asphere", "cooke_triplet"])
def test_points_of_any_program_are_compared_with_rays_of_28_digits(scripts, lens):
    cases, golden = scripts("benchmarks.cases"), scripts("benchmarks.golden")
    traced = cases.load(lens, torch.float64, "reference", torch.device("cpu"))

    def error(shift):
        return golden.golden_point_error(
            lens, torch.float64, cases.WAVELENGTH, lambda rays: traced.trace(rays).position + shift
        )

    assert error(0.0) < 1e-12
    assert error(torch.tensor([3e-4, 4e-4, 0.0])) == pytest.approx(5e-4, rel=1e-9)


def test_runs_are_timed_by_the_clock_that_is_given(scripts):
    timing = scripts("benchmarks.timing")
    found = timing.by_turns(
        [timing.Contender("a run", lambda: None, amount=2.0)],
        0.0,
        torch.device("cpu"),
        clock=itertools.count().__next__,
    )
    # One tick from a run's beginning to its end, for two units.
    assert found["a run"].seconds.tolist() == [0.5, 0.5, 0.5]
