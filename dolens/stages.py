"""Work that takes a while is named, so that a program around the library can show what it does.

The library says `with stage("planning"): ...` and prints nothing.  A program listens:

    with listening(lambda event: print(event.names, event.begins)):
        lens.trace(rays)

Listeners belong to the context (`contextvars`) in which they were added, and so to one thread.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import NamedTuple


class StageEvent(NamedTuple):
    """A stage begins or ends.

    Attributes:
        names: of the stage, behind those of the stages that it is a part of.
        begins: True at its beginning, False at its end.
    """

    names: tuple[str, ...]
    begins: bool


Listener = Callable[[StageEvent], None]

_listeners: ContextVar[tuple[Listener, ...]] = ContextVar("dolens_listeners", default=())
_names: ContextVar[tuple[str, ...]] = ContextVar("dolens_stages", default=())


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Tell listeners that a named piece of work begins and, however it goes, that it has ended.

    Args:
        name: what is done, in a few words, such as "planning the renderer"; a detail that
            changes stands behind a colon, as in "starts: 3 of 50".
    """
    names = (*_names.get(), name)
    token = _names.set(names)
    _tell(StageEvent(names, True))
    try:
        yield
    finally:
        _names.reset(token)
        _tell(StageEvent(names, False))


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Have a function called at the beginning and at the end of every stage.

    Args:
        listener: is called in the thread that does the work, and should return at once.
    """
    token = _listeners.set((*_listeners.get(), listener))
    try:
        yield
    finally:
        _listeners.reset(token)


def _tell(event: StageEvent) -> None:
    for listener in _listeners.get():
        listener(event)
