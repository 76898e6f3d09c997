"""Sections of a lens with its fields, before and after, and in each of its states."""

import numpy as np
import pytest
import torch

from dolens import InputError, load_lens
from dolens.analysis.conditions import conditions, field_scans
from dolens.analysis.field_curves import field_curves
from dolens.plotting import (
    before_after_figure,
    layout_figure,
)
from dolens.plotting.field_curves import states_field_curves_figure
from dolens.plotting.lens_section import (
    lens_section_figure,
    states_layout_figure,
)
from dolens.prescriptions import lens_from_prescription
from tests.optics.test_lens_states import DOUBLET
from tests.plotting.artists import by_gid, legend
from tests.plotting.overlaps import flaws


@pytest.fixture
def states():
    lens = lens_from_prescription(DOUBLET)
    return {name: lens.in_state(name) for name in ("wide", "tele", "near")}


def test_layouts_have_one_scale_and_their_sensors_in_line(states):
    figure = states_layout_figure(states, title="Two lenses")
    widths, ends = [], []
    for axes, lens in zip(figure.axes, states.values(), strict=True):
        low, high = axes.get_xlim()
        (sensor,) = by_gid(axes, "sensor")
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
        curves[name] = field_curves(lens, scan, [587.5618])
    figure = states_field_curves_figure(curves)
    assert [axes.get_ylabel() for axes in figure.axes[:3]] == ["field (degrees)", "", "field (mm)"]


def test_nothing_to_draw_is_refused():
    with pytest.raises(InputError, match="needs one state or more"):
        states_layout_figure({})


LINES = (656.2725, 587.5618, 486.1327)


def test_the_section_names_fields_in_the_lens_s_own_unit(triplet):
    fields = torch.tensor([[0.0, 0.0], [0.0, -80.0], [5.0, 5.0]], dtype=torch.float64)
    figure = lens_section_figure(triplet, conditions(triplet, fields, LINES, 500.0))
    assert legend(figure) == ["0 mm", "−80 mm"]
    # Light from below the axis rises.
    path = by_gid(figure.axes[0], "ray")[-1]
    assert path.get_ydata()[0] < path.get_ydata()[-1]
    assert "object at 500 mm" in figure.axes[0].get_title().replace("\n", " ")


def test_before_and_after_share_their_scale(triplet):
    longer = load_lens("cooke_triplet").requires_grad_(False)
    longer.sensor_distance.add_(20.0)
    figure = before_after_figure(triplet, longer, fields_deg=(0.0, 14.0), rays=3)
    above, below = figure.axes
    assert above.get_xlim() == below.get_xlim() and above.get_ylim() == below.get_ylim()
    assert above.get_aspect() == below.get_aspect() == 1.0
    sensors = [by_gid(axes, "sensor")[0].get_xdata()[0] for axes in figure.axes]
    assert sensors[1] - sensors[0] == pytest.approx(20.0)
    assert above.get_title().startswith("(a) Cooke triplet, initial: f = 50.02 mm, F/4.9")
    alone = layout_figure(triplet, fields_deg=(0.0, 14.0), rays=3).axes[0]
    for one, other in zip(by_gid(above, "ray"), by_gid(alone, "ray"), strict=True):
        np.testing.assert_array_equal(one.get_xydata(), other.get_xydata())
    assert not flaws(figure)
    named = before_after_figure(triplet, longer, titles=("start", "end"))
    assert [axes.get_title() for axes in named.axes] == ["start", "end"]


@pytest.mark.parametrize("name", ["nikon", "wavefront_coding", "freeform_corrector"])
def test_labels_of_wide_and_slender_lenses_stay_within_the_figure(name):
    lens = load_lens(name).requires_grad_(False)
    assert not flaws(before_after_figure(lens, lens, fields_deg=(-2.0, 0.0, 2.0, 10.0), rays=3))
