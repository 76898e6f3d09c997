"""Tasks run in threads of the process that maps them."""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch

from dolens.tasks import TaskMap, error_of_task, stage, task_label


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
