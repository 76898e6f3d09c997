"""The experiment that searches for lenses; its steps are kept on disk, so that it can go on."""

import hashlib
import json
import logging
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar

import torch

from dolens.analysis.conditions import conditions
from dolens.analysis.spot_diagram import spot_diagram
from dolens.errors import InputError, check_count
from dolens.experiments.experiment import Analysis, Figures
from dolens.experiments.lens_search.found_forms import (
    RECORDED_FORMS,
    check_rows,
    form_reports,
    form_rows,
    forms_frame,
    search_figures,
    write_forms_page,
)
from dolens.experiments.tables import Row
from dolens.experiments.watch.history import Recorder
from dolens.experiments.workers import workers_of
from dolens.files import written_whole
from dolens.lens_search.arrangement import Arrangement
from dolens.lens_search.designs import Designs, designed_lens
from dolens.lens_search.finds import Finds
from dolens.lens_search.form_report import FormReport
from dolens.lens_search.glass.choice import chosen_glasses
from dolens.lens_search.glass.glass_merit import merit_of
from dolens.lens_search.growth import STAGES
from dolens.lens_search.search import SearchPlan, Step, search
from dolens.lens_search.search_report import WITHIN
from dolens.lens_search.specification import Specification
from dolens.lens_search.starts import random_starts
from dolens.optics.lens import Lens
from dolens.tasks import OwnThreads, TaskMap
from dolens.tasks import stage as named_stage

logger = logging.getLogger(__name__)


class LensSearchModule(Analysis):
    """Searches for lenses, and checks and writes the best of each form.

    Args:
        specification: of the lens.
        plan: how much is searched.
        forms: how many of the best forms are checked and written.
        lens: must be None.
        workers: where batches run; None: in threads of this process; else see `workers_of`.

    Raises:
        InputError: a setting is out of range.
    """

    digits: ClassVar[int] = 6

    metrics = (
        "search/best_rms_spot_um",
        "search/best_rms_spot_um_through_stop",
        "search/distinct_forms",
        "search/forms",
        "search/starts",
        "search/designs",
        "search/lens_iterations",
        "search/forms_that_hold",
        "search/glass_loss",
        "search/secondary_spectrum_um",
        "search/lateral_colour_um",
    )

    def __init__(
        self,
        specification: Specification,
        plan: SearchPlan,
        forms: int,
        workers: int | str | None = None,
        lens: Lens | None = None,
    ) -> None:
        if lens is not None:
            raise InputError("lens: a search makes its own lens; allowed: null")
        check_count("forms", forms)
        super().__init__(first_start(specification))
        self.specification, self.plan, self.forms = specification, plan, forms
        self.workers = OwnThreads() if workers is None else workers_of(workers)
        self.finds = Finds(specification, plan)
        self.reports: list[FormReport] = []

    def analyse(self) -> dict[str, float]:
        """Search, then check and write the best forms."""
        started = time.perf_counter()
        assert self.folder is not None  # a run has one
        kept = KeptSteps(self.folder / "search", self.specification, self.plan)
        recorder = Recorder(self.folder)
        recorded = recorder.go_on(self.folder)
        with named_stage("search"), self.workers.open() as map_tasks:
            steps = search(self.specification, self.plan, kept.map(map_tasks))
            for number, step in enumerate(steps, 1):
                self.finds.add(step, kept.seconds_before + time.perf_counter() - started)
                logger.info("%s", self.finds.report())
                if number > recorded and recorder.due():
                    asked = time.monotonic()
                    self.finds.rank(RECORDED_FORMS)
                    recorder.add(number, forms_frame(self.finds), asked)
        self.finds.rank(self.forms)
        recorder.add(max(number, recorded), forms_frame(self.finds), time.monotonic())
        recorder.write()
        if not self.finds.found:
            logger.warning("No start became a lens that keeps the specification.")
            return self._numbers()
        with named_stage("checks of the best forms"):
            self.reports = form_reports(self.finds, self.folder / "forms")
            write_forms_page(self.finds, self.reports, self.folder, self.experiment)
        if not self._best.holds:
            logger.warning("No form keeps every check with real rays: see checks.csv.")
        self.lens = self._best.found.lens.requires_grad_(False)
        return self._numbers()

    @property
    def _best(self) -> FormReport:
        """Return the best form that keeps every check, or the best of all where none does."""
        return next((report for report in self.reports if report.holds), self.reports[0])

    def tables(self) -> dict[str, Iterable[Row]]:
        """Return `forms` and `checks`."""
        return {
            "forms": form_rows(self.reports),
            "checks": check_rows(self.reports),
        }

    def figures(self) -> Figures:
        """Return the sections of all forms, the search's course and the map of starts."""
        return search_figures(self.finds, self.reports, self.experiment)

    def _numbers_of_best(self) -> dict[str, float]:
        best = self._best.found
        fields = [(0.0, float(angle)) for angle in self.specification.fields]
        where = conditions(best.lens, fields, self.specification.wavelengths)
        spots = spot_diagram(best.lens, where)
        colour = self._best.colour
        of_colour = (
            {}
            if colour is None
            else {
                "search/secondary_spectrum_um": colour.secondary_um,
                "search/lateral_colour_um": colour.lateral_um,
            }
        )
        return of_colour | {
            "search/best_rms_spot_um": best.mean_rms_spot_um,
            "search/best_rms_spot_um_through_stop": 1e3 * float(spots.polychromatic_rms.mean()),
        }

    def _numbers(self) -> dict[str, float]:  # type: ignore[override]
        finds = self.finds
        numbers = {
            "search/distinct_forms": float(finds.forms_within(WITHIN)),
            "search/forms": float(finds.forms),
            "search/starts": float(self.plan.starts),
            "search/designs": float(finds.designs),
            "search/lens_iterations": float(finds.iterations),
            "search/forms_that_hold": float(sum(report.holds for report in self.reports)),
        }
        if finds.glass_loss is not None:
            numbers["search/glass_loss"] = finds.glass_loss
        return numbers | (self._numbers_of_best() if finds.found else {})


