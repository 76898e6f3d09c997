"""The page of a search says how many starts each form has."""

import torch

from dolens import load_lens
from dolens.lens_search.finds import Course, starts_and_designs
from dolens.lens_search.forms import FoundLens


def test_starts_and_designs_of_a_form_are_counted():
    course = Course(
        seconds=torch.arange(5.0),
        merits=torch.tensor([9.0, 7.0, 7.5, 7.2, 8.0], dtype=torch.float64),
        forms=torch.tensor([2, 0, 0, 0, 1]),
        starts=torch.tensor([4, 6, 6, 3, 6]),
    )
    lens = load_lens("cooke_triplet")
    assert starts_and_designs(course, FoundLens(lens, 7.0, (7.0,), 6)) == (2, 3)
    assert starts_and_designs(course, FoundLens(lens, 8.0, (8.0,), 6)) == (1, 1)
