"""The model of larger machines gives what was measured, and the page says what it gives."""

import json
from pathlib import Path

import numpy as np
import pytest

from scripts.flat_memory import KINDS, Course, measured, overrides_of
from scripts.scaling import show
from scripts.scaling_model import ASSUMED, PARTS, Experiment

ROOT = Path(__file__).resolve().parents[2]
DEFAULTS = {name: value for name, (value, _) in ASSUMED.items()}


def experiment(one: float = 1.0, two: float = 0.6, **changes) -> Experiment:
    """Every part takes so many seconds on one and on two threads."""
    values = {
        "one": dict.fromkeys(PARTS, one),
        "two": dict.fromkeys(PARTS, two),
        "at_once": dict.fromkeys(PARTS, one * 1.1),
        **{"spread": 0.0, "start": 0.0, "flops": 1e12, "operators": 1000.0},
        **{"parameters": 1e6, "batch": 4},
    }
    return Experiment("some", **{**values, **changes})


def test_one_and_two_threads_give_what_was_measured():
    some = experiment(1.0, 0.6)
    assert some.on_threads(1) == pytest.approx(some.one)
    assert some.on_threads(2) == pytest.approx(some.two)
    # 0.2 s are serial, and 0.8 s are shared by 64.
    assert some.on_threads(64)["optics"] == pytest.approx(0.2 + 0.8 / 64)


def test_no_part_gains_more_than_its_threads_or_loses_by_them():
    assert experiment(1.0, 0.3).on_threads(64)["optics"] == pytest.approx(1.0 / 64)
    assert experiment(1.0, 1.4).on_threads(64)["optics"] == 1.0


def test_a_gpu_is_as_slow_as_its_launches_or_its_arithmetic():
    launched = experiment(flops=1e9).on_gpus(1, DEFAULTS)
    computed = experiment(operators=1.0).on_gpus(1, DEFAULTS)
    assert launched["launches"] == pytest.approx(1000 * DEFAULTS["gpu-launch"])
    assert computed["network"] == pytest.approx(1e12 / (0.3 * 67e12))
    assert launched["gradients"] == 0.0 < experiment().on_gpus(8, DEFAULTS)["gradients"]


def test_workers_that_keep_up_cost_nothing():
    one = {**dict.fromkeys(PARTS, 0.0), "data": 1.0}
    assert experiment(one=1.0).on_gpus(1, DEFAULTS)["data"] > 0.0
    enough = {**DEFAULTS, "workers": 1e4}
    assert Experiment(**{**vars(experiment()), "one": one}).on_gpus(1, enough)["data"] == 0.0


def test_the_page_has_the_tables_of_the_measured_numbers():
    file = ROOT / "docs" / "scaling_measured.json"
    page = (ROOT / "docs" / "scaling.md").read_text(encoding="utf-8").splitlines()
    for line in show(json.loads(file.read_text(encoding="utf-8")), DEFAULTS):
        assert line in page, line


def test_what_grows_is_told_from_what_does_not():
    steps = np.arange(100.0, 1100.0, 100.0)
    flat = np.stack([steps, 900.0 + (steps > 150), 0.0 * steps, 0.0 * steps + 8, 0 * steps + 2], 1)
    assert Course("camera", flat).is_flat()
    for column, by in ((1, 0.01 * steps), (2, 0.01 * steps), (3, steps > 900), (4, steps > 900)):
        grown = flat.copy()
        grown[:, column] += by
        assert not Course("camera", grown).is_flat(), column
    rising = np.stack([steps, 0.01 * steps, *(0.0 * flat[:, 2:].T)], 1)
    assert Course("camera", rising).slope("memory_mb") == pytest.approx(10.0)


def test_what_is_measured_of_this_process_is_there():
    now = measured()
    assert now["memory_mb"] > 50 and now["files"] >= 3 and now["threads"] >= 1
    with open("/dev/null"):
        assert measured()["files"] == now["files"] + 1


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_as_long_as_asked(kind):
    assert sum("1000" in o or "=100" in o for o in overrides_of(kind, 1000)) >= 1
