"""A camera is trained and tested with many lenses of its series, each off by its tolerances."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.errors import InputError
from dolens.experiments.camera.as_built import MadeLens, Manufacture
from dolens.experiments.camera.base import Camera
from dolens.experiments.camera.reconstruction import evaluating
from dolens.experiments.camera.views.base import Shot, Views
from dolens.experiments.tables import Row
from dolens.plotting.tolerances import made_lenses_figure
from dolens.reconstruction import psnr_db
from dolens.sensor.noise import BatchShare
from dolens.tolerancing import Tolerances


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
        taken, functions = camera.take(values, Shot(batch, "train", step, share=share))
        return taken, [functions]
    with camera.exact():
        lenses = manufacture.for_step(camera.lens.with_values(values), step)
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
        shot = Shot(part, "train", camera.global_step, None, own if own.total > size else None)
        taken.append(camera.views.take(camera.lens.with_values(made.values), shot))
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


# The worst tenth of the lenses begins at this share, from the worst.
_DECILE = 0.1
_SEED, _RESAMPLES, _LEVEL = 0, 2000, 0.95


@dataclass(frozen=True)
class MadeLensScores:
    """Scores of N lenses that were made, on the same B crops with the same noise.

    Attributes:
        views: labels of the V views.
        by_crop: PSNR (N, B, V), dB.
        photographs: the photograph of each crop.
        as_drawn: (V,), of the lens without errors, mean over crops.
        errors: (N, P), of the parameters, in the lens's units.
        tolerances: of these parameters.
        loss_db: a lens passes that loses no more than this to the lens as drawn, each by its worst
            view.
        seconds: that one lens takes.
        factor: of the tolerances.
    """

    views: tuple[str, ...]
    by_crop: Tensor
    photographs: tuple[str, ...]
    as_drawn: Tensor
    errors: Tensor
    tolerances: Tolerances
    loss_db: float
    seconds: float
    factor: float = 1.0

    @property
    def psnr_db(self) -> Tensor:
        """Return the means over crops, (N, V), dB."""
        return self.by_crop.mean(1)

    @property
    def worst_view(self) -> Tensor:
        """Return the PSNR of the worst view of each lens, (N,), dB."""
        return self.psnr_db.amin(1)

    @property
    def passing(self) -> float:
        """Return the least PSNR, dB, of the worst view of a lens that passes."""
        return float(self.as_drawn.amin()) - self.loss_db

    def numbers(self) -> dict[str, float]:
        """Return metrics, with intervals of 95 % over the lenses."""
        worst = self.worst_view
        found = {
            "made/lenses": float(len(worst)),
            "made/psnr_db/as_drawn": float(self.as_drawn.amin()),
            "made/psnr_db/mean": float(worst.mean()),
            "made/psnr_db/median": float(worst.median()),
            "made/psnr_db/worst_decile": float(worst_decile(worst)),
            "made/yield": float((worst >= self.passing).double().mean()),
            "cost/made_lens_s": self.seconds,
        }
        if len(worst) > 1:
            generator = torch.Generator().manual_seed(_SEED)
            rows = torch.randint(len(worst), (_RESAMPLES, len(worst)), generator=generator)
            drawn = worst_decile(worst[rows])
            ends = torch.tensor([0.5 - 0.5 * _LEVEL, 0.5 + 0.5 * _LEVEL], dtype=drawn.dtype)
            for end, value in zip(("low", "high"), drawn.quantile(ends).tolist(), strict=True):
                found[f"error/made/psnr_db/worst_decile/{end}"] = value
        return found

    def rows(self) -> list[Row]:
        """Return a row for each lens: its scores, and its errors in the units of files."""
        shares = self.errors / self.tolerances.unit
        percent = [unit == "%" for unit in self.tolerances.unit_names]
        shares = shares * torch.where(torch.tensor(percent), 100.0, 1.0)
        labels = [
            f"{name} ({unit})" if unit else name
            for name, unit in zip(self.tolerances.names, self.tolerances.unit_names, strict=True)
        ]
        return [
            {
                "lens": str(number),
                "psnr_db/worst": float(scores.amin()),
                **{f"psnr_db/{v}": float(s) for v, s in zip(self.views, scores, strict=True)},
                **dict(zip(labels, off.tolist(), strict=True)),
            }
            for number, (scores, off) in enumerate(zip(self.psnr_db, shares, strict=True))
        ]

    def crop_rows(self) -> list[Row]:
        """Return a row for each lens and crop: its PSNR by view."""
        return [
            {
                "factor": f"{self.factor:g}",
                "lens": str(number),
                "photograph": photograph,
                **{f"psnr_db/{v}": float(s) for v, s in zip(self.views, scores, strict=True)},
            }
            for number, crops in enumerate(self.by_crop)
            for photograph, scores in zip(self.photographs, crops, strict=True)
        ]


def front_numbers(others: Sequence[MadeLensScores]) -> dict[str, float]:
    """Return `made/factor_<f>/...` and `error/made/factor_<f>/...` of the same camera's lenses at
    other factors of the tolerances.
    """
    return {
        name.replace("made/", f"made/factor_{found.factor:g}/"): value
        for found in others
        for name, value in found.numbers().items()
        if "made/" in name
    }


def spread_over_photographs(photographs: Sequence[str], count: int) -> list[int]:
    """Return the numbers of so many crops, of as many photographs as there are.

    Args:
        photographs: the photograph of each crop.
        count: crops at most.
    """
    turns: dict[str, int] = {}
    ranked = []
    for number, photograph in enumerate(photographs):
        turns[photograph] = turns.get(photograph, -1) + 1
        ranked.append((turns[photograph], number))
    return sorted(number for _, number in sorted(ranked)[:count])


def worst_decile(worst: Tensor) -> Tensor:
    """Return the mean of the lowest tenth of scores (..., N), of one of them at least."""
    count = max(1, math.ceil(_DECILE * worst.shape[-1] - 1e-9))
    return worst.sort(-1).values[..., :count].mean(-1)


@torch.no_grad()
def made_lens_scores(
    camera: Camera, manufacture: Manufacture, crops: Tensor, photographs: Sequence[str]
) -> MadeLensScores:
    """Image crops through lenses that are made, restore them, and compare them with the truth.

    The training's renderer makes the images: hundreds of lenses by rays would take hours.  All
    lenses see the same crops with the same noise.

    Args:
        camera: as trained.
        manufacture: makes the lenses.
        crops: textures (B, 3, h, w), linear light, of which some are taken.
        photographs: the photograph of each.
    """
    chosen = spread_over_photographs(photographs, manufacture.settings.crops)
    crops = crops[chosen]
    judging = camera.views.judged_by_training()
    design = camera.variables()
    started = time.perf_counter()

    def taken_by(values: Mapping[str, Tensor]) -> Views:
        return judging.take(camera.lens.with_values(values), Shot(crops, "test", 0))

    def scores(taken: Views, functions: Tensor | None) -> Tensor:
        restored = camera.restore(taken, functions).clamp(0.0, 1.0)
        truth = taken.truth.to(restored.dtype)
        found = psnr_db(restored.flatten(0, 1), truth.flatten(0, 1))
        return found.unflatten(0, truth.shape[:2]).double().cpu()

    with evaluating(camera.network):
        with camera.exact():
            taken = taken_by(design)
            of_design = camera.functions(design, taken, "train")
        as_drawn = scores(taken, of_design)
        rows, errors = [], []
        for number in range(manufacture.settings.tested):
            with camera.exact():
                made = manufacture.tested(camera.lens.with_values(design), number)
                taken, functions = taken_by(made.values), of_design
                if not manufacture.gives_the_design_s_functions:
                    told = partial(camera.functions, taken=taken, stage="train")
                    functions = manufacture.functions(told, design, made)
            rows.append(scores(taken, functions))
            errors.append(made.errors)
    seconds = (time.perf_counter() - started) / (len(rows) + 1)
    return MadeLensScores(
        tuple(judging.labels()),
        torch.stack(rows),
        tuple(photographs[number] for number in chosen),
        as_drawn.mean(0),
        torch.stack(errors),
        manufacture.tolerances,
        manufacture.settings.loss_db,
        seconds,
        manufacture.settings.factor,
    )


def made_lenses_figure_of(scores: MadeLensScores) -> Figure:
    """Draw how many of the lenses reach which PSNR."""
    name = f"{len(scores.psnr_db)} lenses as built"
    numbers = scores.numbers()
    title = (
        f"worst decile {numbers['made/psnr_db/worst_decile']:.2f} dB, "
        f"{100.0 * numbers['made/yield']:.0f} % pass"
    )
    return made_lenses_figure(
        {name: scores.worst_view}, {name: float(scores.as_drawn.amin())}, scores.passing, title
    )
