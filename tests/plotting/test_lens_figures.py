"""Figures of field curves, colour, encircled energy, illumination, MTF and PSFs."""

import math

import numpy as np
import pytest
import torch

from dolens import load_lens
from dolens.analysis.conditions import field_scans
from dolens.analysis.encircled_energy import encircled_energy
from dolens.analysis.field_curves import field_curves
from dolens.analysis.lateral_colour import chromatic_focal_shift, lateral_colour
from dolens.diffraction.illumination import relative_illumination
from dolens.diffraction.modulation_transfer import diffraction_modulation
from dolens.diffraction.point_spread import diffraction_encircled_energy, point_spread
from dolens.errors import InputError
from dolens.plotting.captions import caption, plain_text, wavelengths_text
from dolens.plotting.field_curves import (
    field_curves_figure,
    illumination_figure,
    lateral_colour_figure,
)
from dolens.plotting.lens_section import lens_section_figure
from dolens.plotting.modulation import modulation_comparison_figure
from dolens.plotting.point_spread import encircled_energy_figure, point_spread_figure

LINES = (656.2725, 587.5618, 486.1327)
DARK = [(0.0, 0.0), (0.0, 45.0)]


@pytest.fixture(scope="module")
def triplet(root):
    return load_lens(root / "conf/lens/cooke_triplet.yaml").requires_grad_(False)


@pytest.fixture(scope="module")
def corrector(root):
    return load_lens(root / "conf/lens/freeform_corrector.yaml").requires_grad_(False)


def artists(axes, gid):
    return [line for line in axes.lines if line.get_gid() == gid]


def legend(figure):
    found = [text.get_text() for box in figure.legends for text in box.get_texts()]
    for axes in figure.axes:
        box = axes.get_legend()
        found += [text.get_text() for text in box.get_texts()] if box else []
    return found


def test_field_curves_stand_beside_distortion(triplet):
    (scan,) = field_scans(triplet, None, 20.0, 5)
    curves = field_curves(triplet, scan, LINES)
    left, right = field_curves_figure(curves).axes
    assert len(artists(left, "tangential")) == len(artists(left, "sagittal")) == 3
    np.testing.assert_array_equal(
        artists(left, "tangential")[1].get_xdata(), curves.tangential[:, 1]
    )
    assert left.get_xlabel() == "focus from the sensor (mm)"
    assert left.get_ylabel() == "field (degrees)"
    (line,) = artists(right, "distortion")
    np.testing.assert_array_equal(line.get_xdata(), curves.distortion)
    assert right.get_xlabel() == "distortion (%)"


def test_a_lens_without_symmetry_has_a_row_for_each_axis(corrector):
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
    assert len(artists(left, "lateral colour")) == 3 and "µm" in left.get_xlabel()
    assert "µm" in right.get_ylabel() and right.get_xlabel() == "wavelength (nm)"
    assert "± Airy radius" in legend(figure)


def test_fields_without_light_are_named_so(triplet):
    frequency = [0.0, 20.0, 40.0]
    mtf = diffraction_modulation(triplet, DARK, LINES[1:2], frequency)
    assert "45° (no light passes)" in legend(modulation_comparison_figure(mtf))
    waves = diffraction_encircled_energy(triplet, DARK, LINES[1:2], [5.0, 10.0])
    rays = encircled_energy(triplet, DARK, LINES[1:2], [5.0, 10.0], rays=40)
    figure = encircled_energy_figure(waves, rays)
    assert "45° (no light passes)" in legend(figure)
    drawn = [np.asarray(line.get_ydata()) for line in artists(figure.axes[0], "energy")]
    assert sum(bool(np.isfinite(line).all()) for line in drawn) == 2
    psf = point_spread(triplet, DARK, LINES[1:2], cells=32)
    titles = [axes.get_title() for axes in point_spread_figure(psf).axes]
    assert titles[0].startswith("0°\nStrehl ratio 0.2")
    assert titles[1] == "45°\nno light passes"


def test_point_spread_functions_have_axes_in_micrometres(triplet):
    psf = point_spread(triplet, [(0.0, 14.0)], LINES[1:2], cells=32)
    figure = point_spread_figure(psf, None)
    axes = figure.axes[0]
    (picture,) = axes.images
    half = float(psf.half_width_um[0])
    assert picture.get_extent() == [-half, half, -half, half]
    assert float(np.max(picture.get_array())) == 1.0 and picture.origin == "lower"
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (µm)", "y (µm)")


def test_illumination_is_in_percent_of_the_axis(triplet):
    (scan,) = field_scans(triplet, None, 20.0, 5)
    found = relative_illumination(triplet, scan)
    (axes,) = illumination_figure(found).axes
    (line,) = artists(axes, "illumination")
    assert float(line.get_ydata()[0]) == pytest.approx(100.0, abs=1e-6)
    assert axes.get_ylabel() == "irradiance (% of the axis)"


def test_the_section_names_fields_in_the_lens_s_own_unit(triplet):
    fields = torch.tensor([[0.0, 0.0], [0.0, -80.0], [5.0, 5.0]], dtype=torch.float64)
    figure = lens_section_figure(triplet, fields, LINES, "mm", 500.0)
    assert legend(figure) == ["0 mm", "−80 mm"]
    # Light from below the axis rises.
    path = [line for line in figure.axes[0].lines if line.get_gid() == "ray"][-1]
    assert path.get_ydata()[0] < path.get_ydata()[-1]
    assert "object at 500 mm" in figure.axes[0].get_title().replace("\n", " ")


def test_captions_name_lens_aperture_and_light(triplet):
    assert caption("Fans", triplet, LINES) == "Fans: Cooke triplet, F/4.93, 486.1, 587.6, 656.3 nm"
    long = caption("Point spread functions", triplet, LINES)
    assert long == "Point spread functions: Cooke triplet,\nF/4.93, 486.1, 587.6, 656.3 nm"
    assert "working F/" in caption("Fans", triplet, LINES, 500.0)
    assert wavelengths_text([587.5618]) == "587.6 nm"
    assert wavelengths_text(range(400, 800, 100)) == "4 wavelengths from 400 to 700 nm"
    assert plain_text("a\nb $c$") == r"a b \$c\$"
    assert len(plain_text("x" * 100)) == 50


def test_nothing_to_plot_is_refused():
    with pytest.raises(InputError, match="MTF"):
        modulation_comparison_figure()
    assert math.isfinite(encircled_energy_figure().get_figheight())
