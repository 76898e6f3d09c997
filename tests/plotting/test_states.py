"""States of a lens are drawn at one scale, their sensors below each other."""

import numpy as np
import pytest

from dolens import InputError
from dolens.analysis.conditions import field_scans
from dolens.analysis.field_curves import field_curves
from dolens.plotting.lens_section import states_field_curves_figure, states_layout_figure
from dolens.prescriptions import lens_from_prescription
from tests.optics.test_lens_states import DOUBLET


@pytest.fixture
def states():
    lens = lens_from_prescription(DOUBLET)
    return {name: lens.in_state(name) for name in ("wide", "tele", "near")}


def test_layouts_have_one_scale_and_their_sensors_in_line(states):
    figure = states_layout_figure(states, title="Two lenses")
    widths, ends = [], []
    for axes, lens in zip(figure.axes, states.values(), strict=True):
        low, high = axes.get_xlim()
        (sensor,) = [line for line in axes.lines if line.get_gid() == "sensor"]
        z = float(np.mean(sensor.get_xdata()))
        assert z == pytest.approx(float(lens.system().vertices[-1].detach()), rel=1e-12)
        widths.append(high - low)
        ends.append((z - low) / (high - low))
    assert np.ptp(widths) < 1e-9 and np.ptp(ends) < 1e-12
    assert "object at 500 mm" in figure.axes[2].get_title()


def test_field_curves_name_the_unit_of_each_state(states):
    curves = {}
    for name, lens in states.items():
        scan = field_scans(lens, lens.object_distance)[0]
        curves[name] = field_curves(lens, scan, [587.5618], lens.object_distance)
    figure = states_field_curves_figure(curves)
    assert [axes.get_ylabel() for axes in figure.axes[:3]] == ["field (degrees)", "", "field (mm)"]


def test_nothing_to_draw_is_refused():
    with pytest.raises(InputError, match="needs one state or more"):
        states_layout_figure({})
