"""The Jacobian kernel reads a map of variables step by step, from the rays' device."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dolens.cached_tensors import cached_tensors
from dolens.kernels.table import Code, Slot, SurfaceTable
from dolens.kernels.variable_map import OUTPUT_ROWS, VariableMap


class DeviceEntries(NamedTuple):
    """A kernel reads these of a map; see `dolens.kernels.cuda.jacobian.jacobian_kernel`.

    Attributes:
        first_step: a sweep ends here.
        begins: (steps + 1,), int32, where the entries of each step begin.
        places: (E,), int32, in the step's record.
        columns: (E,), int32.
        weights: (E,), float64.
        order: (E,), int64, the place of each in the map.
        index_rows: (I,), int32.
        index_columns: (I,), int32.
        outputs: (K,), int32, their rows of a state.
        longest: numbers of the longest record.
    """

    first_step: int
    begins: Tensor
    places: Tensor
    columns: Tensor
    weights: Tensor
    order: Tensor
    index_rows: Tensor
    index_columns: Tensor
    outputs: Tensor
    longest: int


def device_entries(
    table: SurfaceTable, variables: VariableMap, outputs: Sequence[str], device: torch.device
) -> DeviceEntries:
    """Return the entries of a map, sorted by steps, on a device.

    Args:
        table: of many lenses; its codes count.
        variables: the map.
        outputs: K names of `OUTPUT_ROWS`.
        device: of the rays.
    """
    codes = table.codes.numpy().tobytes()
    return _device_entries(codes, table.values.shape[1], variables, tuple(outputs), device)


@cached_tensors(maxsize=256)
def _device_entries(
    codes_: bytes,
    length: int,
    variables: VariableMap,
    outputs: tuple[str, ...],
    device: torch.device,
) -> DeviceEntries:
    codes = np.frombuffer(codes_, dtype=np.int64).reshape(-1, Code.ROW)
    places = variables.places.cpu().numpy()
    # The last number moves z of the rays only, which is no output.
    kept = np.flatnonzero(places < length - 1)
    steps = np.searchsorted(codes[:, Code.OFFSET], places[kept], side="right") - 1
    by_step = np.argsort(steps, kind="stable")
    order, steps = kept[by_step], steps[by_step]
    first_step = int(steps.min(initial=len(codes)))
    index_rows = index_columns = np.zeros(0, dtype=np.int64)
    if variables.indices is not None:
        index_rows = variables.indices.rows.cpu().numpy()
        index_columns = variables.indices.columns.cpu().numpy()
        around = codes[:, Code.BEFORE : Code.AFTER + 1, None] == index_rows
        touched = np.flatnonzero(around.any((1, 2)))
        first_step = min(first_step, int(touched.min(initial=len(codes))))
    ends = np.append(codes[1:, Code.OFFSET], length - 1)
    longest = int((ends - codes[:, Code.OFFSET]).max(initial=Slot.HEADER))

    def integers(numbers: np.ndarray | Sequence[int]) -> Tensor:
        return torch.tensor(np.asarray(numbers), dtype=torch.int32).to(device)

    return DeviceEntries(
        first_step,
        integers(np.searchsorted(steps, np.arange(len(codes) + 1))),
        integers(places[order] - codes[steps, Code.OFFSET]),
        integers(variables.columns.cpu().numpy()[order]),
        variables.weights.cpu()[torch.from_numpy(order)].to(device),
        torch.from_numpy(order).to(device),
        integers(index_rows),
        integers(index_columns),
        integers([OUTPUT_ROWS[name] for name in outputs]),
        longest,
    )
