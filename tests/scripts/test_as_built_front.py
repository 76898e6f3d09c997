"""Cameras that were judged as built are compared over the factor of their tolerances."""

import csv
import json
import sys

import pytest
import torch

from scripts import as_built_front
from scripts.as_built_front import factor_at, judged, worst_tenth


def run_folder(path, offset, lenses=20):
    """A run whose lens n has 20 + n dB in its worst view at factor 1, and 4 dB less at factor 4."""
    path.mkdir()
    with (path / "made_crops.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["factor", "lens", "photograph", "psnr_db/near", "psnr_db/far"])
        for factor in (1, 4):
            for lens in range(lenses):
                for photograph, error in (("cat", -1.0), ("cat", 1.0), ("dog", 0.0)):
                    worst = 20.0 + lens - (4.0 if factor == 4 else 0.0) + error + offset
                    table.writerow([factor, lens, photograph, worst + 3.0, worst])
    (path / "metrics.json").write_text(json.dumps({"made/psnr_db/as_drawn": 30.0 + offset}))
    return path


def test_the_worst_tenth_is_that_of_the_worst_views_of_the_means_over_crops(tmp_path):
    found = judged([run_folder(tmp_path / name, offset) for name, offset in (("a", 0), ("b", 1))])
    # Two of twenty lenses, 20 and 21 dB, and seeds 1 dB apart.
    assert float(worst_tenth(found.by_factor[1.0])) == pytest.approx(21.0)
    assert float(worst_tenth(found.by_factor[4.0])) == pytest.approx(17.0)
    assert found.photograph.tolist() == [0, 0, 1]
    assert found.drawn == pytest.approx(30.5)


def test_a_gain_that_all_lenses_share_has_no_width(tmp_path, capsys, monkeypatch):
    one, other = (run_folder(tmp_path / n, offset) for n, offset in (("a", 0.0), ("b", 2.0)))
    figure = tmp_path / "front.png"
    monkeypatch.setattr(as_built_front, "_RESAMPLES", 40)
    arms = ["--arm", "drawn", str(one), "--arm", "built", str(other), "--figure", str(figure)]
    monkeypatch.setattr(sys, "argv", ["as_built_front.py", *arms])
    as_built_front.main()
    printed = capsys.readouterr().out
    assert printed.count("+2.00 [+2.00, +2.00]") == 2
    # 2 dB are half the way from factor 1 to factor 4 in logarithms: factor 2.
    assert "built at 4 is 'drawn' at 2.00: 2.00×" in printed
    assert figure.stat().st_size > 5000


def test_a_factor_is_found_between_points_and_nowhere_else():
    curve = {1.0: 30.0, 10.0: 20.0}
    assert factor_at(curve, 25.0) == pytest.approx(10.0**0.5)
    assert torch.isnan(torch.tensor(factor_at(curve, 31.0)))
    assert torch.isnan(torch.tensor(factor_at(curve, 19.0)))
