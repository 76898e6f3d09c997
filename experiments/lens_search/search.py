"""The experiment that searches for lenses from a specification."""

import logging
import time
from collections.abc import Iterable
from typing import ClassVar

import torch

from dolens.analysis.spot_diagram import spot_diagram
from dolens.errors import InputError
from dolens.experiments.analysis import Analysis
from dolens.experiments.checks import check_count
from dolens.experiments.experiment import Figures
from dolens.experiments.lens_search.figures import search_figures
from dolens.experiments.lens_search.finds import Finds
from dolens.experiments.lens_search.kept_steps import KeptSteps
from dolens.experiments.lens_search.page import form_reports, write_forms_page
from dolens.experiments.lens_search.tables import check_rows, form_rows
from dolens.experiments.tables import Row
from dolens.experiments.workers import workers_of
from dolens.experiments.workers.own_threads import OwnThreads
from dolens.lens_search.arrangement import Arrangement
from dolens.lens_search.designs import designed_lens
from dolens.lens_search.form_report import FormReport
from dolens.lens_search.glass.glass_merit import merit_of
from dolens.lens_search.growth import STAGES
from dolens.lens_search.search import SearchPlan, search
from dolens.lens_search.search_report import WITHIN
from dolens.lens_search.specification import Specification
from dolens.lens_search.starts import random_starts
from dolens.optics.lens import Lens
from dolens.tasks import stage as named_stage

logger = logging.getLogger(__name__)


class LensSearchModule(Analysis):
    """Searches for lenses, and checks and writes the best of each form.

    Args:
        experiment: name of the experiment.
        folder: where tables and lenses go.
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
        experiment: str,
        folder: str,
        specification: Specification,
        plan: SearchPlan,
        forms: int,
        workers: int | str | None = None,
        lens: Lens | None = None,
    ) -> None:
        if lens is not None:
            raise InputError("lens: a search makes its own lens; allowed: null")
        check_count("forms", forms)
        super().__init__(first_start(specification), experiment, folder)
        self.specification, self.plan, self.forms = specification, plan, forms
        self.workers = OwnThreads() if workers is None else workers_of(workers)
        self.finds = Finds(specification, plan)
        self.reports: list[FormReport] = []

    def analyse(self) -> dict[str, float]:
        """Search, then check and write the best forms."""
        started = time.perf_counter()
        assert self.folder is not None  # a run has one
        kept = KeptSteps(self.folder / "search", self.specification, self.plan)
        with named_stage("search"), self.workers.open() as map_tasks:
            for step in search(self.specification, self.plan, kept.map(map_tasks)):
                self.finds.add(step, kept.seconds_before + time.perf_counter() - started)
                logger.info("%s", self.finds.report())
        self.finds.rank(self.forms)
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
        spots = spot_diagram(best.lens, fields, self.specification.wavelengths)
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
