"""Values of a configuration are compared with the type hints of what takes them."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import pytest
import torch

from dolens.errors import InputError
from dolens.typed_values import check_type, parameters_of

TAKEN = [
    (1, int), (1, float), (1.5, float), (math.inf, float), (True, bool), ("x", str), ("x", Path),
    (None, int | None), ([1, 2], Sequence[float]), ([1, 2], tuple[float, float]),
    ([1, 2, 3], tuple[int, ...]), ([[0, 1]], Sequence[Sequence[float]]),
    ({"a": 1}, Mapping[str, Any]),
    ("a", Literal["a", "b"]), (1, float | str), (3, Any), (3, torch.Tensor), (torch.zeros(1), int),
    ([], Sequence[int]),
]  # fmt: skip
REFUSED = [
    ("abc", float, "'abc'; allowed: a number"),
    (math.nan, float, "nan; allowed: a number"),
    (True, float, "true; allowed: a number"),
    (1.5, int, "1.5; allowed: an integer"),
    (True, int, "true; allowed: an integer"),
    (1, bool, "1; allowed: true or false"),
    (3, str, "3; allowed: a text"),
    (None, float, "null; allowed: a number"),
    ([1], float | None, "[1]; allowed: a number or null"),
    (3, Sequence[float], "3; allowed: a list, each a number"),
    ([[]], Sequence[float], "[[]]; allowed: a list, each a number"),
    ([1, 2, 3], tuple[float, float], "[1, 2, 3]; allowed: a list, each a number"),
    ([], Mapping[str, Any], "[]; allowed: a mapping"),
    ({"a": "b"}, Mapping[str, float], "{'a': 'b'}; allowed: a mapping"),
    ("c", Literal["a", "b"], "'c'; allowed: a, b"),
]


@pytest.mark.parametrize(("value", "hint"), TAKEN)
def test_what_a_hint_allows_is_taken(value, hint):
    check_type(value, hint, "key")


@pytest.mark.parametrize(("value", "hint", "said"), REFUSED)
def test_what_a_hint_does_not_allow_is_refused_by_its_key(value, hint, said):
    with pytest.raises(InputError) as error:
        check_type(value, hint, "key")
    assert str(error.value) == f"key: {said}"


def test_parameters_are_those_of_a_constructor():
    adam = parameters_of(torch.optim.Adam)
    assert adam.hints["maximize"] is bool and adam.closed
    assert "self" not in adam.hints
    assert not parameters_of(dict).closed  # takes any name
