"""Figures: what is drawn is what was traced."""

import numpy as np
import pytest
import torch
from matplotlib.image import AxesImage

from dolens import load_lens
from dolens.errors import InputError
from dolens.plotting import (
    comparison_figure,
    curves_figure,
    figure_to_image,
    layout_figure,
    psf_figure,
    save_figure,
)


def artists(figure, gid):
    return [a for axes in figure.axes for a in axes.get_children() if a.get_gid() == gid]


@pytest.fixture
def triplet(root):
    return load_lens(root / "conf/lens/cooke_triplet.yaml")


@pytest.mark.parametrize("rays", [1, 5])
def test_every_ray_of_a_fan_is_drawn_from_before_the_lens_to_the_sensor(triplet, rays):
    figure = layout_figure(triplet, fields_deg=(0.0, 10.0), rays=rays)
    lines = artists(figure, "ray")
    assert len(lines) == 2 * rays
    sensor_z = float(triplet.system().vertices[-1])
    for line in lines:
        z = line.get_xdata()
        assert len(z) == 6 + 2
        assert z[0] < 0 and z[-1] == pytest.approx(sensor_z)


def test_axial_rays_meet_near_the_printed_focus(triplet):
    figure = layout_figure(triplet, rays=5)
    heights = [line.get_ydata()[-1] for line in artists(figure, "ray")]
    assert np.ptp(heights) < 0.05  # F/4.9, tens of µm at the printed sensor


def test_a_surface_ends_at_its_semi_diameter(triplet):
    figure = layout_figure(triplet)
    for number, surface in triplet.surfaces.items():
        (line,) = artists(figure, f"surface {number}")
        y = np.asarray(line.get_ydata())
        assert y.max() == pytest.approx(surface.semi_diameter)
        c = float(surface.curvature.detach())
        edge = surface.semi_diameter
        sag = c * edge**2 / (1 + np.sqrt(1 - c**2 * edge**2))
        vertex = float(triplet.system().vertices[int(number) - 1])
        assert np.asarray(line.get_xdata())[-1] == pytest.approx(vertex + sag, abs=1e-9)


def test_glass_is_filled_and_air_is_not(triplet):
    figure = layout_figure(triplet)
    assert [len(artists(figure, f"glass {n}")) for n in range(1, 7)] == [1, 0, 1, 0, 1, 0]


def test_the_sensor_is_drawn_where_it_is_and_as_large_as_it_is(triplet):
    (line,) = artists(layout_figure(triplet), "sensor")
    assert line.get_xdata()[0] == pytest.approx(60.177)
    assert np.ptp(line.get_ydata()) == pytest.approx(36.346)


def test_a_phase_plate_too_flat_to_see_has_axes_in_micrometres(root):
    lens = load_lens(root / "conf/lens/wavefront_coding.yaml")
    with torch.no_grad():
        lens.surfaces["5"].x3.fill_(1.3e-5)
    figure = layout_figure(lens)
    assert len(figure.axes) == 2
    heights = np.concatenate([line.get_ydata() for line in figure.axes[1].lines])
    assert heights.max() == pytest.approx(1.3e-5 * 6.35**3 * 1e3, rel=1e-3)


def test_a_field_that_no_ray_passes_is_said_so(triplet):
    figure = layout_figure(triplet, fields_deg=(0.0, 70.0))
    texts = [t.get_text() for t in figure.axes[0].get_legend().get_texts()]
    assert texts[1] == "70° (no ray passes)"


def test_an_object_inside_the_lens_is_an_error(triplet):
    with pytest.raises(InputError, match="object_distance"):
        layout_figure(triplet, object_distance=-5.0)


def test_psfs_get_a_panel_a_depth_cropped_alike():
    psfs = torch.zeros(2, 3, 33, 33)
    psfs[0, :, 16, 16] = 1.0
    psfs[1, :, 12:21, 12:21] = 1 / 81
    figure = psf_figure(psfs, ["8m", "6m"], 0.0069, "PSF")
    images = [a for axes in figure.axes for a in axes.get_children() if isinstance(a, AxesImage)]
    assert [axes.get_title() for axes in figure.axes] == ["8m", "6m"]
    assert {image.get_array().shape for image in images} == {(9, 9, 3)}
    with pytest.raises(InputError, match="labels"):
        psf_figure(psfs, ["8m"], 0.0069)


def test_a_comparison_shows_truth_raw_and_restored_with_their_quality():
    truth = torch.full((3, 8, 8), 0.5)
    stack = truth.expand(2, 3, 8, 8)
    quality = {"raw": [20.0, 21.0], "restored": [30.0, 31.04]}
    figure = comparison_figure(truth, stack * 0.5, stack, ["8m", "6m"], quality)
    titles = [axes.get_title() for axes in figure.axes]
    assert titles == [
        "truth",
        "raw, 8m: 20.0 dB",
        "raw, 6m: 21.0 dB",
        "restored, 8m: 30.0 dB",
        "restored, 6m: 31.0 dB",
    ]
    shown = figure.axes[1].get_images()[0].get_array()
    assert float(np.asarray(shown).mean()) == pytest.approx(0.25)
    with pytest.raises(InputError, match="expected truth"):
        comparison_figure(truth, stack, stack[:1], ["8m", "6m"])


def test_curves_are_drawn_by_name():
    figure = curves_figure({"a": ([0, 1], [1, 2]), "b": ([0, 1], [2, 3])}, "x", "y", logy=True)
    axes = figure.axes[0]
    assert [t.get_text() for t in axes.get_legend().get_texts()] == ["a", "b"]
    assert axes.get_yscale() == "log"


def test_a_figure_becomes_an_image_and_a_file(triplet, tmp_path):
    figure = layout_figure(triplet)
    image = figure_to_image(figure, dpi=50)
    assert image.dtype == torch.uint8 and image.shape[0] == 3
    assert image.float().std() > 1.0
    save_figure(figure, tmp_path / "deep" / "layout.png")
    assert (tmp_path / "deep" / "layout.png").read_bytes()[:4] == b"\x89PNG"
