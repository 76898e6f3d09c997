"""One line for each mistake: what was written, where, the nearest allowed name, and all of them."""

from dataclasses import dataclass

import pytest

from dolens.errors import InputError, check_choice, check_keys
from dolens.typed_values import call_with_settings


@dataclass(frozen=True)
class Ring:
    radius: float
    count: int = 6


def line(call, *arguments):
    with pytest.raises(InputError) as error:
        call(*arguments)
    return str(error.value)


def test_an_unknown_key_is_answered_with_the_nearest_one():
    said = line(check_keys, {"half_rang": 1.0}, ("half_range", "relative"), "tolerances.x")
    assert said == (
        "tolerances.x: unknown key 'half_rang'; did you mean 'half_range'? "
        "(allowed: half_range, relative)"
    )
    assert line(check_keys, ["zzz"], ("a", "b"), "x") == "x: unknown key 'zzz' (allowed: a, b)"
    assert line(check_keys, ["a"], (), "x") == "x: unknown key 'a' (allowed: none)"
    check_keys({"relative": True}, ("half_range", "relative"), "tolerances.x")


def test_an_unknown_word_is_answered_with_the_nearest_one():
    said = line(check_choice, "spot", ("spots", "wavefront"), "merit.quality")
    assert said == (
        "merit.quality: 'spot' is unknown; did you mean 'spots'? (allowed: spots, wavefront)"
    )
    assert line(check_choice, None, ("spots",), "x") == "x: 'None' is unknown (allowed: spots)"


def test_settings_are_the_arguments_of_what_they_make():
    assert call_with_settings(Ring, {"radius": 2.0}, "ring") == Ring(2.0)
    assert call_with_settings(Ring, {"count": 8}, "ring", 3.0) == Ring(3.0, 8)
    assert line(call_with_settings, Ring, {"radus": 2.0}, "ring") == (
        "ring: unknown key 'radus'; did you mean 'radius'? (allowed: radius, count)"
    )
    # What the program gives is not the user's to set.
    assert "unknown key 'radius'" in line(call_with_settings, Ring, {"radius": 1.0}, "ring", 2.0)
    assert line(call_with_settings, Ring, {}, "ring") == "ring: 'radius' is missing"
