"""Tasks run in the process that maps them."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch

from dolens.tasks import TaskMap, in_turn


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
