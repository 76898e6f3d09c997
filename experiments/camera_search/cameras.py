"""The experiment that makes cameras of the forms of a search, and chooses among them."""

import logging
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import torch

from dolens.errors import InputError
from dolens.experiments.analysis import Analysis
from dolens.experiments.camera_search.figures import cameras_picture, images_picture
from dolens.experiments.camera_search.forms import SearchedForm, forms_of_run
from dolens.experiments.camera_search.halving import Halving
from dolens.experiments.camera_search.rungs import Rung, forms_of, rank_correlation
from dolens.experiments.camera_search.tables import camera_rows, rung_rows
from dolens.experiments.camera_search.trained_camera import CameraTask, train_camera
from dolens.experiments.checks import check_count
from dolens.experiments.experiment import Figures
from dolens.experiments.lens_search.search import LensSearchModule
from dolens.experiments.tables import Row
from dolens.experiments.workers import workers_of
from dolens.experiments.workers.own_threads import OwnThreads
from dolens.lens_search.search import SearchPlan
from dolens.lens_search.specification import Specification
from dolens.optics.lens import Lens
from dolens.prescriptions import load_lens
from dolens.tasks import TaskMap
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
        experiment: name of the experiment.
        folder: where all of it goes; cameras are run folders in `cameras/`.
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
        experiment: str,
        folder: str,
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
            search = LensSearchModule(experiment, folder, specification, plan, forms, workers)
            first = search.lens
        else:
            found = forms_of_run(forms_from, cameras.most)
            first = load_lens(found[0].file, dtype=torch.float64)
        super().__init__(first, experiment, folder)
        self.search, self.cameras = search, cameras
        self.workers = OwnThreads() if workers is None else workers_of(workers)
        self.forms: tuple[SearchedForm, ...] = found
        self.rungs: list[Rung] = []

    def analyse(self) -> dict[str, float]:
        """Search where that is asked for, train, and compare."""
        assert self.folder is not None  # a run has one
        numbers: dict[str, float] = {}
        if self.search is not None:
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
