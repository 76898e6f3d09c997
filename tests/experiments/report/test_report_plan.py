"""What the report's files say: every item of the supplement, every system, every check."""

import importlib
import json
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

from dolens.errors import InputError
from dolens.experiments.report.checks import Check, load_checks
from dolens.experiments.report.plan import load_plan
from dolens.experiments.report.prescriptions import load_golden_rays

ROOT = Path(__file__).resolve().parents[3]
# The names of the metrics of each system, from real runs of the report.
METRICS = json.loads(Path(__file__).with_name("metric_names.json").read_text(encoding="utf-8"))
PLAN = load_plan()
TRAINED = [system for system in PLAN.systems if system.module is None]
ITEMS = PLAN.items()


def test_every_item_of_the_supplement_is_there_once():
    names = [item.item for item in ITEMS]
    for item in (
        *(f"S{number}" for number in range(1, 22)),
        "Algorithm 1",
        *(f"Figure {number}" for number in range(1, 13)),
        *("Table I (Section III A)", "Table II (Section III B)", "Table I (Section III C)"),
        *("Table II", "Table III", "Section IV B", "Section V A", "Section VI"),
    ):
        assert names.count(item) == 1, item


@pytest.fixture(scope="module")
def configuration():
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        yield
    GlobalHydra.instance().clear()


@pytest.mark.parametrize("system", TRAINED, ids=lambda system: system.name)
def test_a_system_composes(configuration, system):
    cfg = compose("train", list(system.overrides))
    assert cfg.module._target_.startswith("dolens.experiments.")


@pytest.mark.parametrize("item", ITEMS, ids=lambda item: item.item)
def test_an_item_names_code_and_tests_that_exist(item):
    for name in item.code:
        module, _, attribute = name.rpartition(".")
        assert hasattr(importlib.import_module(module), attribute), name
    for path in item.tests:
        assert (ROOT / path).is_file(), path
    assert item.tests or item.runs


def test_every_metric_that_is_checked_or_shown_is_one_that_the_system_writes():
    """A comparison's metrics follow from its views; they are tested with the gains."""
    comparisons = {comparison.name for comparison in PLAN.comparisons}
    asked = [(check.run, check.metric) for check in load_checks(PLAN)]
    asked += [(row.run, name) for item in ITEMS for row in item.rows for name in row.metrics()]
    missing = [
        (run, metric)
        for run, metric in asked
        if run not in comparisons and metric not in METRICS[run]
    ]
    assert not missing


def test_every_system_belongs_to_an_item_and_has_a_check():
    shown = {name for item in ITEMS for name in item.runs}
    checked = {check.run for check in load_checks(PLAN)}
    assert {system.name for system in PLAN.systems} == shown
    assert shown <= checked


def test_all_systems_take_less_than_45_minutes_on_two_cores():
    assert sum(system.seconds for system in PLAN.systems) < 45 * 60


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({}, "give either expected and tolerance, or low or high"),
        ({"expected": 1.0}, "expected and tolerance go together"),
        ({"expected": 1.0, "tolerance": 0.1, "high": 2.0}, "give either"),
        ({"high": 1.0, "kind": "guess"}, "'guess' is unknown"),
    ],
)
def test_a_check_without_clear_limits_is_refused(limits, words):
    settings = {"item": "S1", "run": "a", "metric": "m", "what": "w", "source": "s"}
    with pytest.raises(InputError, match=words):
        Check(**settings, **{"kind": "exact", **limits})


def test_an_unknown_system_is_refused_with_the_nearest_name():
    with pytest.raises(InputError, match="did you mean 'nikon'"):
        PLAN.system("nikkon")


def test_the_packaged_rays_are_those_of_the_reference(reference):
    for bundle in load_golden_rays():
        given = [r for r in reference(f"rays/{bundle['file']}")["rays"] if r["status"] == "ok"]
        for ray, exact in zip(bundle["rays"], given[::2], strict=True):
            assert ray["o"] == [float(value) for value in exact["o"]]
            assert ray["d"] == [float(value) for value in exact["d"]]
            assert ray["sensor"] == [float(value) for value in exact["sensor"][:2]]
