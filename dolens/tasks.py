"""Work: independent tasks, mapped by a function that decides where they run, and named stages."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple, Protocol

from dolens.errors import InputError, one_line


class TaskMap(Protocol):
    """Yields a function's results for a sequence of tasks, in the tasks' order.

    A result is yielded as soon as it and all before it are known, so that a caller can keep those
    before a task that fails.
    """

    def __call__(
        self, function: Callable[[Any], Any], tasks: Sequence[Any], name: str
    ) -> Iterator[Any]:
        """Map a pure function over tasks.

        Args:
            function: of one task; its result depends on the task alone.
            tasks: its arguments, one each.
            name: what the tasks are, as in messages and progress: "lenses".

        Raises:
            InputError: a task raised it; the message names the task.
            TaskError: a task raised anything else, or could not be finished.
        """


class TaskError(RuntimeError):
    """A task failed; the message is one line that names it, and the cause is the task's error."""


def in_turn(function: Callable[[Any], Any], tasks: Sequence[Any], name: str) -> Iterator[Any]:
    """Map a function over tasks here, one after the other; see `TaskMap`."""
    for number, task in enumerate(tasks):
        label = task_label(name, number, len(tasks))
        with stage(label):
            try:
                found = function(task)
            except Exception as error:
                raise error_of_task(label, error) from error
        yield found


def task_label(name: str, number: int, count: int) -> str:
    """Return what a task is called; numbers begin at 0, and what is read at 1."""
    return f"{name}: {number + 1} of {count}"


def error_of_task(label: str, error: BaseException) -> Exception:
    """Return the error that a map raises in the place of a task's own: one line with its name."""
    if isinstance(error, InputError):
        return InputError(one_line(f"{label}: {error}"))
    return TaskError(one_line(f"{label}: {type(error).__name__}: {error}"))


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
