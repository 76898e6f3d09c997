"""Batches come from this process or from workers, and how long one waits for them is measured."""

import time
from collections.abc import Iterator
from typing import Any

from torch.utils.data import DataLoader

from dolens.errors import InputError

# PyTorch says so of errors that a worker raised and lived through.
_RAISED_IN_WORKER = "in DataLoader worker process"


class LostWorkerError(RuntimeError):
    """This error says that a worker has ended before it handed over a batch."""


class Waiting:
    """The time that a training waits for its batches.

    The first batch of an epoch is left out: workers start in it.
    """

    def __init__(self) -> None:
        self.batches = 0
        self.seconds = 0.0
        self.latest = 0.0

    def add(self, seconds: float) -> None:
        """Count a batch that was waited for."""
        self.latest = seconds
        self.seconds += seconds
        self.batches += 1

    def mean(self) -> float | None:
        """Return the mean in seconds; None before the second batch.

        It is the mean, since workers that are too slow make one batch in several wait for all.
        """
        return self.seconds / self.batches if self.batches else None


class CropLoader(DataLoader):
    """`CropLoader` loads crops.

    What a worker finds wrong with a file is one line here, without the worker's traceback.

    Args:
        *arguments: those of `DataLoader`.
        waiting: is told how long each batch was waited for.
        **options: those of `DataLoader`.
    """

    def __init__(self, *arguments: Any, waiting: Waiting | None = None, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.waiting = waiting

    def __iter__(self) -> Iterator[Any]:  # type: ignore[override]
        """Begin to load, and return the batches, which raise `InputError` where a photograph cannot
        be decoded, and `LostWorkerError` where a worker hangs up.
        """
        return self._watched(super().__iter__())

    def _watched(self, batches: Iterator[Any]) -> Iterator[Any]:
        first = True
        while True:
            started = time.perf_counter()
            try:
                batch = next(batches)
            except StopIteration:
                return
            except InputError as error:
                raise InputError(_without_traceback(error.whole)) from None
            except (ConnectionError, EOFError) as error:
                # A worker that is being killed hangs up a moment before PyTorch finds it dead.
                if not self.num_workers or _RAISED_IN_WORKER in str(error):
                    raise
                raise LostWorkerError("it hung up") from error
            if self.waiting is not None and not first:
                self.waiting.add(time.perf_counter() - started)
            first = False
            yield batch


def _without_traceback(message: str) -> str:
    """Return the message that a worker's error had before PyTorch put its traceback before it."""
    return message.rpartition(f"{InputError.__name__}: ")[2].strip()
