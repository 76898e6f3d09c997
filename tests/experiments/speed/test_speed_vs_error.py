"""Speed against error: what the table holds, and that it can be believed."""

import math
import time

import pytest
import torch

from dolens.experiments.speed.renders import by_turns, peak_megabytes
from dolens.plotting import Point, pareto_front
from tests.experiments.tiny_experiment import QUIET

SMALL = [
    "experiment=speed_vs_error",
    "pixels=32",
    "pupil_samples=[1,4,7]",
    "fields=[1]",
    "tolerances=[4.0]",
    "reference_samples=12",
    "rays=400",
    "seconds=0.0",
    "objective=error/auto_4/wavefront_coding",
    "~scenes.nikon",
    "~scenes.cooke_triplet",
    "~scenes.large_fov_doublet",
    QUIET,
]


def test_the_table_holds_every_part_and_its_numbers_hang_together(trained):
    found = trained(*SMALL)
    rows, metrics = found.table("speed_vs_error"), found.metrics
    assert {row["part"] for row in rows} == {"trace", "psf", "render"}
    renders = {row["setting"]: row for row in rows if row["part"] == "render"}
    errors = [float(renders[f"{n} rays"]["error_grey_levels"]) for n in (1, 16, 49)]
    # Stratified rays: noise falls faster than their number's root.
    assert errors[0] > 3.0 * errors[1] > 3.0 * errors[2]
    assert all(float(row["with_gradient_s"]) > 0.0 for row in renders.values())
    front = [row for row in renders.values() if row["on_front"] == "1"]
    fastest = min(renders.values(), key=lambda row: float(row["with_gradient_s"]))
    assert fastest in front
    auto = renders["auto, 4 grey levels"]
    assert float(auto["error_grey_levels"]) <= 4.0 + 3.0 * float(auto["error_uncertainty"])
    ratio = float(renders["49 rays"]["with_gradient_s"]) / float(auto["with_gradient_s"])
    assert metrics["cost/supplement_over_auto_4/wavefront_coding"] == pytest.approx(ratio, rel=1e-3)
    assert metrics["gradient/cosine_auto_4/wavefront_coding"] > 0.9
    gradient = {name: float(row["gradient_error"]) for name, row in renders.items()}
    assert 0.0 < gradient["auto, 4 grey levels"] < gradient["1 rays"]
    parts = ("trace", "psf", "render", "gradient")
    assert found.figures == {f"{part}_wavefront_coding" for part in parts}
    # Traces are as exact as their precision.
    traces = {r["setting"]: float(r["error_um"]) for r in rows if r["part"] == "trace"}
    assert traces["reference, float64"] == 0.0
    assert traces["cpu, float64"] < 1e-8
    assert 1e-8 < traces["cpu, float32"] < 0.1
    # Newton's error falls from step to step, until there is none.
    steps = [error for name, error in traces.items() if "Newton" in name]
    assert steps and steps == sorted(steps, reverse=True) and steps[-1] == 0.0


def test_the_front_holds_what_nothing_beats_in_both():
    """Cheaper and worse, or dearer and better; equal cost and a larger error is not on it."""
    points = [
        Point("a", 1.0, 9.0),
        Point("b", 2.0, 3.0),
        Point("c", 2.0, 4.0),
        Point("d", 3.0, 3.5),
        Point("e", 5.0, 1.0),
    ]
    assert [point.label for point in pareto_front(points)] == ["a", "b", "e"]


def test_times_are_medians_of_calls_that_take_turns():
    order = []

    def call(name, seconds):
        def made():
            order.append(name)
            time.sleep(seconds)

        return made

    times = by_turns({"slow": call("slow", 0.02), "fast": call("fast", 0.002)}, 0.0, rounds=3)
    assert order == ["slow", "fast"] * 4
    assert times["slow"] > times["fast"] > 0.0


def test_memory_is_what_tensors_hold_at_once():
    """Two of a million single numbers at a time, whatever was there before."""

    def two():
        one = torch.zeros(1_000_000)
        return one + 1.0

    assert peak_megabytes(two) == pytest.approx(8.0, rel=0.01)
    assert math.isfinite(peak_megabytes(lambda: None))


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("parts=[speed]", "parts: 'speed' is unknown"),
        ("+scenes.wavefront_coding.texture=none", "unknown key 'texture'"),
        ("scenes.wavefront_coding.variables=foo", "scenes.wavefront_coding.variables: "),
        ("scenes.wavefront_coding.variables=[abc]", "no parameter"),
    ],
)
def test_wrong_settings_are_named_by_their_key(refused, override, said):
    refused(said, *SMALL, override)
