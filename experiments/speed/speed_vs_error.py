"""Speed and error of traces, point spread functions and renders are measured and drawn."""

import copy
import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any
from unittest import mock

import torch
from matplotlib.figure import Figure

from dolens.errors import check_choice, check_count
from dolens.experiments.experiment import Analysis, Figures
from dolens.experiments.speed.renders import (
    Subject,
    by_turns,
    function_rows,
    gradient_agreements,
    render_contenders,
    render_rows,
)
from dolens.experiments.tables import Row
from dolens.optics.lens import Lens
from dolens.optics.rays import Rays, TracedRays
from dolens.optics.surfaces import base, newton
from dolens.plotting import Point, pareto_figure, pareto_front
from dolens.plotting.layout import lens_title
from dolens.tasks import stage as named_stage


@dataclass(frozen=True)
class Contenders:
    """The ways of rendering that are compared.

    Attributes:
        pupil_samples: strata along each side of the pupil, of rays and of functions.
        fields: functions along each side of the sensor.
        tolerances: grey levels that `auto` plans for.

    Raises:
        InputError: a number of strata or functions that is no integer of 1 or more.
    """

    pupil_samples: Sequence[int]
    fields: Sequence[int]
    tolerances: Sequence[float]

    def __post_init__(self) -> None:
        for key in ("pupil_samples", "fields"):
            for number in getattr(self, key):
                check_count(key, number)


@dataclass(frozen=True)
class Effort:
    """The work that goes into references and times.

    Attributes:
        reference_samples: strata of the converged image.
        rays: of a trace.
        seconds: for the times of each group.

    Raises:
        InputError: a number of strata or rays that is no integer of 1 or more.
    """

    reference_samples: int
    rays: int
    seconds: float

    def __post_init__(self) -> None:
        check_count("reference_samples", self.reference_samples)
        check_count("rays", self.rays)


logger = logging.getLogger(__name__)

PARTS = ("trace", "psf", "render")
_SUPPLEMENT = 7  # strata along each side of the pupil of the supplement's renders


class SpeedVsErrorModule(Analysis):
    """Measures error and cost of traces, point spread functions and renders of several scenes.

    Args:
        lens: the lens of the run; it is not used.
        scenes: name → settings of `Subject.of`.
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
        scenes: Mapping[str, Mapping[str, Any]],
        parts: Sequence[str],
        contenders: Contenders,
        effort: Effort,
    ) -> None:
        super().__init__(lens)
        for part in parts:
            check_choice(part, PARTS, "parts")
        self.parts = tuple(parts)
        self.subjects = [Subject.of(name, settings) for name, settings in scenes.items()]
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
        front = {p.label for p in pareto_front(_gradient_points(rows))}
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


def _gradient_points(rows: Sequence[Mapping[str, Any]]) -> list[Point]:
    return [Point(str(r["setting"]), r["with_gradient_s"], r["error_grey_levels"]) for r in rows]


# Part → cost's and error's columns, and their labels.
_AXES = {
    "trace": (
        "with_gradient_ns",
        "error_um",
        "time per ray and surface, forward and backward (ns)",
        "largest error on the sensor (µm)",
    ),
    "psf": (
        "forward_s",
        "error_grey_levels",
        "time per point spread function (µs)",
        "RMS error of an image (grey levels)",
    ),
    "render": (
        "with_gradient_s",
        "error_grey_levels",
        "time per image, forward and backward (s)",
        "RMS error of an image (grey levels)",
    ),
}
_GRADIENT_AXES = (
    "with_gradient_s",
    "gradient_error",
    "time per image, forward and backward (s)",
    "relative error of the gradient (no unit)",
)
_TITLES = {"trace": "ray traces", "psf": "point spread functions", "render": "images"}
# Seconds in the table, µs in the figure.
_SCALE = {"forward_s": 1e6}
_LEAST_ERROR = {"trace": 1e-10, "psf": None, "render": None}


def speed_figures(rows: Sequence[Row], scenes: Mapping[str, str], parts: Sequence[str]) -> Figures:
    """Return error against cost: `<part>_<scene>`, and `gradient_<scene>` for renders.

    Args:
        rows: the table of measurements.
        scenes: name → its lens and aperture, for titles.
        parts: those that were measured, of `trace`, `psf` and `render`.
    """
    figures = {}
    for scene, lens in scenes.items():
        for part in parts:
            figures[f"{part}_{scene}"] = partial(_part_figure, rows, scene, part, lens)
        if "render" in parts:
            figures[f"gradient_{scene}"] = partial(_gradient_figure, rows, scene, lens)
    return figures


def _part_figure(rows: Sequence[Row], scene: str, part: str, lens: str) -> Figure:
    cost, error, *labels = _AXES[part]
    floor = _uncertainty(rows, scene) if part == "render" else _LEAST_ERROR[part]
    points = _points(rows, scene, part, cost, error)
    return pareto_figure(points, *labels, f"{lens}\n{_TITLES[part]}: error against time", floor)


def _gradient_figure(rows: Sequence[Row], scene: str, lens: str) -> Figure:
    cost, error, *labels = _GRADIENT_AXES
    points = _points(rows, scene, "render", cost, error)
    return pareto_figure(points, *labels, f"{lens}\ngradients of images: error against time", None)


def _points(
    rows: Sequence[Row], scene: str, part: str, cost: str, error: str
) -> dict[str, list[Point]]:
    """Return the points of a scene and part by model; settings without a finite error have none."""
    families: dict[str, list[Point]] = {}
    for row in rows:
        if (row["scene"], row["part"]) == (scene, part) and math.isfinite(float(row[error])):
            model = str(row["model"])
            setting = _setting(str(row["setting"]))
            point = Point(setting, _SCALE.get(cost, 1.0) * row[cost], row[error], model == "auto")
            families.setdefault(model, []).append(point)
    return families


def _uncertainty(rows: Sequence[Row], scene: str) -> float | None:
    """Return the grey levels below which errors of a scene's renders are not known."""
    mine = [row for row in rows if (row["scene"], row["part"]) == (scene, "render")]
    return mine[0]["error_uncertainty"] if mine else None


