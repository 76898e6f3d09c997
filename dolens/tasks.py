"""Work: independent tasks, mapped by a function that decides where they run, and named stages."""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
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


@dataclass(frozen=True)
class OwnThreads:
    """Runs tasks in threads, each with one thread of torch's: for tasks that leave Python's lock to
    others most of the time.

    Results are those of one thread, to the bit.

    Attributes:
        threads: how many; None: as many as torch is set to use.
    """

    threads: int | None = None

    @contextmanager
    def open(self) -> Iterator[TaskMap]:
        """Give the map; its threads end with the context."""
        import torch  # what names a stage need not wait for it

        before = torch.get_num_threads()
        count = before if self.threads is None else self.threads
        pool = ThreadPoolExecutor(
            count, "dolens-task", initializer=torch.set_num_threads, initargs=(1,)
        )
        try:

            def map_tasks(
                function: Callable[[Any], Any], tasks: Sequence[Any], name: str
            ) -> Iterator[Any]:
                return _in_order(pool, count, function, tasks, name)

            yield map_tasks
        finally:
            # Whatever stopped the caller, tasks that have not begun do not begin.
            pool.shutdown(wait=True, cancel_futures=True)
            torch.set_num_threads(before)


def _in_order(
    pool: ThreadPoolExecutor,
    count: int,
    function: Callable[[Any], Any],
    tasks: Sequence[Any],
    name: str,
) -> Iterator[Any]:
    """Yield results in the tasks' order; few tasks wait in the pool, so that it can be stopped."""
    waiting: deque[Future[Any]] = deque()
    submitted = 0
    for number in range(len(tasks)):
        while submitted < len(tasks) and len(waiting) < 2 * count:
            waiting.append(pool.submit(function, tasks[submitted]))
            submitted += 1
        label = task_label(name, number, len(tasks))
        with stage(label):
            try:
                found = waiting.popleft().result()
            except Exception as error:
                raise error_of_task(label, error) from error
        yield found
