"""Independent tasks run in this process, in its threads, or in processes of a Ray cluster.

A sweep's processes import this for the cluster alone: PyTorch is imported with the first task.
"""

import importlib
import logging
import os
import secrets
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache
from types import ModuleType
from typing import Any, Protocol

from dolens.errors import InputError, one_line
from dolens.experiments.running.process_settings import environment_variables, set_matmul_precision
from dolens.tasks import TaskError, TaskMap, error_of_task, in_turn, stage, task_label

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
        import torch

        def alone(task: Any) -> Any:
            before = torch.get_num_threads()
            torch.set_num_threads(self.threads)
            try:
                return function(task)
            finally:
                torch.set_num_threads(before)

        return in_turn(alone, tasks, name)


# Functions and results wait here; in memory that is taken when it is needed.
_OBJECT_STORE_BYTES = 512 << 20
# Ray's sockets lie some 70 characters below its folder, and Linux allows 107 for all.
_LONGEST_FOLDER = 30
_MODE = "RAY_AUTH_MODE"
# What Ray's processes read when they start.
_PRIVATE: Mapping[str, str] = {
    "RAY_USAGE_STATS_ENABLED": "0",
    # Despite its name: without it Ray listens where other machines can reach it.
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
}
_QUIET: Mapping[str, Any] = {
    "configure_logging": False,
    "log_to_driver": False,
    "include_dashboard": False,
}


@contextmanager
def local_cluster(setting: str, processes: int | None = None) -> Iterator[ModuleType]:
    """Start a cluster on this machine, give Ray's module, and end the cluster.

    It listens on the loopback address alone, reports nothing to anybody, and leaves no file.  Where
    this process is in a cluster already, as a job of a sweep over Ray is, that one is used and
    stays.

    Args:
        setting: that asks for it, as `workers=2`; messages begin with it.
        processes: that run tasks, of one thread each and without GPUs; None: all cores and GPUs.

    Raises:
        InputError: Ray is not installed, or does not start.
    """
    own: dict[str, Any] = {}
    variables = dict(_PRIVATE)
    if processes is not None:
        own = {"num_cpus": processes, "num_gpus": 0, "object_store_memory": _OBJECT_STORE_BYTES}
        variables["OMP_NUM_THREADS"] = "1"
    if not {_MODE, "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"} & set(os.environ):
        # Else Ray makes a token of its own, and writes it to a file in the home folder.  Ray itself
        # sets RAY_AUTH_MODE, since a module of it that was imported before no longer looks there.
        variables["RAY_AUTH_TOKEN"] = _token()
    with ExitStack() as closing:
        with environment_variables(variables), _own_mode(), _only_errors():
            ray = ray_module(setting)
            if not ray.is_initialized():
                folder = tempfile.mkdtemp(prefix="dolens-", dir=_short_folder())
                closing.callback(shutil.rmtree, folder, ignore_errors=True)
                closing.enter_context(_signals_kept())
                closing.callback(ray.shutdown)
                _start(
                    ray,
                    f"{setting}: Ray does not start",
                    address="local",  # whatever RAY_ADDRESS says
                    **own,
                    _temp_dir=folder,
                    # Else Ray kills workers, again and again, when others fill the memory.
                    _system_config={"memory_monitor_refresh_ms": 0},
                )
        yield ray


@contextmanager
def joined_cluster(setting: str, address: str = "auto") -> Iterator[ModuleType]:
    """Join a cluster that runs already, give Ray's module, and leave the cluster running.

    Args:
        setting: that asks for it, as `workers=auto`; messages begin with it.
        address: of the cluster; `auto`: that of `RAY_ADDRESS`, or the one that `ray start` left on
            this machine.

    Raises:
        InputError: Ray is not installed, or there is no such cluster.
    """
    ray = ray_module(setting)
    with ExitStack() as closing:
        if not ray.is_initialized():
            closing.enter_context(_signals_kept())
            closing.callback(ray.shutdown)
            advice = "start one by `ray start --head`, or set RAY_ADDRESS"
            _start(ray, f"{setting}: no Ray cluster is found ({advice})", address=address)
        yield ray


def ray_module(setting: str) -> ModuleType:
    """Return Ray, which reports to nobody.

    Args:
        setting: that asks for it.

    Raises:
        InputError: it is not installed.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        return importlib.import_module("ray")
    except ModuleNotFoundError as error:
        if error.name != "ray":
            raise
        raise InputError(
            f"{setting}: the package 'ray' is not installed; pip install 'dolens[ray]'"
        ) from None


def _start(ray: ModuleType, problem: str, **settings: Any) -> None:
    try:
        ray.init(**_QUIET, **settings)
    except (ConnectionError, OSError, RuntimeError, ValueError) as error:
        raise InputError(f"{problem}: {one_line(error)}") from error


def _short_folder() -> str:
    """Return a folder for temporary files whose name leaves room for those of sockets."""
    folder = tempfile.gettempdir()
    return folder if len(folder) <= _LONGEST_FOLDER else "/tmp"


@contextmanager
def _own_mode() -> Iterator[None]:
    """Put RAY_AUTH_MODE back, which Ray sets when it starts a cluster."""
    before = os.environ.get(_MODE)
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(_MODE, None)


@contextmanager
def _only_errors() -> Iterator[None]:
    """Keep Ray's remarks about its start out of the log."""
    ray_s = logging.getLogger("ray")
    before = ray_s.level
    ray_s.setLevel(logging.ERROR)
    try:
        yield
    finally:
        ray_s.setLevel(before)


@cache
def _token() -> str:
    """Return this process's secret, without which nobody can give tasks to its clusters."""
    return secrets.token_hex(32)


@contextmanager
def _signals_kept() -> Iterator[None]:
    """Put the handler of SIGTERM back that Ray replaces by its own."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


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
    import torch

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
    import torch

    torch.set_num_threads(1)
    set_matmul_precision(precision)
    return _fetched(*shared)(task)


@lru_cache(maxsize=1)
def _fetched(reference: Any) -> Callable[[Any], Any]:
    """Return a function that all tasks of a map share; what it keeps, as a lens, it keeps here."""
    import ray

    return ray.get(reference)
