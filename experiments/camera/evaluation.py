"""Scores of a camera on photographs, beside untrained restorers and with wrong calibrations."""

import statistics
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.experiments.camera.base import Camera
from dolens.experiments.camera.calibration import Miscalibration
from dolens.experiments.camera.photograph_scores import (
    PhotographScores,
    format_interval,
    scores_by_photograph,
    statistics_of,
)
from dolens.experiments.camera.views.base import Shot, Views, seed_of
from dolens.reconstruction import (
    WienerBM3DRestoration,
    WienerTVRestoration,
    psnr_db,
    structural_similarity,
)
from dolens.reconstruction.processes import gathered
from dolens.reconstruction.quality import SIMILARITY_WINDOW, Interval, gain_interval
from dolens.reconstruction.untrained import bm3d_is_installed
from dolens.sensor.colour import linear_to_srgb
from dolens.sensor.noise import generator_of
from dolens.sensor.pixels import Sensor
from dolens.tasks import stage as named_stage

# Stage → metric → number of a batch → scores (B, V).
Rows = dict[str, dict[str, dict[int, Tensor]]]


class Evaluation:
    """Collects scores of crops and views, and averages them over photographs.

    A stage is `val` or `test`; it is done again by every judge of the views, whose numbers are
    called `test_<reference>/…`, and a test with every wrong calibration besides,
    `test/psnr_db_miscalibrated/<kind>`.  All see the same textures and the same noise.

    Args:
        miscalibrations: name → the calibration whose functions replace the exact ones.
    """

    def __init__(self, miscalibrations: Mapping[str, Miscalibration] | None = None) -> None:
        self.miscalibrations = dict(miscalibrations or {})
        self._rows: Rows = {}
        self._seconds: dict[str, list[float]] = {}

    @torch.no_grad()
    def measure(
        self, camera: Camera, batch: Tensor, stage: str, index: int
    ) -> tuple[Views, Tensor]:
        """Image, restore and compare textures (B, 3, h, w); see `Shot` for the others.

        Returns:
            The images by the camera's own renderer, and what was restored of them, (B, V, 3, H, W),
            display-encoded.
        """
        values = camera.variables()
        seen: tuple[Views, Tensor] | None = None
        for reference in (None, *camera.views.reference_renderers()):
            started, shot = time.perf_counter(), Shot(batch, stage, index, reference)
            with named_stage(f"judge {reference}") if reference else nullcontext():
                taken, functions = camera.take(values, shot)
            if reference is not None:
                self._seconds.setdefault(reference, []).append(time.perf_counter() - started)
            name = stage if reference is None else f"{stage}_{reference}"
            restored = camera.restore(taken, functions)
            seen = seen or (taken, restored)
            row = _row(camera, taken, restored)
            filtered = camera.filtered(taken, functions) if stage == "test" else None
            if filtered is not None:
                row["linear_psnr_db"] = _compared(psnr_db, filtered.clamp(0.0, 1.0), taken.truth)
            if stage == "test":
                row |= _of_plain_exposure(camera, values, shot)
            if stage == "test" and reference is None:
                row |= _of_rivals(camera, taken, functions, values)
            self._add(name, index, row)
            if reference is None and stage == "test" and functions is not None:
                self._miscalibrated(camera, values, taken, functions, index)
        assert seen is not None  # of the camera's own renderer
        return seen

    def _miscalibrated(
        self,
        camera: Camera,
        values: Mapping[str, Tensor],
        taken: Views,
        exact: Tensor,
        index: int,
    ) -> None:
        for kind, calibration in self.miscalibrations.items():
            generator = generator_of(seed_of(0, "test", index))
            with named_stage(f"calibration {kind}"):
                with camera.exact():
                    wrong = calibration.functions(
                        camera.views, camera.lens.with_values(values), exact, generator
                    )
                restored = camera.restore(taken, wrong).clamp(0.0, 1.0)
            row = {f"psnr_db_miscalibrated/{kind}": _compared(psnr_db, restored, taken.truth)}
            self._add("test", index, row)

    def _add(self, stage: str, index: int, row: Mapping[str, Tensor]) -> None:
        kept = self._rows.setdefault(stage, {})
        for name, values in row.items():
            kept.setdefault(name, {})[index] = values.cpu()

    def scores(self, trainer: object, labels: Sequence[str]) -> dict[str, PhotographScores]:
        """Return the scores by photograph of every stage that was measured, and forget their rows.

        Processes that measured batches of their own have all scores in the end.

        Args:
            trainer: whose data module may know the photographs.
            labels: of the views.
        """
        rows, self._rows = together(self._rows), {}
        found: dict[str, PhotographScores] = {}
        for stage, columns in rows.items():
            crops = {
                name: torch.cat([values[number] for number in sorted(values)]).float()
                for name, values in columns.items()
            }
            of_crops = photographs_of_crops(trainer, stage.partition("_")[0], len(crops["psnr_db"]))
            found[stage] = scores_by_photograph(crops, of_crops, labels)
        return found

    def names(self, camera: Camera) -> list[str]:
        """Return the names of all means, of validation and test."""
        judges = ("", *(f"_{name}" for name in camera.views.reference_renderers()))
        scores = ("psnr_db", "ssim", "raw_psnr_db", "raw_ssim")
        views = ("", *(f"/{label}" for label in (*camera.views.labels(), "worst")))
        found = []
        for judge in judges:
            for stage in (f"val{judge}", f"test{judge}"):
                found += [
                    f"{stage}/loss",
                    *(f"{stage}/{s}{view}" for s in scores for view in views),
                ]
        if hasattr(camera.network, "filtered"):
            found += [f"test{judge}/linear_psnr_db{view}" for judge in judges for view in views]
        if camera.views.has_plain_exposure:
            plain = [f"plain_{score}" for score in ("psnr_db", "ssim")]
            found += [f"test{j}/{name}{view}" for j in judges for name in plain for view in views]
        names = rival_names(camera.views.sensor)
        rivals = [f"{name}_{score}" for name in names for score in ("psnr_db", "ssim")]
        found += [f"test/{name}{view}" for name in rivals for view in views]
        if camera.network.needs_point_spread_function:
            wrong = [f"psnr_db_miscalibrated/{kind}" for kind in self.miscalibrations]
            found += [f"test/{name}{view}" for name in wrong for view in views]
        return found

    def costs(self) -> dict[str, float]:
        """Return the seconds that a batch takes each judge, as `cost/judge_<name>_s`."""
        return {
            f"cost/judge_{name}_s": statistics.median(values)
            for name, values in self._seconds.items()
        }


