"""Cameras are made of the forms of a search for lenses, and the best is chosen."""

import logging
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.errors import InputError, check_count
from dolens.experiments.camera.camera import CameraModule
from dolens.experiments.camera.views.base import Shot
from dolens.experiments.experiment import Analysis, Figures
from dolens.experiments.lens_search.rungs import (
    Halving,
    Rung,
    RungOfForm,
    SearchedForm,
    forms_of,
    forms_of_run,
    rank_correlation,
)
from dolens.experiments.lens_search.search import LensSearchModule
from dolens.experiments.lens_search.trained_camera import CameraTask, train_camera
from dolens.experiments.running.finished_run import load_run
from dolens.experiments.tables import Row
from dolens.experiments.workers import workers_of
from dolens.lens_search.search import SearchPlan
from dolens.lens_search.specification import Specification
from dolens.optics.lens import Lens
from dolens.plotting.pareto import CamerasOfRung, spots_and_cameras_figure
from dolens.plotting.pictures import comparison_figure
from dolens.prescriptions import load_lens
from dolens.reconstruction import psnr_db
from dolens.sensor.colour import linear_to_srgb
from dolens.tasks import OwnThreads, TaskMap
from dolens.tasks import stage as named_stage

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class CameraPlan:
    """Says how cameras are made of forms, and how many.

    Args:
        settings: what `dolens train` is given for each of them besides its lens.
        score: metric that decides, on validation photographs, as `psnr_db/worst`; more is better.
        most: forms that are tried, those of least spots.
        seeds: each form is trained once with each.
        halving: how much each rung trains, and how many go on.

    Raises:
        InputError: a number is out of range, or there are no settings or seeds.
    """

    settings: Sequence[str]
    score: str
    most: int
    seeds: Sequence[int]
    halving: Halving

    def __post_init__(self) -> None:
        check_count("cameras.most", self.most)
        if isinstance(self.settings, str) or not self.settings:
            raise InputError("cameras.settings: allowed: a list, as [experiment=form_camera]")
        seeds = list(self.seeds)
        if not seeds or len(set(seeds)) < len(seeds) or any(type(n) is not int for n in seeds):
            raise InputError(f"cameras.seeds: {seeds}; allowed: different integers, one at least")


