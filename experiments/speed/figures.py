"""Figures of error against cost."""

import math
from collections.abc import Sequence
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
        "ns a ray and surface, forward and back",
        "largest error on the sensor, µm",
    ),
    "psf": (
        "forward_s",
        "error_grey_levels",
        "s a function",
        "RMS error on a photograph-like image, grey levels",
    ),
    "render": (
        "with_gradient_s",
        "error_grey_levels",
        "s an image, forward and back",
        "RMS error on a photograph-like image, grey levels",
    ),
}
_GRADIENT_AXES = (
    "with_gradient_s",
    "gradient_error",
    "s an image, forward and back",
    "error of the gradient over that of rays, relative",
)
_LEAST_ERROR = {"trace": 1e-10, "psf": None, "render": None}


def speed_figures(rows: Sequence[Row], scenes: Sequence[str], parts: Sequence[str]) -> Figures:
    """Return error against cost: `<part>_<scene>`, and `gradient_<scene>` for renders.

    Args:
        rows: the table of measurements.
        scenes: their names.
        parts: those that were measured, of `trace`, `psf` and `render`.
    """
    figures = {}
    for scene in scenes:
        for part in parts:
            figures[f"{part}_{scene}"] = partial(_part_figure, rows, scene, part)
        if "render" in parts:
            figures[f"gradient_{scene}"] = partial(_gradient_figure, rows, scene)
    return figures


def _part_figure(rows: Sequence[Row], scene: str, part: str) -> Figure:
    cost, error, *labels = _AXES[part]
    floor = _uncertainty(rows, scene) if part == "render" else _LEAST_ERROR[part]
    points = _points(rows, scene, part, cost, error)
    return pareto_figure(points, *labels, f"{scene}: {part}", floor)


def _gradient_figure(rows: Sequence[Row], scene: str) -> Figure:
    cost, error, *labels = _GRADIENT_AXES
    points = _points(rows, scene, "render", cost, error)
    return pareto_figure(points, *labels, f"{scene}: gradients", None)


def _points(
    rows: Sequence[Row], scene: str, part: str, cost: str, error: str
) -> dict[str, list[Point]]:
    """Return the points of a scene and part by model; settings without a finite error have none."""
    families: dict[str, list[Point]] = {}
    for row in rows:
        if (row["scene"], row["part"]) == (scene, part) and math.isfinite(float(row[error])):
            model = str(row["model"])
            point = Point(str(row["setting"]), row[cost], row[error], model == "auto")
            families.setdefault(model, []).append(point)
    return families


def _uncertainty(rows: Sequence[Row], scene: str) -> float | None:
    """Return the grey levels below which errors of a scene's renders are not known."""
    mine = [row for row in rows if (row["scene"], row["part"]) == (scene, "render")]
    return mine[0]["error_uncertainty"] if mine else None
