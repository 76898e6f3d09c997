"""Figures of error against cost."""

import math
import re
from collections.abc import Mapping, Sequence
from functools import partial

from matplotlib.figure import Figure

from dolens.experiments.experiment import Figures
from dolens.experiments.tables import Row
from dolens.plotting import Point, pareto_figure

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
