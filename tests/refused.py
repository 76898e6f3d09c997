"""Errors of users are refused in one line."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from dolens import InputError


@contextmanager
def refused(said: str, begin: str = "") -> Iterator[None]:
    """What is done within is refused in one line that begins so and says this."""
    with pytest.raises(InputError) as error:
        yield
    message = str(error.value)
    assert message.startswith(begin)
    assert said in message
    assert "\n" not in message