class CamerasFromSearch(Analysis):
    """Learns a camera for each form of a search, by successive halving.

    The form of the best spots is trained to the end whatever its images are, as what the winner is
    compared with.

    Args:
        specification: of the search that is done first; nothing of it counts with `forms_from`.
        plan: of that search.
        forms: best forms that it writes.
        cameras: how cameras are made of them.
        forms_from: the run folder of a finished search; None: a search is done here.
        workers: where batches of the search and cameras run; None: as many at once as this process
            has threads; else see `workers_of`.
        lens: must be None.

    Raises:
        InputError: a setting is out of range, or `forms_from` holds no forms.
    """

    digits: ClassVar[int] = 6

    metrics = (
        *LensSearchModule.metrics,
        "cameras/*",
        "error/cameras/*",
    )

    def __init__(
        self,
        specification: Specification,
        plan: SearchPlan,
        forms: int,
        cameras: CameraPlan,
        forms_from: str | None = None,
        workers: int | str | None = None,
        lens: Lens | None = None,
    ) -> None:
        if lens is not None:
            raise InputError("lens: cameras get the lenses of a search; allowed: null")
        search, found = None, ()
        if forms_from is None:
            search = LensSearchModule(specification, plan, forms, workers)
            first = search.lens
        else:
            found = forms_of_run(forms_from, cameras.most)
            first = load_lens(found[0].file, dtype=torch.float64)
        super().__init__(first)
        self.search, self.cameras = search, cameras
        self.workers = OwnThreads() if workers is None else workers_of(workers)
        self.forms: tuple[SearchedForm, ...] = found
        self.rungs: list[Rung] = []

    def analyse(self) -> dict[str, float]:
        """Search where that is asked for, train, and compare."""
        assert self.folder is not None  # a run has one
        numbers: dict[str, float] = {}
        if self.search is not None:
            self.search.place(self.experiment, self.folder)
            numbers |= self.search.analyse()
            self.forms = forms_of_run(self.folder, self.cameras.most)
        lenses = self.folder / "cameras" / "conf" / "lens"
        lenses.mkdir(parents=True, exist_ok=True)
        for form in self.forms:
            shutil.copyfile(form.file, lenses / f"{form.name}.yaml")
        with self.workers.open() as map_tasks:
            self._climb(map_tasks)
        best = self.rungs[-1].best.cameras[0].task.folder
        logger.info("The best camera is the run %s", best)
        self.lens = load_lens(best / "lens" / "final.yaml", dtype=torch.float64)
        return numbers | self._numbers_of_cameras()

    def _climb(self, map_tasks: TaskMap) -> None:
        """Train rung by rung.

        Raises:
            InputError: all forms failed.
        """
        going = tuple(form.name for form in self.forms)
        halving, best_spots = self.cameras.halving, going[0]
        for number, epochs in enumerate(halving.epochs, 1):
            tasks = [
                self._task(form, seed, number, epochs)
                for form in self.forms
                if form.name in going
                for seed in self.cameras.seeds
            ]
            with named_stage(f"rung {number} of {halving.rungs}"):
                trained = list(map_tasks(train_camera, tasks, "cameras"))
            forms = forms_of(trained, going, self.cameras.score)
            for name, form in forms.items():
                if form.failed:
                    logger.warning("%s is left out: %s", name, form.failed)
            scores = {name: form.decides for name, form in forms.items() if not form.failed}
            if not scores:
                raise InputError(
                    f"cameras: all forms failed, as {tasks[0].form}: {trained[0].failed}"
                )
            last = number == halving.rungs
            going = halving.survivors(scores, tuple(scores) if last else (best_spots,))
            self.rungs.append(Rung(number, epochs, forms, going))
            self.write_tables()
            logger.info(
                "After %d epochs %s leads: %s %.3f",
                epochs,
                going[0],
                self.cameras.score,
                scores[going[0]],
            )

    def _task(self, form: SearchedForm, seed: int, rung: int, epochs: int) -> CameraTask:
        assert self.folder is not None
        cameras = self.folder.resolve() / "cameras"
        return CameraTask(
            form=form.name,
            seed=seed,
            rung=rung,
            epochs=epochs,
            whole=self.cameras.halving.epochs[-1],
            first=self.cameras.halving.first_epochs,
            settings=tuple(self.cameras.settings),
            score=self.cameras.score,
            lens=form.text,
            folder=cameras / form.name / f"seed_{seed}",
            configuration=cameras / "conf",
        )

    def _numbers_of_cameras(self) -> dict[str, float]:
        first, last = self.rungs[0], self.rungs[-1]
        best, spots = last.best, {form.name: form for form in self.forms}
        ranks = {name: n for n, name in enumerate(spots, 1)}
        metric = self.cameras.score
        kept = {n: form.decides for n, form in first.forms.items() if not form.failed}
        numbers = {
            f"cameras/best_{metric}": best.mean(f"test/{metric}"),
            "cameras/best_ssim": best.mean("test/ssim"),
            "cameras/spot_rank_of_best": float(ranks[best.form]),
            "cameras/forms": float(len(first.forms)),
            "cameras/failed": float(
                sum(bool(f.failed) for r in self.rungs for f in r.forms.values())
            ),
            "cameras/seeds": float(len(self.cameras.seeds)),
            "cameras/rank_correlation": -rank_correlation(
                [spots[name].rms_spot_um for name in kept], list(kept.values())
            ),
            "cameras/rank_correlation_by_area": -rank_correlation(
                [spots[name].rms_spot_um_by_area for name in kept], list(kept.values())
            ),
        }
        compared = last.forms.get(self.forms[0].name)
        if compared is None or compared.failed:
            return numbers
        numbers[f"cameras/{metric}_of_best_spots"] = compared.mean(f"test/{metric}")
        gain = best.gain(compared, "test")
        if gain is not None:
            numbers["cameras/gain_db"] = gain.estimate
            numbers["error/cameras/gain_db/low"] = gain.low
            numbers["error/cameras/gain_db/high"] = gain.high
        return numbers

    def tables(self) -> dict[str, Iterable[Row]]:
        """Return `cameras` and `rungs`, and those of the search."""
        found = {} if self.search is None else self.search.tables()
        return {
            **found,
            "cameras": camera_rows(self.forms, self.rungs),
            "rungs": rung_rows(self.rungs),
        }

    def figures(self) -> Figures:
        """Return spots against cameras, images of two cameras, and the figures of the search."""
        found = {} if self.search is None else dict(self.search.figures())
        if not self.rungs:
            return found
        return {
            **found,
            "spots_and_cameras": partial(
                cameras_picture, self.forms, self.rungs, self.cameras.score, self.experiment
            ),
            "images": partial(images_picture, self.rungs[-1], self.forms[0].name),
        }


