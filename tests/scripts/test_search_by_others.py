"""scripts/search_by_others.py: a search's merit for SciPy, and the table of runs."""

import numpy as np
import pytest

from scripts.search_by_others import METHODS, Run, Task, kept, searched, table


def test_a_short_search_counts_its_lenses_within_the_bounds():
    of = Task.of("search_triplet", 2)
    bounds = of.bounds(5.0)
    low, high = np.array(bounds).T
    surfaces = of.merit.arrangement.surfaces
    assert high[:surfaces] == pytest.approx(5.0) and low[:surfaces] == pytest.approx(-5.0)
    run = searched(of, bounds, Run("search_triplet", "random restarts", 0, 0.2, 0, None, None))
    assert run.method in METHODS and run.lenses > 1
    assert (low <= run.values).all() and (run.values <= high).all()


def test_runs_are_kept_and_tabled(tmp_path):
    for seed, spot in enumerate((10.92, None, 9.5)):
        Run("search_x", "a method", seed, 115.0, 1200, [0.5], spot).keep(tmp_path)
    Run("search_y", "a method", 0, 1.0, 1, None, None).keep(tmp_path)
    runs = kept(tmp_path, "search_x")
    assert [run.seed for run in runs] == [0, 1, 2]
    assert runs[0].path(tmp_path).name == "search_x_a_method_0.json"
    last = table(runs).splitlines()[-1]
    assert last == "| a method | 3 | 115 | 1.2e+03 | 10.92, none, 9.5 |"
