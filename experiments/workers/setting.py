"""The setting `workers` says where independent tasks run."""

from contextlib import AbstractContextManager
from typing import Protocol

from dolens.errors import InputError
from dolens.experiments.workers.own_process import OwnProcess
from dolens.experiments.workers.ray_workers import RayWorkers
from dolens.tasks import TaskMap

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
