"""How well poses can be known, by arrangement, as a run."""

import pytest

from tests.experiments.tiny_experiment import QUIET

# Workers could take every task of these runs.
pytestmark = pytest.mark.usefixtures("pickled_tasks")

TINY = [
    "experiment=pose_bounds",
    "sensor.height=32",
    "sensor.width=32",
    "sensor.pixel_pitch=0.2208",
    "photons=100000",
    "imager.rays=8000",
    "imager.rim=0.01",
    QUIET,
]


def test_planes_part_what_one_image_cannot_and_a_common_shift_is_never_seen(trained):
    others = ["~five", "~arrangements.five_sources", "~arrangements.five_sources_three_planes"]
    objective = "objective=knowledge/three_planes/worst"
    found = trained(*TINY, *others, objective, "monte_carlo=25")
    metrics = found.metrics
    bounds = {(r["arrangement"], r["variable"]): r for r in found.table("bounds")}
    one, planes = "one_source", "three_planes"
    for name in ("sensor_distance", "sources.*.z", "elements.lens.tilt_x"):
        near, far = (float(bounds[(a, name)]["bound"]) for a in (planes, one))
        # The same light, shared among three images.
        assert near < 0.3 * far
    # One spot cannot tell a sensor that is farther from a source that is nearer.
    row = bounds[(one, "sensor_distance")]
    assert abs(float(row["correlation"])) > 0.99
    # Source, lens and sensor moving together along the axis change no image: the combination that
    # is not seen is (1, 1, 1) in mm.
    everything = "one_source_and_lens_shift"
    assert metrics[f"knowledge/{everything}/unseen"] == 1.0
    assert metrics[f"knowledge/{one}/unseen"] == 0.0
    first = next(r for r in found.table("eigenvectors") if r["arrangement"] == everything)
    moved = {
        "sensor_distance": 1.0 * float(first["sensor_distance"]),
        "sources.*.z": 10.0 * float(first["sources.*.z"]),
        "elements.lens.shift_z": 0.1 * float(first["elements.lens.shift_z"]),
    }
    size = moved["elements.lens.shift_z"]
    assert moved["sources.*.z"] == pytest.approx(size, rel=1e-3)
    # The lens goes towards the sensor as the sensor goes away with it.
    assert abs(moved["sensor_distance"]) == pytest.approx(abs(size), rel=1e-3)
    spreads = [v for k, v in metrics.items() if k.startswith(f"pose_spread_over_bound/{planes}")]
    assert len(spreads) == 8
    # Of 25 estimates each: a standard error of 0.14, and they go together.
    assert sum(spreads) / 8 == pytest.approx(1.0, abs=0.3)
    # A combination that cannot be seen at all has no corner.
    assert found.figures == {"knowledge", f"corner_{one}", f"corner_{planes}"}


BAD_INPUT = {
    "+arrangements.one_source.plane=[0]": "unknown key 'plane'; did you mean 'planes'?",
    "arrangements.one_source.sources=[]": (
        "arrangements.one_source: sources are missing; give one"
    ),
    "monte_carlo=1": "monte_carlo: 1; allowed: 0 for none, or 2 or more",
    "lens_dtype=float32": "poses are known in float64",
    "+variables.focus={}": "focus",
}


@pytest.mark.parametrize("override", BAD_INPUT)
def test_bad_input_gives_one_clear_line(refused, override):
    refused(BAD_INPUT[override], *TINY, override)
