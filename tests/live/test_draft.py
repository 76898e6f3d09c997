"""Drafts follow the analyses that they stand for."""

import io
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from PIL import Image

from dolens import InputError, load_lens
from dolens.analysis.conditions import conditions
from dolens.analysis.modulation_transfer import modulation
from dolens.analysis.spot_diagram import spot_diagram
from dolens.live.draft import Draft, section_profiles
from dolens.live.draft_picture import HEIGHT, WIDTH, DraftCamera, picture_to_photograph
from dolens.optics.surfaces.clear_aperture import Circle
from dolens.plotting.section import surface_profile


@cache
def draft_of(name):
    lens = load_lens(name).requires_grad_(False)
    return Draft(lens, conditions(lens))


@pytest.fixture(scope="module", params=["cooke_triplet", "double_gauss", "phone"])
def draft(request):
    return draft_of(request.param)


def test_rms_radii_are_those_of_the_spot_diagram(draft):
    exact = spot_diagram(draft.lens, draft.where, 1000).polychromatic_rms
    torch.testing.assert_close(draft.spots[1], exact, rtol=0.06, atol=0.0)


def test_rays_that_pass_the_stop_far_from_their_beam_are_none_of_it():
    draft = draft_of("published/tessar_us2838978")  # where nothing but the stop clips
    exact = spot_diagram(draft.lens, draft.where, 1000).polychromatic_rms
    torch.testing.assert_close(draft.spots[1], exact, rtol=0.1, atol=0.0)


def test_contrast_is_that_of_rays_times_that_of_a_perfect_lens(draft):
    frequencies, curves = draft.modulation()
    exact = modulation(draft.lens, draft.where, frequencies, 2000)
    wanted = torch.stack((exact.tangential, exact.sagittal), 1) * exact.diffraction_limit
    assert (curves[:, :, 0] - 1.0).abs().max() < 1e-6
    torch.testing.assert_close(curves, wanted, rtol=0.0, atol=0.06)


def test_spots_are_smallest_where_the_best_focus_is_said_to_be():
    draft = draft_of("cooke_triplet")

    def spread(shift):
        distance = draft.lens.sensor_distance + shift
        moved = draft.lens.with_values({"sensor_distance": distance})
        return float(Draft(moved, draft.where).spots[1].square().mean())

    best = draft.focus_shift
    assert abs(best) > 1e-3
    assert spread(best) < min(spread(best + 0.002), spread(best - 0.002), spread(0.0))


def test_ray_fans_end_where_the_aperture_does_and_cross_zero_in_the_middle():
    draft = draft_of("cooke_triplet")
    fans = draft.ray_fans()
    assert fans.shape == (3, 3, 2, 21)
    reference = draft.where.wavelengths.tolist().index(draft.where.reference_wavelength)
    assert fans[:, reference, :, 10].abs().max() == 0.0
    assert fans.isfinite().float().mean() > 0.97
    # On the axis both fans are one odd function.
    axial = fans[0, reference]
    torch.testing.assert_close(axial[0], axial[1], atol=1e-6, rtol=0.0)
    torch.testing.assert_close(axial[0], -axial[0].flip(0), atol=0.05, rtol=0.0)


@pytest.mark.parametrize("name", ["cooke_triplet", "phone", "wavefront_coding"])
def test_the_section_is_that_of_draw(name):
    draft = draft_of(name)
    system = draft.lens.system()
    for number, (z, y) in enumerate(section_profiles(system), 1):
        exact_z, exact_y = surface_profile(system, number)
        np.testing.assert_allclose(z, np.interp(y, exact_y, exact_z), atol=2e-3 * np.ptp(y))
        np.testing.assert_allclose([y[0], y[-1]], [exact_y[0], exact_y[-1]])


def test_rays_of_the_section_pass_the_stop_and_end_on_the_sensor():
    draft = draft_of("cooke_triplet")
    rays = draft.section_rays(-10.0, 7)
    track = sum(draft.lens.thicknesses.values()) + draft.lens.sensor_distance
    for field, paths in zip(draft.where.fields, rays, strict=True):
        assert paths.shape == (7, 8, 2)
        np.testing.assert_allclose(paths[:, 0, 0], -10.0)
        np.testing.assert_allclose(paths[:, -1, 0], float(track))
        assert np.abs(paths[:, draft.lens.stop, 1]).max() < 3.86
        slope = np.diff(paths[:, :2, 1]) / np.diff(paths[:, :2, 0])
        np.testing.assert_allclose(slope, np.tan(np.radians(float(field[1]))), atol=1e-9)


def test_a_lens_that_lets_no_light_pass_is_one_line():
    lens = load_lens("cooke_triplet").requires_grad_(False)
    first = lens.surfaces["1"]
    first.aperture = replace(first.aperture, obscuration=Circle(9.4))
    with pytest.raises(InputError, match="no ray of the first field reaches the sensor"):
        Draft(lens, conditions(lens)).check()


def test_a_photograph_is_blurred_by_the_lens_and_by_nothing_else():
    draft = draft_of("cooke_triplet")
    light = picture_to_photograph(None)
    camera = DraftCamera.of(draft.lens, 0.05, light)

    def sharpness(lens, part):
        now = Draft(lens, draft.where)
        blur = float(now.spots[0].nan_to_num(0.0).norm(dim=-1).max())
        levels = np.asarray(Image.open(io.BytesIO(camera.photograph(lens, part, blur))), float)
        assert levels.shape == (HEIGHT, WIDTH, 3)
        return float(np.abs(np.diff(levels, axis=1)).mean())

    far = draft.lens.with_values({"sensor_distance": draft.lens.sensor_distance + 0.8})
    for part in ("centre", "edge"):
        assert sharpness(far, part) < 0.7 * sharpness(draft.lens, part)
    lost = draft.lens.with_values({"sensor_distance": draft.lens.sensor_distance + 40.0})
    with pytest.raises(InputError, match="from their centroid, too far"):
        sharpness(lost, "edge")
