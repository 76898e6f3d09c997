"""Room for the calls of a test in Python's own stack.

Python takes the frames of calls from pieces of 16 KB, and gives a piece back when it is empty.
A loop whose calls begin just at the end of a piece therefore takes and returns memory in every
turn, at 10 µs and more: tests stand so deep in pytest's calls that compiling a kernel did so, for a
fifth of its time.
"""

from collections.abc import Callable

import pytest
from _pytest.runner import runtestprotocol

_NUMBERS = 33_000  # more than half of 512 KB, of which the calls get what is left


def with_room(work: Callable[[], object]) -> object:
    """Call a function behind a frame for which Python takes a piece of 512 KB."""
    return work()


with_room.__code__ = with_room.__code__.replace(co_stacksize=_NUMBERS)


def run_with_room(item: pytest.Item, nextitem: pytest.Item | None) -> bool:
    """Run a test as pytest does by itself, with room."""
    about = {"nodeid": item.nodeid, "location": item.location}
    item.ihook.pytest_runtest_logstart(**about)
    with_room(lambda: runtestprotocol(item, nextitem=nextitem))
    item.ihook.pytest_runtest_logfinish(**about)
    return True