def means_of(scores: PhotographScores) -> dict[str, Tensor]:
    """Return means over photographs for all views together, for each view, and for the worst.

    Each photograph counts once.  The loss has no value of its own for each view.
    """
    found: dict[str, Tensor] = {}
    for name, values in scores.metrics.items():
        by_view = values.mean(dim=0)
        found[name] = by_view.mean()
        if name == "loss":
            continue
        for label, value in zip(scores.views, by_view, strict=True):
            found[f"{name}/{label}"] = value
        found[f"{name}/worst"] = by_view.min()
    return found


def without_loss(scores: PhotographScores) -> PhotographScores:
    """Return the scores without the loss, which tables of photographs leave out."""
    kept = {name: values for name, values in scores.metrics.items() if name != "loss"}
    return replace(scores, metrics=kept)


def check_size(height: int, width: int) -> None:
    """Refuse images that are too small to be compared.

    Args:
        height: of the sensor, pixels.
        width: likewise.

    Raises:
        InputError: structural similarity has no window that fits in.
    """
    if min(height, width) < SIMILARITY_WINDOW:
        raise InputError(
            f"renderer.sensor: height {height} and width {width} pixels; allowed: "
            f"{SIMILARITY_WINDOW} or more, as structural similarity needs"
        )


def photographs_of_crops(trainer: object, stage: str, count: int) -> Sequence[str]:
    """Return the photograph of each crop; where the data know none, each crop counts as one."""
    data = getattr(trainer, "datamodule", None)
    if not hasattr(data, "evaluation_photographs"):
        return [str(number) for number in range(count)]
    return data.evaluation_photographs({"val": "validation", "test": "test"}[stage])[:count]


