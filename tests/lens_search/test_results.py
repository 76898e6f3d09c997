"""The results of a search: files that read back, a page that needs nothing else, and pictures."""

import copy
import re

import pytest
import torch

from dolens import load_lens
from dolens.errors import InputError
from dolens.lens_search.form_report import (
    SUFFIXES,
    element_powers,
    glasses_text,
    lens_sensitivity,
    powers_text,
    report_form,
    write_form,
)
from dolens.lens_search.forms import FoundLens, distinct
from dolens.lens_search.page import Pictures, write_page
from dolens.lens_search.search_report import search_course, sections_figure, start_map
from dolens.lens_search.verification import Requirements
from tests.lens_page.conftest import Page


def test_the_usual_tolerances_make_a_lens_worse(triplet):
    found = lens_sensitivity(triplet)
    assert found.nominal_um < found.expected_um
    assert found.nominal_um < found.ninety_percent_um < 3.0 * found.expected_um
    # The flint of a triplet is known for it.
    assert found.worst == "element 3–4 tilt"
    assert 0.0 < found.worst_share <= 1.0
    assert "0.02 mm" in found.tolerances


def test_a_form_is_said_in_signs_of_powers(triplet):
    assert powers_text(triplet) == "+ − | +"
    gauss = load_lens("double_gauss").requires_grad_(False)
    assert powers_text(gauss) == "+ (+ −) | (− +) +"
    assert glasses_text(gauss).startswith("2 × 1.670/47.1, 1.699/30.1")
    front, flint, back = element_powers(triplet)
    assert flint.power < -1.0 < 1.0 < front.power and (front.first, back.first) == (1, 5)


def test_files_of_every_format_are_written_and_what_cannot_hold_a_lens_is_named(triplet, tmp_path):
    found = write_form(triplet, tmp_path, 3)
    assert [file.path.suffix for file in found] == list(SUFFIXES)
    for file in found:
        assert file.written and file.exact and file.path.name == f"form_03{file.path.suffix}"
        again = load_lens(file.path)
        assert torch.equal(
            again.surfaces["1"].curvature.detach(), triplet.surfaces["1"].curvature.detach()
        )
    freeform = load_lens("wavefront_coding").requires_grad_(False)
    refused = [file for file in write_form(freeform, tmp_path, 4) if not file.written]
    for file in refused:
        assert not file.path.exists() and len(file.changes) == 1
        assert file.path.name in file.changes[0]
    with pytest.raises(InputError, match="cannot be written"):
        (tmp_path / "file").write_text("")
        write_form(triplet, tmp_path / "file", 1)


def test_the_results_of_a_search(triplet, tmp_path):
    other = copy.deepcopy(triplet)
    other.surfaces["3"].curvature.fill_(-0.03)
    lenses = [
        *(FoundLens(triplet, 10.0, (8.0, 10.0, 12.0), 5), FoundLens(triplet, 11.0, (9, 11, 13), 9)),
        FoundLens(other, 50.0, (40.0, 50.0, 60.0), 2, ("start 2", "<inserted> at 3")),
    ]
    forms = distinct(lenses)
    assert [form.places for form in forms] == [(0, 1), (2,)]
    required = Requirements(50.0, total_track=65.0, back_focus=45.0, vignetting=0.5)
    reports = [
        report_form(form.best, rank, required, tmp_path, len(form.starts), len(form.members))
        for rank, form in enumerate(forms, 1)
    ]
    pictures = Pictures(sections_figure(reports, "Triplets"), None)
    write_page(reports, tmp_path, "Triplets & more", [("F/", "5")], pictures, len(forms))
    assert [report.powers for report in reports] == ["+ − | +", "+ − | +"]
    assert "back focus" in reports[0].broken and not reports[0].problems
    text = (tmp_path / "forms.html").read_text(encoding="utf-8")
    page = Page(text)
    assert not any("src" in given for tags in page.named.values() for given in tags)
    assert not re.search(r"https?://|@import", text)
    assert "Triplets &amp; more" in text and "&lt;inserted&gt; at 3" in text
    outside = {link for link in page.links if not link.startswith("#")}
    assert {f"form_0{n}{suffix}" for n in (1, 2) for suffix in SUFFIXES} == outside
    assert all((tmp_path / link).is_file() for link in outside)
    for link in page.links:
        assert not link.startswith("#") or f'id="{link[1:]}"' in text
    assert "back focus</span>" in text  # red, with the sign of what is not kept
    assert sections_figure([]) is None


def test_forms_near_the_best_so_far_are_counted_over_time():
    course = search_course([4.0, 1.0, 2.0, 3.0], [1.0, 2.0, 2.4, 2.6], [3, 0, 1, 2])
    assert course.seconds == (1.0, 2.0, 3.0, 4.0)
    assert course.best == (2.0, 2.0, 2.0, 1.0)
    # 2.6 is more than a quarter above 2; at last all others are far above 1.
    assert course.forms == (1, 2, 2, 1)
    with pytest.raises(InputError, match="as many of each"):
        search_course([1.0], [1.0, 2.0], [0])


def test_a_map_of_starts_shows_where_they_differ_most():
    along = torch.linspace(-1.0, 1.0, 9, dtype=torch.float64)
    features = torch.stack([3.0 * along, along.square(), -3.0 * along], 1)
    found = start_map(features, ["a", "b", "c"])
    assert found.labels == ("0.71 a − 0.71 c", "1.00 b")
    assert found.share == pytest.approx(1.0)
    assert float((found.points[1:, 0] > found.points[:-1, 0]).double().mean()) == 1.0
    with pytest.raises(InputError, match="two features"):
        start_map(features[:, :1], ["a"])
