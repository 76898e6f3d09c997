"""Independent tasks run in this process, in its threads, or in processes of a Ray cluster."""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import torch

from dolens.errors import InputError
from dolens.experiments.workers.ray_cluster import RayWorkers
from dolens.tasks import TaskMap, error_of_task, in_turn, stage, task_label

AUTO = "auto"


class Workers(Protocol):
    """Gives a map of tasks for as long as it is open."""

    def open(self) -> AbstractContextManager[TaskMap]:
        """Return a context in which tasks can be mapped; its end ends all that was started."""


def workers_of(setting: int | str | None) -> Workers:
    """Return the workers that a setting describes.

    Args:
        setting: null: this process, with torch's threads; 0: this process, one thread a task; a
            number: as many processes of a Ray cluster on this machine; `auto`: a Ray cluster that
            runs already.  Results of 0, of every other number and of `auto` are the same to the
            bit.

    Raises:
        InputError: anything else.
    """
    if setting is None:
        return OwnProcess()
    if setting == AUTO:
        return RayWorkers(None)
    # A bool is an int to Python, and none to a user.
    if type(setting) is not int or setting < 0:
        raise InputError(
            f"workers: {setting!r}; allowed: null, 0 for this process, a number of processes, or "
            f"{AUTO} for a Ray cluster that runs already"
        )
    return OwnProcess(threads=1) if setting == 0 else RayWorkers(setting)


@dataclass(frozen=True)
class OwnProcess:
    """Runs tasks here, one after the other.

    Attributes:
        threads: torch's, of each task; None: as many as there are.  Sums that are split among
            threads have last bits that depend on their number.
    """

    threads: int | None = None

    @contextmanager
    def open(self) -> Iterator[TaskMap]:
        """Give the map; there is nothing to be started."""
        yield in_turn if self.threads is None else self._map

    def _map(
        self, function: Callable[[Any], Any], tasks: Sequence[Any], name: str
    ) -> Iterator[Any]:
        def alone(task: Any) -> Any:
            before = torch.get_num_threads()
            torch.set_num_threads(self.threads)
            try:
                return function(task)
            finally:
                torch.set_num_threads(before)

        return in_turn(alone, tasks, name)


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
