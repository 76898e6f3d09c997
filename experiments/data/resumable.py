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

    Raises:
        InputError: `samples_per_epoch` below 1.
    """

    def __init__(self, samples_per_epoch: int, first_sample: Callable[[], tuple[int, int]]) -> None:
        if samples_per_epoch < 1:
            raise InputError(f"samples of an epoch: {samples_per_epoch}; allowed: 1 or more")
        self.samples_per_epoch = samples_per_epoch
        self.first_sample = first_sample

    def __len__(self) -> int:
        return self.samples_per_epoch

    def __iter__(self) -> Iterator[int]:
        first, remaining = self.first_sample()
        return iter(range(first, first + remaining))


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
        return {
            "batch_size": cast(int, self.batch_size),
            "samples_per_epoch": cast(ResumableSampler, self.sampler).samples_per_epoch,
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