def _row(camera: Camera, taken: Views, restored: Tensor) -> dict[str, Tensor]:
    """Return scores (B, V) by name."""
    restored, truth = restored.clamp(0.0, 1.0), taken.truth
    with camera.exact():
        loss = camera.loss_over_views(restored, truth.to(restored.dtype))
        row = {"loss": loss["total"].expand(truth.shape[:2])}
        return row | _scored({"": restored, "raw_": linear_to_srgb(taken.raw)}, truth)


def _of_plain_exposure(
    camera: Camera, values: Mapping[str, Tensor], shot: Shot
) -> dict[str, Tensor]:
    """Return scores (B, V) of what the network restores of a plain lens's images, if any."""
    with camera.exact():
        lens = camera.lens.with_values(values)
        found = camera.views.plain_exposure(lens, shot)
    if found is None:
        return {}
    taken, functions, noise = found
    arguments = camera.network.noise_arguments(noise)
    restored = camera.network(taken.given, functions, None, *arguments).clamp(0.0, 1.0)
    return _scored({"plain_": restored.unflatten(0, taken.raw.shape[:2])}, taken.truth)


def _of_rivals(
    camera: Camera, taken: Views, functions: Tensor | None, values: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """Return scores (B, V) of restorers that nothing has trained."""
    with named_stage("untrained restorers"), camera.exact():
        images = restored_by_rivals(camera, taken, functions, values)
        clamped = {f"{name}_": image.clamp(0.0, 1.0) for name, image in images.items()}
        return _scored(clamped, taken.truth)


def _scored(images: Mapping[str, Tensor], truth: Tensor) -> dict[str, Tensor]:
    """Return scores (B, V) of images, by what their names begin with."""
    return {
        f"{name}{metric}": _compared(measure, image, truth)
        for name, image in images.items()
        for metric, measure in (("psnr_db", psnr_db), ("ssim", structural_similarity))
    }


def together(rows: Rows) -> Rows:
    """Return the rows that all processes have measured."""
    found: Rows = {}
    for part in gathered(rows):
        for stage, columns in part.items():
            for name, values in columns.items():
                found.setdefault(stage, {}).setdefault(name, {}).update(values)
    return found


def _compared(measure: object, image: Tensor, truth: Tensor) -> Tensor:
    found = measure(image.flatten(0, 1), truth.flatten(0, 1).to(image.dtype))
    return found.unflatten(0, truth.shape[:2])


# By what names of scores begin with, and what these restorers are called.
RIVALS = {
    "tv": "Wiener's filter and total variation, which nothing has trained",
    "bm3d": "Wiener's filter and BM3D, which nothing has trained",
}
# Pixels along each side: on smaller images the package bm3d may end the whole program.
_LEAST_BM3D = 32
_MADE = {"tv": WienerTVRestoration, "bm3d": WienerBM3DRestoration}


def rival_names(sensor: Sensor) -> list[str]:
    """Return the keys of `RIVALS` that this installation has, for images of a sensor's size."""
    small = min(sensor.height, sensor.width) < _LEAST_BM3D
    return [name for name in RIVALS if name != "bm3d" or (bm3d_is_installed() and not small)]


@torch.no_grad()
def restored_by_rivals(
    camera: Camera, taken: Views, functions: Tensor | None, values: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """Return images (B, V, 3, H, W), display-encoded, by the name of who restored them.

    They know what a network may know: the sensor's noise, and the point spread functions of each
    image's own place where a camera knows it, else of all views.

    Args:
        camera: whose images they are.
        taken: what the sensor gave.
        functions: that the camera's network was told; None where it asks for none.
        values: of the lens's variables.
    """
    lens = camera.lens.with_values(values)
    if functions is None or functions.ndim == taken.given.ndim:  # not of each image its own
        own = camera.views.functions_of_images(lens, taken, "test")
        functions = functions if own is None else own
    if functions is None:
        functions = camera.views.point_spread_functions(lens)
    rivals = {
        name: _MADE[name]().to(taken.given.device) for name in rival_names(camera.views.sensor)
    }
    noise = torch.tensor(camera.views.noise)
    return {
        name: rival(taken.given, functions, None, noise).unflatten(0, taken.raw.shape[:2])
        for name, rival in rivals.items()
    }


# Gains by their names: over which scores of the same test they are, and what those are of.
OVER = {
    "gain_over_filter_db": ("linear_psnr_db", "the network's own linear filter"),
    "gain_over_raw_db": ("raw_psnr_db", "the sensor's image"),
    "gain_over_plain_db": ("plain_psnr_db", "the plain lens in one exposure, restored alike"),
    **{f"gain_over_{name}_db": (f"{name}_psnr_db", said) for name, said in RIVALS.items()},
}


class RestorationGain(NamedTuple):
    """The PSNR of restored images less that of simpler pictures, dB.

    Attributes:
        name: in `OVER`.
        view: its label, `worst`, or empty for the mean.
        interval: 95 %, over photographs, paired.
    """

    name: str
    view: str
    interval: Interval


def restoration_gains(scores: PhotographScores, views: Sequence[str]) -> Iterator[RestorationGain]:
    """Yield the gains of one test.

    At the worst view the gain is that of the worst view of either: they may be two.

    Args:
        scores: of the test.
        views: labels, `worst`, or empty for the mean over the views; see `statistics_of`.
    """
    statistics = statistics_of(scores.views)
    for name, (other, _) in OVER.items():
        if other not in scores.metrics:
            continue
        sides = [scores.metrics[metric].double()[None] for metric in ("psnr_db", other)]
        for view in views:
            interval = gain_interval(*sides, statistics[view], torch.Generator().manual_seed(0))
            yield RestorationGain(name, view, interval)


def gain_numbers(scores: PhotographScores, stage: str) -> dict[str, float]:
    """Return gains and the ends of their intervals, by the names of metrics: of the mean over the
    views, each view, and the worst.
    """
    numbers = {}
    for gain in restoration_gains(scores, list(statistics_of(scores.views))):
        key = f"{stage}/{gain.name}" + (f"/{gain.view}" if gain.view else "")
        found = gain.interval
        numbers |= {key: found.estimate}
        numbers |= {f"error/{key}/low": found.low, f"error/{key}/high": found.high}
    return numbers


def gain_line(scores: PhotographScores) -> str:
    """Return a sentence that says the gains at the worst view, with their intervals."""
    said = [
        f"{format_interval(gain.interval, 2)} dB over {OVER[gain.name][1]}"
        for gain in restoration_gains(scores, ["worst"])
    ]
    return (
        f"Restored images at the worst of {', '.join(scores.views)}: {'; '.join(said)} "
        f"({len(scores.photographs)} photographs, 95 % intervals)"
    )


def behind_line(scores: PhotographScores) -> str | None:
    """Return a sentence that says which untrained restorers are ahead at the worst view, if any."""
    ahead = [
        f"{format_interval(gain.interval, 2)} dB over {OVER[gain.name][1]}"
        for gain in restoration_gains(scores, ["worst"])
        if gain.name in {f"gain_over_{name}_db" for name in RIVALS} and gain.interval.estimate < 0.0
    ]
    return f"The network is behind untrained restorers: {'; '.join(ahead)}" if ahead else None
