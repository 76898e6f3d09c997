"""Measurement of speed and error of traces, point spread functions and renders."""

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from dolens.errors import check_choice, check_keys
from dolens.optics.parameter_units import to_lens_units
from dolens.plotting import Point, pareto_front
from dolens.prescriptions import lens_from_prescription
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor
from experiments.analysis import Analysis
from experiments.experiment import Figures
from experiments.speed.figures import speed_figures
from experiments.speed.functions import function_rows
from experiments.speed.renders import (
    Subject,
    gradient_agreements,
    render_contenders,
    render_rows,
)
from experiments.speed.traces import trace_rows
from experiments.tables import Row

logger = logging.getLogger(__name__)

PARTS = ("trace", "psf", "render")
_SUPPLEMENT = 7  # strata along each side of the pupil of the supplement's renders
_SUBJECT_KEYS = ("lens", "values", "depths", "wavelengths", "sensor", "variables")


class SpeedVsErrorModule(Analysis):
    """Measures error and cost of traces, point spread functions and renders of several scenes.

    Args:
        lens: the lens of the run; it is not used.
        experiment: name of the experiment.
        scenes: name → `lens` (a prescription), `values` (parameters to change), `depths` (mm),
            `wavelengths` (nm), `sensor`, and `variables`, patterns of what gradients are taken of.
        folder: where the table goes.
        parts: of `trace`, `psf` and `render`.
        pupil_samples: strata along each side of the pupil, of rays and of functions.
        fields: functions along each side of the sensor.
        tolerances: grey levels that `auto` plans for.
        reference_samples: strata of the converged image.
        rays: of a trace.
        seconds: for the times of each group.
    """

    def __init__(
        self,
        lens: Any,
        experiment: str,
        scenes: Mapping[str, Mapping[str, Any]],
        folder: str,
        parts: Sequence[str] = PARTS,
        pupil_samples: Sequence[int] = (1, 2, 4, 7, 16, 32, 64),
        fields: Sequence[int] = (1, 2, 3, 5, 9),
        tolerances: Sequence[float] = (4.0, 1.0, 0.25),
        reference_samples: int = 48,
        rays: int = 100_000,
        seconds: float = 2.0,
    ) -> None:
        super().__init__(lens, experiment, folder)
        for part in parts:
            check_choice(part, PARTS, "parts")
        self.parts = tuple(parts)
        self.subjects = [_subject(name, entry) for name, entry in scenes.items()]
        self.pupil_samples = tuple(pupil_samples)
        self.fields = tuple(fields)
        self.tolerances = tuple(tolerances)
        self.reference_samples = reference_samples
        self.rays = rays
        self.seconds = seconds
        self.rows: list[Row] = []
        self.numbers: dict[str, float] = {}

    def analyse(self) -> dict[str, float]:
        """Measure, and write the table after every scene and part."""
        for subject in self.subjects:
            for part in self.parts:
                logger.info("%s: %s", subject.name, part)
                self.rows += getattr(self, f"_{part}")(subject)
                self.write_tables()
        return self.numbers

    def tables(self) -> dict[str, list[Row]]:
        """Return `speed_vs_error`: a row for each scene, part and setting."""
        return {"speed_vs_error": self.rows}

    def figures(self) -> Figures:
        """Return error against cost for each scene and part."""
        return speed_figures(self.rows, [s.name for s in self.subjects], self.parts)

    def _trace(self, subject: Subject) -> list[dict[str, float | str]]:
        return trace_rows(subject, ("reference", "cpu"), self.rays, self.seconds)

    def _psf(self, subject: Subject) -> list[dict[str, float | str]]:
        samples = [n for n in self.pupil_samples if n > 1]
        return function_rows(subject, samples, self.seconds)

    def _render(self, subject: Subject) -> list[dict[str, float | str]]:
        contenders = render_contenders(subject, self.pupil_samples, self.fields, self.tolerances)
        rows, judge = render_rows(subject, contenders, self.reference_samples, self.seconds)
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


def _subject(name: str, entry: Mapping[str, Any]) -> Subject:
    check_keys(entry, _SUBJECT_KEYS, f"scenes.{name}")
    lens = lens_from_prescription(entry["lens"], torch.float32, where=f"scenes.{name}.lens")
    with torch.no_grad():
        for pattern, value in (entry.get("values") or {}).items():
            for key, parameter in lens.variables([pattern]).items():
                parameter.fill_(to_lens_units(key, value))
    scene = PlanarScene(entry["depths"], entry["wavelengths"])
    sensor = Sensor(**entry["sensor"])
    names = tuple(lens.variables(list(entry["variables"])))
    return Subject(name, lens.requires_grad_(False), scene, sensor, names)