def first_start(specification: Specification) -> Lens:
    """Return the most promising of a few starts as a lens: what a run keeps as its initial lens."""
    arrangement = Arrangement.of(specification, *specification.places_of_stop[0])
    merit = merit_of(arrangement, specification, STAGES[0].rings, STAGES[0].arms)
    generator = torch.Generator().manual_seed(0)
    starts = random_starts(merit, 20, generator)
    return designed_lens(arrangement, specification, starts[0], "first start")


# Files of another one are those of another search.
_FORMAT = 2


class KeptSteps:
    """Reads the steps of earlier tries from a folder, and writes those of this one.

    Args:
        folder: of the steps.
        specification: of the search.
        plan: of the search; a folder of another search is refused.

    Attributes:
        seconds_before: wall time that earlier tries took to find what is read.

    Raises:
        InputError: the folder holds the steps of another search.
    """

    def __init__(self, folder: Path, specification: Specification, plan: SearchPlan) -> None:
        self.folder = folder
        self.seconds_before = 0.0
        self._number = 0
        choice = specification.glass_choice
        # Glasses are kept by their numbers: a catalogue that has changed has others.
        names = choice and chosen_glasses(choice, tuple(specification.wavelengths)).names
        parts = [_FORMAT, asdict(specification), asdict(plan), names]
        text = json.dumps(parts, sort_keys=True)
        self._digest = hashlib.sha256(text.encode()).hexdigest()
        self._started = time.perf_counter()

    def map(self, map_tasks: TaskMap) -> TaskMap:
        """Return a map that leaves out tasks whose results are there."""

        def mapped(
            function: Callable[[Any], Any], tasks: Sequence[Any], name: str
        ) -> Iterator[Any]:
            done = []
            for _ in tasks:
                path = self._path(self._number + len(done))
                if not path.is_file():
                    break
                done.append(self._read(path))
            for step in done:
                self._number += 1
                yield step
            for step in map_tasks(function, tasks[len(done) :], name):
                self._write(self._path(self._number), step)
                self._number += 1
                yield step

        return mapped

    def _path(self, number: int) -> Path:
        return self.folder / f"step_{number:05d}.pt"

    def _write(self, path: Path, step: Step) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        plain = {
            "digest": self._digest,
            "seconds": self.seconds_before + time.perf_counter() - self._started,
            "step": asdict(step),
        }
        with written_whole(path) as aside:
            torch.save(plain, aside)

    def _read(self, path: Path) -> Step:
        plain = torch.load(path, weights_only=True)
        if plain["digest"] != self._digest:
            raise InputError(
                f"{path.parent}: holds steps of a search with another specification or plan, or "
                "with other glasses, or by another version of dolens; remove the folder, or choose "
                "another run folder"
            )
        self.seconds_before = max(self.seconds_before, float(plain["seconds"]))
        step = plain["step"]
        designs = tuple(
            Designs(**{**part, "arrangement": Arrangement(**part["arrangement"])})
            for part in step["designs"]
        )
        return Step(**{**step, "designs": designs})
