"""Functions turn data into a `matplotlib.figure.Figure`, without global state."""

from dolens.plotting.export import figure_to_image, save_figure, save_figures
from dolens.plotting.field_curves import rms_curves_figure
from dolens.plotting.layout import layout_figure
from dolens.plotting.lens_section import before_after_figure
from dolens.plotting.modulation import modulation_figure
from dolens.plotting.pareto import Point, pareto_figure, pareto_front
from dolens.plotting.pictures import comparison_figure
from dolens.plotting.point_spread import psf_figure
from dolens.plotting.runs import RunPoint, runs_curve, runs_figure
from dolens.plotting.search import (
    SearchTrial,
    history_figure,
    search_history_figure,
    trade_off_figure,
)
from dolens.plotting.spots_and_ray_fans import (
    ray_fans_figure,
    spots_comparison_figure,
    spots_figure,
)

__all__ = [
    "Point",
    "RunPoint",
    "SearchTrial",
    "before_after_figure",
    "comparison_figure",
    "figure_to_image",
    "history_figure",
    "layout_figure",
    "modulation_figure",
    "pareto_figure",
    "pareto_front",
    "psf_figure",
    "ray_fans_figure",
    "rms_curves_figure",
    "runs_curve",
    "runs_figure",
    "save_figure",
    "save_figures",
    "search_history_figure",
    "spots_comparison_figure",
    "spots_figure",
    "trade_off_figure",
]