def camera_rows(forms: Sequence[SearchedForm], rungs: Sequence[Rung]) -> Iterator[Row]:
    """Yield a row for each form in the order of its spots: what it reached at every rung."""
    for rank, form in enumerate(forms, 1):
        row: dict[str, float | str] = {
            "spot_rank": rank,
            "form": form.name,
            "rms_spot_um": form.rms_spot_um,
            "rms_spot_um_over_the_sensor": form.rms_spot_um_by_area,
        }
        for rung in rungs:
            reached = rung.forms.get(form.name)
            for name in ("psnr_db", "ssim"):
                row[f"{name}_rung_{rung.number}"] = _shown(reached, f"val/{name}")
        last = rungs[-1].forms.get(form.name) if rungs else None
        for name in ("psnr_db", "ssim"):
            row[f"test_{name}"] = _shown(last, f"test/{name}")
        row["cost_s"] = sum(
            camera.metrics.get("cost/wall_s", 0.0)
            for rung in rungs
            if form.name in rung.forms
            for camera in rung.forms[form.name].cameras
        )
        failures = (rung.forms[form.name].failed for rung in rungs if form.name in rung.forms)
        row["failed"] = next((reason for reason in failures if reason), "")
        yield row


def rung_rows(rungs: Sequence[Rung]) -> Iterator[Row]:
    """Yield a row for each form of each rung, the best first.

    `behind_db` is what it lacks to the rung's best, with the interval of this difference over
    photographs, and over seeds where there are several.
    """
    for rung in rungs:
        ranked = sorted(rung.forms.values(), key=lambda f: (bool(f.failed), -f.decides))
        for form in ranked:
            behind = None if form.failed else rung.best.gain(form, rung.stage)
            yield {
                "rung": rung.number,
                "epochs": rung.epochs,
                "form": form.form,
                "seeds": len(form.cameras),
                "score": form.decides,
                "deviation_over_seeds": form.deviation(f"val/{form.score}"),
                "ssim": form.mean("val/ssim"),
                "behind_db": "" if behind is None else behind.estimate,
                "behind_low": "" if behind is None else behind.low,
                "behind_high": "" if behind is None else behind.high,
                "goes_on": form.form in rung.going_on,
                "failed": form.failed,
            }


def _shown(form: RungOfForm | None, metric: str) -> float | str:
    return "" if form is None or form.failed else form.mean(metric)


# Views of each camera that are shown: the first and the last of its zones.
_SHOWN = 2


def cameras_picture(
    forms: Sequence[SearchedForm], rungs: Sequence[Rung], score: str, name: str
) -> Figure:
    """Draw the score of every camera at every rung against the spot of its form."""
    drawn = []
    for rung in rungs:
        kept = [f for f in forms if f.name in rung.forms and not rung.forms[f.name].failed]
        reached = [rung.forms[form.name] for form in kept]
        drawn.append(
            CamerasOfRung(
                f"{rung.epochs} epochs",
                [form.name.removeprefix("form_").lstrip("0") for form in kept],
                [form.rms_spot_um for form in kept],
                [form.decides for form in reached],
                [form.deviation(f"val/{score}") for form in reached],
            )
        )
    label = f"{score} of restored validation photographs"
    return spots_and_cameras_figure(
        drawn, label, f"{name}: spots and cameras, by number of the form"
    )


@torch.no_grad()
def images_picture(rung: Rung, best_spots: str) -> Figure | None:
    """Draw truth, measured and restored images of the best camera and of that of the best spots."""
    cameras = {"best camera": rung.best}
    other = rung.forms.get(best_spots)
    if other is not None and not other.failed and other is not rung.best:
        cameras["best spots"] = other
    parts = [_images(label, camera) for label, camera in cameras.items()]
    truth, raw, restored = (
        torch.cat(images) for images in zip(*(p[0] for p in parts), strict=True)
    )
    labels = [label for part in parts for label in part[1]]
    quality = {
        "raw": psnr_db(raw, truth).tolist(),
        "restored": psnr_db(restored, truth).tolist(),
    }
    note = "One crop of a test photograph, with the PSNR of this crop; display-encoded (sRGB)."
    return comparison_figure(truth, raw, restored, labels, quality, note=note)


def _images(label: str, camera: RungOfForm) -> tuple[tuple[Tensor, Tensor, Tensor], list[str]]:
    """Return truth, measured and restored images of some views, and the names of these."""
    run = load_run(
        camera.cameras[0].task.folder, with_loss=False, trust=True
    )  # this search has made it
    module = run.module
    assert isinstance(module, CameraModule)  # it has a score
    run.data.setup("test")
    crop = next(iter(run.data.test_dataloader()))[:1]
    taken, functions = module.take(module.variables(), Shot(crop, "test", 0))
    restored = module.restore(taken, functions).clamp(0.0, 1.0)
    labels = [name for name in module.views.labels() if name != "field"]
    chosen = sorted({0, len(labels) - 1})[:_SHOWN]
    images = (taken.truth[0], linear_to_srgb(taken.raw)[0], restored[0])
    truth, raw, found = (image[chosen] for image in images)
    return (truth, raw, found), [f"{label}\n({camera.form}), {labels[n]}" for n in chosen]
