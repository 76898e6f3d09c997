"""Crops form an endless dataset for training and a fixed one for evaluation."""

from collections.abc import Sequence

import numpy as np
from torch import Tensor
from torch.utils.data import Dataset

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
