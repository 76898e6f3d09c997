"""A sampler and a loader continue from a checkpoint."""

import logging
from collections.abc import Callable, Iterator
from typing import Any, cast

from torch.utils.data import Sampler

from dolens.errors import InputError
from dolens.experiments.data.crop_dataset import TrainingCrops
from dolens.experiments.data.loading import CropLoader

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
