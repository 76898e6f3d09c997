"""Tasks run in the processes of a Ray cluster, on this machine or on many."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any

import torch

from dolens.experiments.ray_cluster import joined_cluster, local_cluster
from dolens.experiments.running.matmul_precision import set_matmul_precision
from dolens.tasks import TaskError, TaskMap, error_of_task, stage, task_label

if TYPE_CHECKING:
    from types import ModuleType

# Tasks that are handed over before the first result is taken: bounds the memory of results.
_AHEAD = 512


@dataclass(frozen=True)
class RayWorkers:
    """Runs tasks in worker processes, each task in one thread.

    Which worker runs a task, and how many there are, has no part in its result.

    Attributes:
        count: processes on this machine; None: those of a cluster that runs already.
        retries: how often a task is begun again whose process died.
    """

    count: int | None
    retries: int = 3

    @contextmanager
    def open(self) -> Iterator[TaskMap]:
        """Give the map; a cluster is started, or joined, when it has its first task."""
        with ExitStack() as opened:

            @cache
            def cluster() -> "ModuleType":
                wanted = (
                    joined_cluster("workers=auto")
                    if self.count is None
                    else local_cluster(f"workers={self.count}", self.count)
                )
                with stage("workers start"):
                    return opened.enter_context(wanted)

            def map_tasks(
                function: Callable[[Any], Any], tasks: Sequence[Any], name: str
            ) -> Iterator[Any]:
                return _mapped(cluster(), self.retries, function, tasks, name)

            yield map_tasks


def _mapped(
    ray: "ModuleType",
    retries: int,
    function: Callable[[Any], Any],
    tasks: Sequence[Any],
    name: str,
) -> Iterator[Any]:
    """Yield results in order, while up to `_AHEAD` tasks behind them are under way.

    Raises:
        InputError: a task raised it.
        TaskError: a task raised anything else, or no process brought it to its end.
    """
    remote = ray.remote(num_cpus=1, max_retries=retries)(_run)
    # In a tuple Ray passes the reference on: a worker fetches the function once, not for each task.
    shared, precision = (ray.put(function),), torch.get_float32_matmul_precision()
    count, handed, done = len(tasks), 0, 0
    places: dict[int, Any] = {}  # task → reference to its result
    running: list[Any] = []
    try:
        for number in range(count):
            while handed < min(count, number + _AHEAD):
                places[handed] = remote.remote(shared, tasks[handed], precision)
                running.append(places[handed])
                handed += 1
            reference = places.pop(number)
            while reference in running:
                with stage(f"{name}: {done} of {count} done"):
                    ready, running = ray.wait(running, num_returns=1)
                done += len(ready)
            label = task_label(name, number, count)
            try:
                found = ray.get(reference)
            except ray.exceptions.RayTaskError as error:
                raise error_of_task(label, error.cause or error) from error
            except ray.exceptions.RayError as error:
                raise TaskError(
                    f"{label}: its process died at each of {1 + retries} attempts "
                    f"({type(error).__name__}); a task that needs more memory than there is ends so"
                ) from error
            yield found
    finally:
        # After an error, or Ctrl-C, nobody waits for the others.
        for reference in running:
            ray.cancel(reference, force=True)


def _run(shared: tuple[Any], task: Any, precision: str) -> Any:
    """Run a task as every worker does, and as `workers=0` does: in one thread."""
    torch.set_num_threads(1)
    set_matmul_precision(precision)
    return _fetched(*shared)(task)


@lru_cache(maxsize=1)
def _fetched(reference: Any) -> Callable[[Any], Any]:
    """Return a function that all tasks of a map share; what it keeps, as a lens, it keeps here."""
    import ray

    return ray.get(reference)
