"""Measurement of speed and error of traces, point spread functions and renders."""

import logging
from collections.abc import Mapping, Sequence
from typing import Any

from dolens.errors import check_choice
from dolens.experiments.analysis import Analysis
from dolens.experiments.experiment import Figures
from dolens.experiments.speed.figures import speed_figures
from dolens.experiments.speed.functions import function_rows
from dolens.experiments.speed.renders import (
    Subject,
    gradient_agreements,
    render_contenders,
    render_rows,
)
from dolens.experiments.speed.settings import Contenders, Effort, subject_of
from dolens.experiments.speed.traces import trace_rows
from dolens.experiments.tables import Row
from dolens.optics.lens import Lens
from dolens.plotting import Point, pareto_front
from dolens.plotting.layout import lens_title
from dolens.tasks import stage as named_stage

logger = logging.getLogger(__name__)

PARTS = ("trace", "psf", "render")
_SUPPLEMENT = 7  # strata along each side of the pupil of the supplement's renders


class SpeedVsErrorModule(Analysis):
    """Measures error and cost of traces, point spread functions and renders of several scenes.

    Args:
        lens: the lens of the run; it is not used.
        experiment: name of the experiment.
        folder: where the table goes.
        scenes: name → settings of `subject_of`.
        parts: of `trace`, `psf` and `render`.
        contenders: the ways of rendering.
        effort: of references and times.

    Raises:
        InputError: an unknown part, or a bad setting of a scene.
    """

    metrics = (
        "error/*/*",
        "gradient/*/*",
    )

    def __init__(
        self,
        lens: Lens,
        experiment: str,
        folder: str,
        scenes: Mapping[str, Mapping[str, Any]],
        parts: Sequence[str],
        contenders: Contenders,
        effort: Effort,
    ) -> None:
        super().__init__(lens, experiment, folder)
        for part in parts:
            check_choice(part, PARTS, "parts")
        self.parts = tuple(parts)
        self.subjects = [subject_of(name, settings) for name, settings in scenes.items()]
        self.contenders, self.effort = contenders, effort
        self.rows: list[Row] = []
        self.numbers: dict[str, float] = {}

    def analyse(self) -> dict[str, float]:
        """Measure, and write the table after every scene and part."""
        for subject in self.subjects:
            for part in self.parts:
                logger.info("%s: %s", subject.name, part)
                with named_stage(f"{subject.name}, {part}"):
                    self.rows += getattr(self, f"_{part}")(subject)
                self.write_tables()
        return self.numbers

    def tables(self) -> dict[str, list[Row]]:
        """Return `speed_vs_error`: a row for each scene, part and setting."""
        return {"speed_vs_error": self.rows}

    def figures(self) -> Figures:
        """Return error against cost for each scene and part."""
        titles = {s.name: lens_title(s.lens) for s in self.subjects}
        return speed_figures(self.rows, titles, self.parts)

    def _trace(self, subject: Subject) -> list[dict[str, float | str]]:
        return trace_rows(subject, ("reference", "cpu"), self.effort.rays, self.effort.seconds)

    def _psf(self, subject: Subject) -> list[dict[str, float | str]]:
        samples = [n for n in self.contenders.pupil_samples if n > 1]
        return function_rows(subject, samples, self.effort.seconds)

    def _render(self, subject: Subject) -> list[dict[str, float | str]]:
        contenders = render_contenders(
            subject,
            self.contenders.pupil_samples,
            self.contenders.fields,
            self.contenders.tolerances,
        )
        rows, judge = render_rows(
            subject, contenders, self.effort.reference_samples, self.effort.seconds
        )
        name, numbers = subject.name, self.numbers
        agreements = gradient_agreements(subject, contenders)
        for row in rows:
            found = agreements.get(str(row["setting"]))
            row["gradient_cosine"] = found.cosine if found else float("nan")
            row["gradient_norm_ratio"] = found.norm_ratio if found else float("nan")
            row["gradient_error"] = found.error if found else float("nan")
            row["gradient_noise"] = found.noise if found else float("nan")
        by_setting = {row["setting"]: row for row in rows}
        front = {p.label for p in pareto_front(_points(rows))}
        for row in rows:
            row["on_front"] = float(row["setting"] in front)
        numbers[f"error/reference_noise/{name}"] = judge.noise
        supplement = by_setting.get(f"{_SUPPLEMENT**2} rays")
        for contender in contenders:
            if contender.model != "auto":
                continue
            row, tolerance = by_setting[contender.setting], contender.renderer.tolerance
            numbers[f"error/auto_{tolerance:g}/{name}"] = row["error_grey_levels"]
            numbers[f"cost/auto_{tolerance:g}_s/{name}"] = row["with_gradient_s"]
            if supplement is not None:
                ratio = supplement["with_gradient_s"] / row["with_gradient_s"]
                numbers[f"cost/supplement_over_auto_{tolerance:g}/{name}"] = ratio
            numbers[f"gradient/cosine_auto_{tolerance:g}/{name}"] = row["gradient_cosine"]
            numbers[f"gradient/norm_ratio_auto_{tolerance:g}/{name}"] = row["gradient_norm_ratio"]
        if supplement is not None:
            numbers[f"error/supplement_rays/{name}"] = supplement["error_grey_levels"]
        return rows


def _points(rows: Sequence[Mapping[str, Any]]) -> list[Point]:
    return [Point(str(r["setting"]), r["with_gradient_s"], r["error_grey_levels"]) for r in rows]
