"""A search for lenses as a run: what it leaves, and how it goes on where it was stopped."""

import csv
import json

import pytest
import torch
from tiny_experiment import figure_names

from dolens import InputError, load_lens
from dolens.experiments.running.training import run
from tests.experiments.conftest import composing

# Two lenses of one glass at f/6: forms are found from a few dozen starts.
SMALL = [
    "experiment=search_quartet",
    "specification.focal_length=50.0",
    "specification.f_number=6.0",
    "specification.fields=[0.0,10.0]",
    "specification.groups=[1,1]",
    "specification.stops=[1]",
    "specification.limits.back_focus=20.0",
    "specification.limits.track=120.0",
    "plan.starts=40",
    "plan.batch=20",
    "plan.finish_rounds=3",
    "plan.finish_iterations=15",
    "plan.escapes=1",
    "plan.parents=1",
    "forms=2",
    "+trainer.enable_progress_bar=false",
]


@pytest.fixture(scope="module")
def finished(root, tmp_path_factory):
    """One search, whose folder the tests share in their order."""
    parent = tmp_path_factory.mktemp("search")
    with composing(root, parent) as composed:
        objective = run(composed(*SMALL))
        yield objective, parent / "run", composed


def test_a_search_leaves_forms_files_tables_figures_and_a_page(finished):
    objective, folder, _ = finished
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["search/best_rms_spot_um"] == objective
    assert metrics["search/starts"] == 40.0
    assert metrics["search/distinct_forms"] >= 1.0
    # Real rays through the physical stop see the same lens.
    through = metrics["search/best_rms_spot_um_through_stop"]
    assert through == pytest.approx(objective, rel=0.02)
    assert figure_names(folder) >= {"forms", "starts"}
    assert (folder / "forms.html").stat().st_size > 1000
    with (folder / "forms.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) <= 2
    best = load_lens(folder / "forms" / "form_01.yaml", dtype=torch.float64)
    assert best.first_order(587.5618).efl.item() == pytest.approx(50.0, rel=1e-3)
    assert load_lens(folder / "lens" / "final.yaml").stop == best.stop


def test_a_search_that_was_stopped_goes_on_from_the_steps_that_are_kept(finished):
    _, folder, composed = finished
    steps = sorted((folder / "search").glob("step_*.pt"))
    assert len(steps) >= 3
    whole = json.loads((folder / "metrics.json").read_text())
    written = steps[0].stat().st_mtime_ns
    for step in steps[1:]:
        step.unlink()
    run(composed(*SMALL, "callbacks.pictures=null"))
    again = json.loads((folder / "metrics.json").read_text())
    searched = [name for name in whole if name.startswith("search/")]
    assert {name: again[name] for name in searched} == {name: whole[name] for name in searched}
    assert steps[0].stat().st_mtime_ns == written


def test_steps_of_another_search_are_refused(finished):
    *_, composed = finished
    with pytest.raises(InputError, match="another specification or plan"):
        run(composed(*SMALL, "specification.f_number=5.0"))


def test_a_wrong_number_is_said_in_one_line(finished):
    *_, composed = finished
    with pytest.raises(Exception, match="fields must begin with 0"):
        run(composed(*SMALL, "specification.fields=[3.0]", folder="other"))


def test_a_lens_that_a_search_would_not_read_is_refused(finished):
    *_, composed = finished
    with pytest.raises(InputError, match="lens: a search makes its own lens"):
        run(composed(*SMALL, "lens=cooke_triplet", folder="third"))


def test_a_single_element_has_forms_and_a_course_but_no_map_of_its_one_power(finished):
    _, folder, composed = finished
    single = ("specification.groups=[1]", "specification.limits.distortion=null")
    run(composed(*SMALL, *single, folder="single"))
    folder = folder.parent / "single"
    assert figure_names(folder) >= {"forms", "course"}
    assert "starts" not in figure_names(folder)
    assert load_lens(folder / "forms" / "form_01.yaml").surfaces
