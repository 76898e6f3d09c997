"""Figures: functions from data to a `matplotlib.figure.Figure`, without any global state."""

from dolens.plotting.comparison import comparison_figure
from dolens.plotting.curves import curves_figure
from dolens.plotting.export import figure_to_image, save_figure
from dolens.plotting.layout import layout_figure
from dolens.plotting.psf import psf_figure

__all__ = [
    "comparison_figure",
    "curves_figure",
    "figure_to_image",
    "layout_figure",
    "psf_figure",
    "save_figure",
]
