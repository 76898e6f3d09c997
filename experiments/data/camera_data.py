"""The data modules share the way from photographs to batches of crops."""

from collections.abc import Sequence
from typing import Any, Literal, cast

import lightning
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from dolens.errors import InputError, check_count
from dolens.experiments.data.crop_loading import (
    CropLoader,
    EvaluationCrops,
    ResumableLoader,
    ResumableSampler,
    TrainingCrops,
    Waiting,
)
from dolens.experiments.data.photographs import Photograph

Split = Literal["train", "validation", "test"]

_SPLITS_OF_STAGE: dict[str | None, tuple[Split, ...]] = {
    "fit": ("train", "validation"),
    "validate": ("validation",),
    "test": ("test",),
    "predict": (),
    None: ("train", "validation", "test"),
}

# Validation crops among which the most detailed one is looked for.
_LOOKED_AT = 16
# Of processes, and of batches that each of them holds: more than any machine has use for.
_MOST_WORKERS = 1024


class CropDataModule(lightning.LightningDataModule):
    """A `CropDataModule` cuts crops of photographs in linear light; a subclass says which
    photographs.

    A batch is a tensor (batch, 3, height, width), float32, linear light in [0, 1], where
    height and width are `item_size`: the crop with `margin` texels more on each side.

    Training samples are numbered through the whole run, and sample i is a function of
    (seed, i).  A run resumed from any checkpoint, in the middle of an epoch too, sees the
    samples an uninterrupted one would have seen.  Evaluation crops are always the same.

    Args:
        crop_size: texels of the crop, one number for a square or (height, width).
        margin: texels added on each side, so that a renderer's blur finds no edge.
        batch_size: crops in a batch, of all processes together.
        steps_per_epoch: batches in a training epoch; None: as many as `iterations_per_photograph`
            asks for.
        iterations_per_photograph: crops of each training photograph in an epoch, where
            steps_per_epoch is None.
        scale_range: (smallest, largest) photograph pixels per texel in training, drawn
            log-uniformly.
        evaluation_crops_per_photograph: crops of each validation and test photograph at most;
            they do not overlap, so that a small photograph gives fewer.
        seed: of the training crops.

    Rarely needed:
        evaluation_scale: photograph pixels per texel in validation and test.
        flip_horizontal: mirror half of the training crops left and right.
        flip_vertical: mirror half of the training crops top and bottom.
        num_workers: processes that cut crops; 0 cuts them in the training process.  The crops are
            the same for any number.
        prefetch: batches that each worker cuts ahead.

    Raises:
        InputError: an argument is out of range; the line names it.
    """

    def __init__(
        self,
        crop_size: int | Sequence[int] = 256,
        margin: int = 0,
        batch_size: int = 4,
        steps_per_epoch: int | None = 100,
        iterations_per_photograph: int | None = None,
        scale_range: Sequence[float] = (1.0, 2.0),
        evaluation_crops_per_photograph: int = 4,
        evaluation_scale: float = 1.0,
        flip_horizontal: bool = True,
        flip_vertical: bool = False,
        num_workers: int = 0,
        prefetch: int = 2,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.crop_size = _size("data.crop_size", crop_size)
        self.margin = _count("data.margin", margin, 0)
        self.batch_size = _count("data.batch_size", batch_size, 1)
        if (steps_per_epoch is None) == (iterations_per_photograph is None):
            raise InputError(
                "data: give steps_per_epoch or iterations_per_photograph, and null for the other"
            )
        self._steps_per_epoch = steps_per_epoch
        if steps_per_epoch is not None:
            _count("data.steps_per_epoch", steps_per_epoch, 1)
        self._iterations_per_photograph = iterations_per_photograph
        if iterations_per_photograph is not None:
            _count("data.iterations_per_photograph", iterations_per_photograph, 1)
        self.scale_range = _range("data.scale_range", scale_range)
        self.evaluation_crops_per_photograph = _count(
            "data.evaluation_crops_per_photograph", evaluation_crops_per_photograph, 1
        )
        self.evaluation_scale = _range(
            "data.evaluation_scale", (evaluation_scale, evaluation_scale)
        )[0]
        self.flip_horizontal = flip_horizontal
        self.flip_vertical = flip_vertical
        self.num_workers = _count("data.num_workers", num_workers, 0, _MOST_WORKERS)
        self.prefetch = _count("data.prefetch", prefetch, 1, _MOST_WORKERS)
        self.seed = _count("data.seed", seed, 0)
        self.waiting = Waiting()
        self._photographs: dict[Split, Sequence[Photograph]] = {}
        self._evaluation: dict[Split, EvaluationCrops] = {}
        self._detailed: Tensor | None = None

    @property
    def item_size(self) -> tuple[int, int]:
        """Return (height, width) of an item in texels: the crop and its margins."""
        return self.crop_size[0] + 2 * self.margin, self.crop_size[1] + 2 * self.margin

    @property
    def steps_per_epoch(self) -> int:
        """Return the batches of a whole training epoch; the last may go on into the next pass."""
        if self._steps_per_epoch is not None:
            return self._steps_per_epoch
        crops = self._iterations_per_photograph * len(self.photographs("train"))
        return -(-crops // self.batch_size)

    @property
    def samples_per_epoch(self) -> int:
        """Return the crops of a whole training epoch."""
        return self.steps_per_epoch * self.batch_size

    def load_split(self, split: Split) -> Sequence[Photograph]:
        """Load the photographs of one split; they may be decoded on demand.  Subclasses implement
        it.
        """
        raise NotImplementedError(f"{type(self).__name__}.load_split")

    def setup(self, stage: str | None = None) -> None:
        """Find the photographs a stage needs (`fit`, `validate`, `test`; None: all).

        Raises:
            InputError: a photograph is missing or unreadable, or a split is empty.
        """
        for split in _SPLITS_OF_STAGE[stage]:
            self.photographs(split)

    def photographs(self, split: Split) -> Sequence[Photograph]:
        """Return the photographs of a split, loaded at the first call."""
        if split not in self._photographs:
            self._photographs[split] = self.load_split(split)
        return self._photographs[split]

    def train_dataloader(self) -> DataLoader:
        """Return batches of the present training epoch, from the next sample on.

        Raises:
            InputError: the processes cannot have equal parts of a batch, an epoch ends within a
                step, or the trainer overfits batches, which would replace the sampler.
        """
        trainer = self.trainer
        rank, processes = self._place()
        if self.batch_size % processes:
            raise InputError(
                f"data.batch_size: {self.batch_size} cannot be shared equally by {processes} "
                f"processes; allowed: multiples of {processes}"
            )
        if trainer is not None and trainer.overfit_batches:
            raise InputError(
                f"trainer.overfit_batches: {trainer.overfit_batches}; allowed: 0, crops do not "
                "repeat; use few photographs and trainer.limit_train_batches"
            )
        batches = 1 if trainer is None else trainer.accumulate_grad_batches
        if self.steps_per_epoch % batches:
            raise InputError(
                f"trainer.accumulate_grad_batches: {batches} does not divide the batches of an "
                f"epoch, {self.steps_per_epoch} (data.steps_per_epoch)"
            )
        dataset = TrainingCrops(
            self.photographs("train"),
            self.item_size,
            self.seed,
            self.scale_range,
            flip_horizontal=self.flip_horizontal,
            flip_vertical=self.flip_vertical,
        )
        sampler = ResumableSampler(
            self.samples_per_epoch, self.first_sample, self.batch_size, rank, processes
        )
        return ResumableLoader(
            dataset,
            sampler=sampler,
            batch_size=self.batch_size // processes,
            waiting=self.waiting,
            **self._loader_arguments(),
        )

    def _place(self) -> tuple[int, int]:
        """Return the number of this process, and how many share the work."""
        trainer = self.trainer
        return (0, 1) if trainer is None else (trainer.global_rank, trainer.world_size)

    def val_dataloader(self) -> DataLoader:
        """Return the validation crops, always the same."""
        return self._evaluation_loader("validation")

    def test_dataloader(self) -> DataLoader:
        """Return the test crops, always the same."""
        return self._evaluation_loader("test")

    def evaluation_photographs(self, split: Split) -> list[str]:
        """Return the name of the photograph that each evaluation crop of a split is cut from, in
        order.
        """
        return self._evaluation_crops(split).names()

    def training_photographs(self) -> list[str]:
        """Return the name of the photograph that each crop of the present batch is cut from."""
        crops = cast(TrainingCrops, cast(DataLoader, self.trainer.train_dataloader).dataset)
        progress = self.trainer.fit_loop.epoch_loop.batch_progress
        first = progress.total.processed * self.batch_size
        numbers = range(first, first + self.batch_size)
        return [crops.photographs[crops.photograph_number(number)].name for number in numbers]

    def evaluation_batches(self, split: Split) -> list[int]:
        """Return the numbers of the evaluation batches that are this process's, in order.

        Batches go around among the processes.  One for which none is left does one of the others'
        again, so that all of them evaluate.

        Raises:
            InputError: several processes, and a trainer that evaluates a share of the batches.
        """
        count = -(-len(self._evaluation_crops(split)) // self.batch_size)
        rank, processes = self._place()
        if processes == 1:
            return list(range(count))
        key = {"validation": "limit_val_batches"}.get(split, "limit_test_batches")
        limit = getattr(self.trainer, key)
        if isinstance(limit, float) and 0.0 < limit < 1.0:
            raise InputError(
                f"trainer.{key}: {limit:g}; allowed with several processes: a number of batches"
            )
        if isinstance(limit, int) and limit:
            count = min(count, limit)
        return list(range(rank, count, processes)) or [rank % count]

    def most_detailed(self) -> Tensor:
        """Return the colours, (1, 3, height, width), of the validation crop, among several, whose
        neighbouring texels differ most.
        """
        if self._detailed is None:
            crops = self._evaluation_crops("validation")
            some = [crops[number][:3] for number in range(min(_LOOKED_AT, len(crops)))]
            detail = [sum(c.diff(dim=d).square().mean() for d in (-1, -2)) for c in some]
            self._detailed = some[int(torch.stack(detail).argmax())][None]
        return self._detailed

    def first_sample(self) -> tuple[int, int]:
        """Return the global number of the next training sample, and the samples that remain in the
        epoch.

        Read from the trainer's count of processed batches, which a checkpoint restores before
        the loader is iterated.  `processed` is raised after the optimizer's step and before
        `on_train_batch_end`, where checkpoints are written; `ready` would count a batch that an
        exception interrupted, `completed` would miss the one whose end wrote the checkpoint,
        and the trainer's `global_step` counts steps, not batches, where gradients accumulate.
        """
        if self.trainer is None:
            return 0, self.samples_per_epoch
        epoch_loop = self.trainer.fit_loop.epoch_loop
        progress = epoch_loop.batch_progress
        done = progress.current.processed if epoch_loop.restarting else 0
        if done >= self.steps_per_epoch:
            done = 0  # the checkpoint closed an epoch, and the next one begins
        first = progress.total.processed * self.batch_size
        return first, (self.steps_per_epoch - done) * self.batch_size

    def _evaluation_crops(self, split: Split) -> EvaluationCrops:
        if split not in self._evaluation:
            self._evaluation[split] = EvaluationCrops(
                self.photographs(split),
                self.item_size,
                self.evaluation_crops_per_photograph,
                self.evaluation_scale,
            )
        return self._evaluation[split]

    def _evaluation_loader(self, split: Split) -> DataLoader:
        dataset = self._evaluation_crops(split)
        if self._place()[1] == 1:
            size = self.batch_size
            return CropLoader(dataset, size, shuffle=False, **self._loader_arguments())
        size, count = self.batch_size, len(dataset)
        batches = [
            list(range(n * size, min(n * size + size, count)))
            for n in self.evaluation_batches(split)
        ]
        return CropLoader(dataset, batch_sampler=batches, **self._loader_arguments())

    def _loader_arguments(self) -> dict[str, Any]:
        return {
            "num_workers": self.num_workers,
            # Workers stay for the next epoch, with what they have decoded.
            "persistent_workers": self.num_workers > 0,
            "prefetch_factor": self.prefetch if self.num_workers else None,
            "pin_memory": torch.cuda.is_available(),
            # Of its own, so that no random number of the training depends on how crops are cut.
            "generator": torch.Generator(),
        }


def _count(key: str, value: int, smallest: int, largest: int | None = None) -> int:
    check_count(key, value, smallest)
    if largest is not None and value > largest:
        raise InputError(f"{key}: {value}; allowed: an integer of {smallest} to {largest}")
    return value


def _size(key: str, value: int | Sequence[int]) -> tuple[int, int]:
    if isinstance(value, int):
        value = (value, value)
    if isinstance(value, str) or not isinstance(value, Sequence) or len(value) != 2:
        raise InputError(f"{key}: {value!r}; allowed: one number of texels or (height, width)")
    return _count(key, value[0], 1), _count(key, value[1], 1)


def _range(key: str, value: Sequence[float]) -> tuple[float, float]:
    pair = isinstance(value, Sequence) and not isinstance(value, str) and len(value) == 2
    numbers = pair and all(
        isinstance(number, int | float) and not isinstance(number, bool) for number in value
    )
    if not numbers or not 0 < value[0] <= value[1] < float("inf"):
        raise InputError(
            f"{key}: {value!r}; allowed: photograph pixels per texel, above 0, the smaller first"
        )
    return float(value[0]), float(value[1])
