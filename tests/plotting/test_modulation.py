"""Contrast over frequency, and over the field."""

import math

import numpy as np
import torch

from dolens.analysis.conditions import conditions
from dolens.analysis.modulation_transfer import Modulation, modulation
from dolens.plotting import (
    modulation_figure,
)
from tests.plotting.artists import legend
from tests.plotting.overlaps import flaws

LINES = torch.tensor([656.2725, 486.1327], dtype=torch.float64)
FIELDS = torch.tensor([[0.0, 0.0], [0.0, 14.0], [3.0, 4.0]], dtype=torch.float64)


def test_modulation_is_drawn_below_its_limit(triplet):
    frequency = torch.linspace(0.0, 50.0, 6).double()
    curves = torch.linspace(1.0, 0.5, 6).double() * torch.tensor([[1.0], [0.8], [math.nan]])
    limit = torch.linspace(1.0, 0.9, 6)
    where = conditions(triplet, FIELDS, LINES)
    mtf = Modulation(where, frequency, curves, 0.9 * curves, limit)
    figure = modulation_figure(mtf)
    axes = figure.axes[0]
    lines = {line.get_label(): line for line in axes.get_lines()}
    assert lines["diffraction limit"].get_linestyle() == "--"
    np.testing.assert_array_equal(lines["diffraction limit"].get_ydata(), limit)
    np.testing.assert_array_equal(lines["14° tangential"].get_ydata(), curves[1])
    np.testing.assert_array_equal(lines["14° sagittal"].get_ydata(), 0.9 * curves[1])
    assert lines["14° tangential"].get_linestyle() == "-"
    dots = lines["14° sagittal"]._unscaled_dash_pattern
    assert dots[1] is not None and lines["14° tangential"]._unscaled_dash_pattern[1] is None
    names = legend(figure)
    assert names[:3] == ["0°", "14°", "(3, 4)° (no light passes)"]
    assert names[3:] == ["tangential", "sagittal", "diffraction limit"]
    assert axes.get_xlabel() == "frequency (cycles/mm)" and axes.get_xlim() == (0.0, 50.0)


WAVES = [656.2725, 587.5618, 486.1327]


def test_fields_on_both_sides_of_a_lens_share_their_entry_and_have_a_minus(triplet):
    fields = [(0.0, 0.0), (14.0, 0.0), (-14.0, 0.0)]
    frequencies = torch.linspace(0.0, 60.0, 11, dtype=torch.float64)
    figure = modulation_figure(
        modulation(triplet, conditions(triplet, fields, WAVES), frequencies, rays=200)
    )
    labels = legend(figure)
    assert labels[:2] == ["0°", "(14, 0)°, (−14, 0)°"]
    assert not flaws(figure)


def test_each_field_has_one_entry_where_panels_join_other_fields(triplet):
    frequency = torch.linspace(0.0, 50.0, 6).double()
    curve, limit = torch.linspace(1.0, 0.5, 6).double(), torch.linspace(1.0, 0.9, 6)
    where = conditions(triplet, FIELDS[:2], LINES)

    def panel(scales):
        curves = curve * torch.tensor(scales).double()[:, None]
        return Modulation(where, frequency, curves, curves, limit)

    panels = {"apart": panel([1.0, 0.8]), "alike": panel([1.0, 1.0])}
    figure = modulation_figure(panels, labels=["0°", "14° (rays alone)"])
    assert legend(figure)[:3] == ["0°", "14° (rays alone)", "tangential"]
    figure = modulation_figure({"one": panels["alike"], "two": panels["alike"]})
    assert legend(figure)[:2] == ["0°, 14°", "tangential"]
