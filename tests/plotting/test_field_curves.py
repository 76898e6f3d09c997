"""Figures over the field: curvature, colour, RMS radii, illumination."""

import math

import numpy as np
import pytest
import torch

from dolens import load_lens
from dolens.analysis.conditions import conditions, field_scans
from dolens.analysis.field_curves import field_curves
from dolens.analysis.lateral_colour import chromatic_focal_shift, lateral_colour
from dolens.analysis.spot_diagram import RMSCurves
from dolens.diffraction.illumination import relative_illumination
from dolens.errors import InputError
from dolens.plotting import (
    rms_curves_figure,
)
from dolens.plotting.field_curves import (
    field_curves_figure,
    illumination_figure,
    lateral_colour_figure,
)
from tests.plotting.artists import by_gid, legend

LINES = (656.2725, 587.5618, 486.1327)
WAVES = torch.tensor([656.2725, 486.1327], dtype=torch.float64)


def test_field_curves_stand_beside_distortion(triplet):
    (scan,) = field_scans(triplet, None, 20.0, 5)
    curves = field_curves(triplet, scan, LINES)
    left, right = field_curves_figure(curves).axes
    assert len(by_gid(left, "tangential")) == len(by_gid(left, "sagittal")) == 3
    np.testing.assert_array_equal(
        by_gid(left, "tangential")[1].get_xdata(), curves.tangential[:, 1]
    )
    assert left.get_xlabel() == "focus from the sensor (mm)"
    assert left.get_ylabel() == "field (degrees)"
    (line,) = by_gid(right, "distortion")
    np.testing.assert_array_equal(line.get_xdata(), curves.distortion)
    assert right.get_xlabel() == "distortion (%)"


def test_a_lens_without_symmetry_has_a_row_for_each_axis():
    corrector = load_lens("freeform_corrector").requires_grad_(False)
    curves = [field_curves(corrector, scan, LINES[:1]) for scan in field_scans(corrector, count=3)]
    axes = field_curves_figure(curves).axes
    assert [a.get_ylabel() for a in axes[::2]] == [
        "field along y (degrees)",
        "field along x (degrees)",
    ]
    assert axes[0].get_ylim() == (-2.0, 2.0)


def test_chromatic_aberrations_are_plotted_in_micrometres(triplet):
    (scan,) = field_scans(triplet, None, 20.0, 5)
    colour = lateral_colour(triplet, scan, LINES)
    figure = lateral_colour_figure(colour, chromatic_focal_shift(triplet, count=5))
    left, right = figure.axes
    assert len(by_gid(left, "lateral colour")) == 3 and "µm" in left.get_xlabel()
    assert "µm" in right.get_ylabel() and right.get_xlabel() == "wavelength (nm)"
    assert "± Airy radius" in legend(figure)


def test_illumination_is_in_percent_of_the_axis(triplet):
    (scan,) = field_scans(triplet, None, 20.0, 5)
    found = relative_illumination(triplet, scan)
    (axes,) = illumination_figure(found).axes
    (line,) = by_gid(axes, "illumination")
    assert float(line.get_ydata()[0]) == pytest.approx(100.0, abs=1e-6)
    assert axes.get_ylabel() == "irradiance (% of the axis)"


FIELDS = torch.tensor([[0.0, 0.0], [0.0, 14.0], [3.0, 4.0]], dtype=torch.float64)


def test_rms_curves_are_in_micrometres_over_degrees_and_nanometres(triplet):
    rms = torch.tensor([[1.0, 2.0], [3.0, math.nan], [5.0, 6.0]], dtype=torch.float64) * 1e-3
    where = conditions(triplet, FIELDS, WAVES)
    curves = RMSCurves(where, rms, rms[:, 0], torch.tensor([2e-3, 8e-3]))
    left, right = rms_curves_figure(curves, curves, "RMS").axes
    lines = {line.get_label(): line for line in left.get_lines()}
    np.testing.assert_allclose(lines["656.273 nm"].get_data(), [[0, 14, 5], [1, 3, 5]])
    np.testing.assert_allclose(lines["all, common centroid"].get_ydata(), [1, 3, 5])
    assert left.get_xlabel() == "field (°)"
    assert left.get_ylabel() == "RMS spot radius (µm)"
    lines = {line.get_label(): line for line in right.get_lines()}
    np.testing.assert_allclose(lines["14°"].get_ydata(), [3, math.nan])
    np.testing.assert_allclose(lines["Airy radius"].get_ydata(), [2, 8])
    assert right.get_xlabel() == "wavelength (nm)"
    # One scale, which holds everything.
    assert left.get_ylim() == right.get_ylim() and left.get_ylim()[1] > 8.0
    assert len(rms_curves_figure(against_wavelength=curves).axes) == 1
    with pytest.raises(InputError, match="needs curves"):
        rms_curves_figure()


def test_fields_on_both_sides_of_the_axis_are_plotted_on_both_sides(triplet):
    """A lens that is tilted in y blurs fields above the axis unlike those below."""
    fields = torch.tensor([[0.0, -2.0], [0.0, 0.0], [0.0, 2.0]], dtype=torch.float64)
    rms = torch.tensor([[3.0], [1.0], [2.0]], dtype=torch.float64) * 1e-3
    where = conditions(triplet, fields, WAVES[:1])
    curves = RMSCurves(where, rms, rms[:, 0], torch.tensor([2e-3]))
    (axes,) = rms_curves_figure(curves).axes
    np.testing.assert_allclose(axes.get_lines()[0].get_data(), [[-2, 0, 2], [3, 1, 2]])
    assert axes.get_xlabel() == "field along y (°)" and axes.get_xlim() == (-2.0, 2.0)
