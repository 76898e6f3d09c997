"""Crops are datasets; a sampler and a loader of their batches continue from a checkpoint."""

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

import numpy as np
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from dolens.errors import InputError
from dolens.experiments.data.crops import (
    centred_crop,
    check_scale_range,
    check_size,
    crops_that_fit,
    random_crop,
    random_order,
)
from dolens.experiments.data.photographs import Photograph


class TrainingCrops(Dataset):
    """`TrainingCrops` yields random crops without end, indexed by the global number of the sample
    in the run.

    Sample i belongs to pass i // n over the n photographs.  Each pass visits every photograph
    once, in an order of its own; the crop is `random_crop(photo, size, seed, i, …)`.  An item
    is therefore a function of (seed, i), and has no length to speak of.

    Args:
        photographs: to cut from; may decode on demand.
        size: (height, width) of an item in texels.
        seed: of the run.
        scale_range: (smallest, largest) photograph pixels per texel.
        flip_horizontal: mirror half of the crops left and right.
        flip_vertical: mirror half of the crops top and bottom.

    Raises:
        InputError: no photographs, or a bad size or scale range.
    """

    def __init__(
        self,
        photographs: Sequence[Photograph],
        size: tuple[int, int],
        seed: int,
        scale_range: tuple[float, float] = (1.0, 1.0),
        *,
        flip_horizontal: bool = True,
        flip_vertical: bool = False,
    ) -> None:
        if len(photographs) == 0:
            raise InputError("training crops: no photographs; allowed: at least one")
        check_size(size)
        check_scale_range(scale_range)
        self.photographs = photographs
        self.size = size
        self.seed = seed
        self.scale_range = scale_range
        self.flip_horizontal = flip_horizontal
        self.flip_vertical = flip_vertical
        self._orders: dict[int, np.ndarray] = {}

    def __getitem__(self, index: int) -> Tensor:
        """Return sample number `index`: (3, height, width) float32, linear light in [0, 1]."""
        return random_crop(
            self.photographs[self.photograph_number(index)],
            self.size,
            self.seed,
            index,
            self.scale_range,
            flip_horizontal=self.flip_horizontal,
            flip_vertical=self.flip_vertical,
        )

    def photograph_number(self, index: int) -> int:
        """Return the number of the photograph that sample number `index` is cut from."""
        number, position = divmod(index, len(self.photographs))
        if number not in self._orders:
            # A batch touches two passes at most, unless there are few photographs, when orders
            # are cheap: keep the latest two.
            while len(self._orders) > 1:
                del self._orders[min(self._orders)]
            self._orders[number] = random_order(len(self.photographs), self.seed, number)
        return int(self._orders[number][position])


class EvaluationCrops(Dataset):
    """`EvaluationCrops` is a fixed list of crops, by `centred_crops`: no two share a pixel of a
    photograph.

    A photograph gives `count` crops, or as many as it holds without overlap, at least one.

    Args:
        photographs: to cut from; may decode on demand, here once where `count` is above 1.
        size: (height, width) of an item in texels.
        count: crops of each photograph at most.
        scale: photograph pixels per texel.

    Raises:
        InputError: no photographs, a count below 1, or a bad size or scale.
    """

    def __init__(
        self,
        photographs: Sequence[Photograph],
        size: tuple[int, int],
        count: int,
        scale: float = 1.0,
    ) -> None:
        if len(photographs) == 0:
            raise InputError("evaluation crops: no photographs; allowed: at least one")
        if count < 1:
            raise InputError(f"evaluation crops of a photograph: {count}; allowed: 1 or more")
        check_size(size)
        check_scale_range((scale, scale))
        self.photographs = photographs
        self.size = size
        self.scale = scale
        fitting = (
            1 if count == 1 else min(count, crops_that_fit(photographs[number], size, scale))
            for number in range(len(photographs))
        )
        self.counts = np.fromiter(fitting, dtype=np.int64)
        self._ends = np.cumsum(self.counts)  # no list: see PackedNames

    def __len__(self) -> int:
        return int(self._ends[-1])

    def __getitem__(self, index: int) -> Tensor:
        """Return crop `index`, photograph by photograph: (3, height, width) float32, linear
        light.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"crop {index} of {len(self)}")
        photograph = int(np.searchsorted(self._ends, index, side="right"))
        count = int(self.counts[photograph])
        number = index - int(self._ends[photograph]) + count
        return centred_crop(self.photographs[photograph], self.size, count, number, self.scale)

    def names(self) -> list[str]:
        """Return the name of the photograph of every crop, in the order of the crops."""
        name = getattr(self.photographs, "name", None) or self._decoded_name
        names = [name(number) for number in range(len(self.photographs))]
        return [n for n, count in zip(names, self.counts, strict=True) for _ in range(count)]

    def _decoded_name(self, number: int) -> str:
        return self.photographs[number].name


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


_log = logging.getLogger(__name__)


class ResumableSampler(Sampler[int]):
    """Yield the global sample numbers of one epoch, in order.

    The numbers do not depend on anything drawn: where to begin is asked for anew whenever an
    iteration begins, so that an epoch resumed in the middle goes on with the very next sample.

    Args:
        samples_per_epoch: the length of a whole epoch, whatever is left of the present one.
        first_sample: gives (number of the first sample to yield, how many remain in the epoch).
        batch_size: samples of a batch, of which each process has an equal part; it is needed where
            there are several.
        rank: number of this process.
        processes: that share each batch.

    Raises:
        InputError: `samples_per_epoch` below 1.
    """

    def __init__(
        self,
        samples_per_epoch: int,
        first_sample: Callable[[], tuple[int, int]],
        batch_size: int = 1,
        rank: int = 0,
        processes: int = 1,
    ) -> None:
        if samples_per_epoch < 1:
            raise InputError(f"samples of an epoch: {samples_per_epoch}; allowed: 1 or more")
        self.batch_size, self.rank, self.processes = batch_size, rank, processes
        self.samples_per_epoch = samples_per_epoch
        self.first_sample = first_sample

    def __len__(self) -> int:
        return self.samples_per_epoch // self.processes

    def __iter__(self) -> Iterator[int]:
        first, remaining = self.first_sample()
        if self.processes == 1:
            return iter(range(first, first + remaining))
        part = self.batch_size // self.processes
        begins = range(first + self.rank * part, first + remaining, self.batch_size)
        return (begin + number for begin in begins for number in range(part))


class ResumableLoader(CropLoader):
    """`ResumableLoader` loads `TrainingCrops` through a `ResumableSampler`.

    The samples follow from the progress of the trainer, so the state kept in a checkpoint
    serves only to notice that a run is resumed with settings that change the samples.  That it
    has a state also tells Lightning that resuming in the middle of an epoch is in order.
    """

    def state_dict(self) -> dict[str, Any]:
        """Return the settings that the sample numbers and their crops depend on, as plain
        numbers.
        """
        sampler = cast(ResumableSampler, self.sampler)
        return {
            # Of all processes: a run may go on with another number of them.
            "batch_size": cast(int, self.batch_size) * sampler.processes,
            "samples_per_epoch": sampler.samples_per_epoch,
            "seed": cast(TrainingCrops, self.dataset).seed,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Warn of each setting that differs from the one in the checkpoint."""
        for name, value in self.state_dict().items():
            if state.get(name) != value:
                _log.warning(
                    "resuming with %s %s, the checkpoint was written with %s: the samples "
                    "differ from those of an uninterrupted run",
                    name,
                    value,
                    state.get(name),
                )
