"""A search in one call finds what the search of the command finds, and says what it may not do."""

import pytest
import torch

import dolens
from dolens import InputError
from dolens.lens_search.finds import Finds
from dolens.lens_search.search import SearchPlan, search
from dolens.lens_search.short_search import specification
from dolens.lens_search.specification import Limits, Specification
from dolens.tasks import in_turn

GLASSES = ["1.6204/60.31", "1.6200/36.37", "1.6204/60.31"]


@pytest.fixture(scope="module")
def found():
    return dolens.search(
        *(50, 4.9, 20, 3),
        glasses=GLASSES,
        limits={"back_focus": 20, "track": 70},
        starts=60,
        batch=15,
        forms=3,
        escapes=0,
    )


def test_the_best_lens_is_that_of_the_search_of_the_same_plan(found):
    """As conf/experiment/search_triplet.yaml has it, by the tasks of the experiment."""
    limits = Limits(
        glass=(1.0, 10.0), air=(0.1, 20.0), glass_edge=0.5, back_focus=20.0, track=70.0,
        distortion=0.02,
    )  # fmt: skip
    asked = Specification(
        focal_length=50.0,
        f_number=4.9,
        fields=[0.0, 14.0, 20.0],
        wavelengths=[656.2725, 587.5618, 486.1327],
        groups=(1, 1, 1),
        glasses=tuple(GLASSES),
        limits=limits,
    )
    assert found.specification == asked
    plan = SearchPlan(starts=60, batch=15, escapes=0)
    finds = Finds(asked, plan)
    for step in search(asked, plan, in_turn):
        finds.add(step, 0.0)
    finds.rank(3)
    assert len(found) == len(finds.found) > 0
    for form, other in zip(found, finds.found, strict=True):
        assert form.found.rms_spot_um == other.rms_spot_um
        curvatures = form.lens.variables(["surfaces.*.curvature"])
        expected = other.lens.variables(["surfaces.*.curvature"])
        assert all(torch.equal(value, expected[name]) for name, value in curvatures.items())


def test_forms_are_ordinary_lenses_that_do_what_was_asked(found, tmp_path):
    best = found.best
    assert best.first_order(587.5618).efl.item() == pytest.approx(50.0, rel=1e-3)
    assert abs(best.first_order(587.5618).f_number.item()) == pytest.approx(4.9, rel=0.03)
    assert best.fields.points == ((0.0, 0.0), (0.0, 14.0), (0.0, 20.0))
    assert [form.number for form in found] == [1, 2, 3][: len(found)]
    assert found[0].found.mean_rms_spot_um == min(form.found.mean_rms_spot_um for form in found)
    better = best.optimize(["surfaces.*.curvature"], keep={"efl": 50}, iterations=2)
    assert better.optimization.reached <= better.optimization.merit[0]
    text, page = repr(found), found._repr_html_()
    for part in ("3 elements, f = 50 mm, F/4.9, ±20°", GLASSES[0]):
        assert part in text and part in page
    assert found.figure()._repr_png_() and found.course_figure()._repr_png_()
    assert {path.suffix for path in found.save(tmp_path / "forms").iterdir()} >= {".yaml", ".zmx"}


def test_a_search_ends_when_its_time_is_over():
    """One task is made at least: a hundred starts, and no more of ten thousand."""
    short = dolens.search(50, 6, 5, 1, glasses=["1.5168/64.17"], starts=10_000, seconds=1e-3)
    assert sum(len(features) for features in short.finds.features.values()) == 100


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"efl": -50}, "efl: -50; allowed: a positive focal length"),
        ({"efl": "50mm"}, "efl: '50mm'; allowed: a number"),
        ({"f_number": 0}, "f_number must be positive"),
        ({"field": 95}, "field: 95; allowed: 0 to below 80 degrees"),
        ({"elements": 0}, "elements: 0; allowed: a number of 1 or more"),
        ({"elements": "four"}, "elements: 'four'; allowed"),
        ({"glasses": ["N-BK7", "N-BK7"]}, "glasses: one for all or 3"),
        ({"glasses": ["N-XYZ"]}, "N-XYZ"),
        ({"limits": {"trck": 70}}, "limits: unknown key 'trck'; did you mean 'track'"),
        ({"limits": {"track": -1}}, "limits.track must be positive"),
        ({"starts": 0}, "starts: 0; allowed: an integer of 1 or more"),
        ({"seconds": -1}, "seconds: -1; allowed: a positive number, or None"),
        ({"start": 3}, r"search\(\): unknown key 'start'"),
    ],
)
def test_what_cannot_be_searched_is_refused_in_one_line(given, message):
    usual = {"efl": 50, "f_number": 4.9, "field": 20, "elements": 3, "glasses": GLASSES}
    with pytest.raises(InputError, match=message):
        dolens.search(**{**usual, **given})


def test_all_fields_that_count_are_given_at_once_and_every_surface_has_an_asphere():
    angles = (0, 12, 20, 26)
    asked = specification(4.0, 2.8, angles, 3, ["1.53/55"], (587.6,), {}, aspheres=2)
    assert (asked.fields, asked.asphere_terms) == (angles, (2,))
    with pytest.raises(InputError, match="fields must begin with 0 degrees"):
        specification(4.0, 2.8, (12, 20), 3, ["1.53/55"], (587.6,), {})
    with pytest.raises(InputError, match="aspheres: -1; allowed: an integer of 0 or more"):
        specification(4.0, 2.8, 20, 3, ["1.53/55"], (587.6,), {}, aspheres=-1)
