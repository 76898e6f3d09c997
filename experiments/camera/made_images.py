"""A batch is imaged through several lenses that were made, each with an equal part of it."""

from collections.abc import Mapping, Sequence
from functools import partial

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.experiments.camera.as_built import MadeLens, Manufacture
from dolens.experiments.camera.base import Camera
from dolens.experiments.camera.views.base import Views
from dolens.sensor.noise import BatchShare


def training_images(
    camera: Camera,
    manufacture: Manufacture | None,
    values: Mapping[str, Tensor],
    batch: Tensor,
    share: BatchShare | None,
) -> tuple[Views, list[Tensor | None]]:
    """Return a training step's images, through the lens as drawn or through lenses that are made.

    Args:
        camera: trains.
        manufacture: makes the lenses; None: the lens as drawn.
        values: variables of the lens as drawn.
        batch: textures (B, 3, h, w), linear light.
        share: of a larger batch.

    Returns:
        The images, and what functions the network gets for each equal part of the batch.
    """
    step = camera.global_step
    if manufacture is None or not manufacture.in_training:
        taken, functions = camera.take(values, batch, "train", step, share=share)
        return taken, [functions]
    with camera.exact():
        lenses = manufacture.for_step(camera.lens, values, step)
        return images_of_made_lenses(camera, manufacture, lenses, values, batch, share)


def images_of_made_lenses(
    camera: Camera,
    manufacture: Manufacture,
    lenses: Sequence[MadeLens],
    design: Mapping[str, Tensor],
    batch: Tensor,
    share: BatchShare | None,
) -> tuple[Views, list[Tensor | None]]:
    """Return the images of a training batch, and the functions that each lens's part is given.

    Args:
        camera: trains.
        manufacture: made the lenses.
        lenses: K of them.
        design: variables of the lens as drawn.
        batch: textures (B, 3, h, w), B a multiple of K.
        share: of a larger batch, whose random numbers these textures have their part of.

    Raises:
        InputError: the batch cannot be shared equally.
    """
    count, whole = len(lenses), share or BatchShare(0, len(batch))
    if len(batch) % count:
        raise InputError(
            f"as_built.lenses_per_step: {count}; allowed: a divisor of the batch, {len(batch)}"
        )
    size = len(batch) // count
    taken: list[Views] = []
    functions: list[Tensor | None] = []
    for number, made in enumerate(lenses):
        part = batch[number * size : (number + 1) * size]
        own = BatchShare(whole.first + number * size, whole.total)
        alone = own.total == len(part)
        arguments = (camera.lens, made.values, part, "train", camera.global_step, None)
        # Views that know no shares are asked for none.
        taken.append(camera.views.take(*arguments) if alone else camera.views.take(*arguments, own))
        if functions and manufacture.gives_the_design_s_functions and not camera.knows_places:
            functions.append(functions[0])
            continue
        told = partial(camera.functions, taken=taken[-1], stage="train")
        functions.append(manufacture.functions(told, design, made))
    fields = [part.field for part in taken if part.field is not None]
    return (
        Views(
            torch.cat([part.truth for part in taken]),
            torch.cat([part.raw for part in taken]),
            torch.cat(fields) if fields else None,
        ),
        functions,
    )


def restored_in_parts(camera: Camera, taken: Views, functions: Sequence[Tensor | None]) -> Tensor:
    """Return restored images (B, V, 3, H, W), each equal part by functions of its own.

    Where no network asks for functions, all are restored at once.

    Args:
        camera: trains.
        taken: B textures.
        functions: of each part.
    """
    if len(functions) == 1 or functions[0] is None:
        return camera.restore(taken, functions[0])
    size = len(taken.raw) // len(functions)
    parts = []
    for number, own in enumerate(functions):
        rows = slice(number * size, (number + 1) * size)
        field = None if taken.field is None else taken.field[rows]
        parts.append(camera.restore(Views(taken.truth[rows], taken.raw[rows], field), own))
    return torch.cat(parts)
