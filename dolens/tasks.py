"""Independent tasks are mapped by a function that decides where they run.

What loops over lenses or measurements takes a `TaskMap` and leaves the loop to it:

    for found in map_tasks(trace_one, lenses, "lenses"):
        ...

`in_turn` runs tasks where it is called.  `dolens.experiments.workers` has maps whose tasks run in
other processes; for those the function and the tasks must be picklable.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol

from dolens.errors import InputError, one_line
from dolens.stages import stage


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
