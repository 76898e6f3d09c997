"""A search for lenses as a run: what it leaves, and how it goes on where it was stopped."""

import pytest
import torch
from hydra.errors import InstantiationException

from dolens import InputError, load_lens
from dolens.experiments.running.training import run
from tests.experiments.conftest import composing
from tests.experiments.runs import Finished
from tests.experiments.tiny_experiment import QUIET, UNPICTURED

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
    QUIET,
]


@pytest.fixture(scope="module")
def finished(root, tmp_path_factory):
    """One search, whose folder the tests share in their order."""
    parent = tmp_path_factory.mktemp("search")
    with composing(root, parent) as composed:
        yield Finished(parent / "run", run(composed(*SMALL))), composed


def test_a_search_leaves_forms_files_tables_figures_and_a_page(finished):
    found, _ = finished
    folder, metrics, objective = found.folder, found.metrics, found.objective
    assert metrics["search/best_rms_spot_um"] == objective
    assert metrics["search/starts"] == 40.0
    assert metrics["search/distinct_forms"] >= 1.0
    # Real rays through the physical stop see the same lens.
    through = metrics["search/best_rms_spot_um_through_stop"]
    assert through == pytest.approx(objective, rel=0.02)
    assert found.figures >= {"forms", "starts"}
    assert (folder / "forms.html").stat().st_size > 1000
    assert len(found.table("forms")) <= 2
    best = load_lens(folder / "forms" / "form_01.yaml", dtype=torch.float64)
    assert best.first_order(587.5618).efl.item() == pytest.approx(50.0, rel=1e-3)
    assert found.lens().stop == best.stop


def test_a_search_that_was_stopped_goes_on_from_the_steps_that_are_kept(finished):
    whole, composed = finished
    steps = sorted((whole.folder / "search").glob("step_*.pt"))
    assert len(steps) >= 3
    searched = {name: v for name, v in whole.metrics.items() if name.startswith("search/")}
    written = steps[0].stat().st_mtime_ns
    for step in steps[1:]:
        step.unlink()
    run(composed(*SMALL, UNPICTURED))
    again = Finished(whole.folder).metrics
    assert {name: again[name] for name in searched} == searched
    assert steps[0].stat().st_mtime_ns == written


@pytest.mark.parametrize(
    ("override", "folder", "said"),
    [
        ("specification.f_number=5.0", "run", "another specification or plan"),
        ("specification.fields=[3.0]", "other", "fields must begin with 0"),
        ("lens=cooke_triplet", "third", "lens: a search makes its own lens"),
    ],
)
def test_another_search_and_wrong_settings_are_refused(finished, override, folder, said):
    _, composed = finished
    with pytest.raises((InputError, InstantiationException), match=said):
        run(composed(*SMALL, override, folder=folder))


def test_a_single_element_has_forms_and_a_course_but_no_map_of_its_one_power(finished):
    whole, composed = finished
    single = ("specification.groups=[1]", "specification.limits.distortion=null")
    run(composed(*SMALL, *single, folder="single"))
    found = Finished(whole.folder.with_name("single"))
    assert found.figures >= {"forms", "course"}
    assert "starts" not in found.figures
    assert load_lens(found.folder / "forms" / "form_01.yaml").surfaces