def _setting(setting: str) -> str:
    """Return a label: one ray, not `1 rays`; one grey level likewise."""
    return re.sub(r"\b1 (ray|grey level)s$", r"1 \1", setting)


_NEWTON_STEPS = (0, 1, 2, 3, 4, 5, 6, 8, 12)
_DTYPES = {"float32": torch.float32, "float64": torch.float64}


def trace_rows(
    subject: Subject, backends: tuple[str, ...], rays: int, seconds: float
) -> list[dict[str, float | str]]:
    """Return a row for each precision and backend: error of sensor points, time a ray and surface.

    Args:
        subject: the lens.
        backends: of `reference`, `cpu`, `cuda`.
        rays: how many.
        seconds: that timing may take.
    """
    lenses = {
        (name, backend): _lens(subject.lens, dtype, backend)
        for name, dtype in _DTYPES.items()
        for backend in backends
    }
    given = {name: _rays(lenses[name, backends[0]], rays) for name in _DTYPES}
    true = lenses["float64", "reference"].trace(given["float64"])
    times = {}
    for backward in (False, True):
        calls = {
            key: lambda lens=lens, key=key, b=backward: _trace(lens, given[key[0]], b)
            for key, lens in lenses.items()
        }
        times[backward] = by_turns(calls, seconds)
    rows = []
    for (name, backend), lens in lenses.items():
        name_of = f"{backend}, {name}"
        spent = times[False][name, backend], times[True][name, backend]
        rows.append(
            _row(subject, backend, name_of, _error(lens.trace(given[name]), true), spent, rays)
        )
    return rows + _newton_rows(lenses["float64", "reference"], given["float64"], subject, seconds)


def _newton_rows(
    lens: Lens, given: Rays, subject: Subject, seconds: float
) -> list[dict[str, float | str]]:
    """Return a row for each number of Newton's steps up to the first that is enough.

    Steps that derivatives take besides are not counted.

    The rule that ends the iteration, √ε of the way, is not a setting of the library; its number of
    steps is held down here to see what the rule buys.
    """
    with mock.patch.object(base, "find_root", wraps=base.find_root) as iteration:
        true = lens.trace(given)
    if not iteration.called:
        # Spheres and conics have closed forms.
        return []
    count = given.position[..., 0].numel()
    rows = []
    for steps in _NEWTON_STEPS:
        with mock.patch.object(newton, "MAX_STEPS", steps):
            error = _error(lens.trace(given), true)
            calls = {b: lambda b=b: _trace(lens, given, b) for b in (False, True)}
            times = by_turns(calls, seconds)
        name = f"{steps} of Newton's steps, float64"
        spent = times[False], times[True]
        rows.append(_row(subject, "Newton's steps", name, error, spent, count))
        if error == 0.0:
            break
    return rows


def _error(hit: TracedRays, true: TracedRays) -> float:
    """Return the largest distance on the sensor along x or y, mm; infinite if no ray arrives."""
    both = hit.valid & true.valid
    moved = (hit.position.detach().double() - true.position.detach())[both].abs()
    return float(moved.max()) if moved.numel() else math.inf


def _row(
    subject: Subject,
    model: str,
    setting: str,
    error: float,
    seconds: tuple[float, float],
    rays: int,
) -> dict[str, float | str]:
    """Return a row for an error in mm, and seconds of all rays forward and with the gradient."""
    forward, with_gradient = (1e9 * s / (rays * len(subject.lens.surfaces)) for s in seconds)
    return {
        "scene": subject.name,
        "part": "trace",
        "model": model,
        "setting": setting,
        "error_um": 1e3 * error,
        "forward_ns": forward,
        "with_gradient_ns": with_gradient,
    }


def _lens(lens: Lens, dtype: torch.dtype, backend: str) -> Lens:
    changed = copy.deepcopy(lens).to(dtype).requires_grad_(True)
    changed.backend = backend
    return changed


@torch.no_grad()
def _rays(lens: Lens, count: int) -> Rays:
    """Return parallel rays, a little off the axis, that fill the entrance pupil."""
    pupil = lens.first_order().entrance_pupil
    generator = torch.Generator().manual_seed(0)
    disc = torch.rand(2, count, generator=generator, dtype=torch.float64) - 0.5
    slope = 0.02
    x, y = disc * float(pupil.diameter) * 0.95
    position = torch.stack((x, y - slope * float(pupil.z), torch.zeros_like(x)), -1)
    direction = torch.tensor([0.0, slope, 1.0], dtype=torch.float64)
    direction = (direction / direction.norm()).expand(position.shape)
    return Rays(position.to(lens.dtype), direction.to(lens.dtype), lens.primary_wavelength)


def _trace(lens: Lens, rays: Rays, backward: bool) -> None:
    if not backward:
        with torch.no_grad():
            lens.trace(rays)
        return
    hit = lens.trace(rays)
    torch.where(hit.valid[..., None], hit.position, 0.0).square().mean().backward()
    lens.zero_grad()
