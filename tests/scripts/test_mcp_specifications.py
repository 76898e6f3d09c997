"""Specifications are met by the published lenses that they come from, and results are counted."""

import json

import pytest

from dolens import load_lens
from dolens.analysis.conditions import conditions
from dolens.analysis.spot_diagram import spot_diagram
from scripts.mcp_specifications import best_focus, report, scaled, specification

NAME = "published/tessar_laikin_p63"


@pytest.fixture(scope="module")
def lens():
    return load_lens(NAME)


def test_a_lens_twice_as_large_does_the_same_on_twice_the_scale(lens):
    large = scaled(lens, 2.0)
    assert large.first_order().efl.item() == pytest.approx(2.0 * lens.first_order().efl.item())
    one, two = (spot_diagram(each, conditions(each), 400) for each in (lens, large))
    assert two.polychromatic_rms.tolist() == pytest.approx((2.0 * one.polychromatic_rms).tolist())


def test_the_published_lens_keeps_its_own_specification(lens):
    asked = specification(NAME, lens, 50.0, 1.25, 0.8)
    assert asked["published_breaks"] == [] and asked["elements"] == [1, 1, 2]
    first = lens.first_order(lens.primary_wavelength)
    assert asked["f_number"] == pytest.approx(1.25 * first.f_number.item())
    assert asked["field"] == pytest.approx(0.8 * 20.5)


def test_the_best_focus_is_that_of_a_lens_whose_sensor_is_there(lens):
    spot, refocused = best_focus(scaled(lens, 1.0))
    where = conditions(refocused)
    found = 1e3 * spot_diagram(refocused, where, 1000).polychromatic_rms.mean().item()
    before = 1e3 * spot_diagram(lens, conditions(lens), 1000).polychromatic_rms.mean().item()
    assert found == pytest.approx(spot, rel=1e-6) and found < before


def test_the_better_of_two_rounds_counts_and_every_refusal_is_listed(tmp_path):
    asked = {"of": NAME, "elements": [1, 1, 2], "efl": 50.0, "f_number": 4.0, "field": 20.0}
    asked = [{"number": n, "published_breaks": [], **asked} for n in (1, 2)]
    (tmp_path / "specifications.json").write_text(json.dumps(asked))
    good = {"meets_all": True, "broken": [], "efl_error_percent": -0.2, "over_limit": 0.5}
    rows = [
        {"number": 1, "turn": 0, **good, "yield_percent": 80.0},
        {"number": 1, "turn": 1, **good, "yield_percent": 95.0},
        {"number": 2, "turn": 0, "meets_all": False, "broken": ["no lens"]},
    ]
    rows = [{**row, "seconds": 60.0, "calls": 2, "refusals": ["none found"]} for row in rows]
    (tmp_path / "results.jsonl").write_text("\n".join(json.dumps(row) for row in rows))
    text = report(tmp_path)
    assert "| all | 2 | 1 | 1 | 0 | 0 | 0.2 % | 0.50 | 1.5 |" in text
    assert "- 3 × none found" in text and "Refusals, of 6 calls:" in text
    assert "- 2, of `published/tessar_laikin_p63`, f = 50 mm, F/4, ±20°: no lens" in text
