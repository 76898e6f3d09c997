"""Point spread functions and MTF by Huygens's wavelets, and what sampling leaves of them."""

import math

import numpy as np
import pytest
import torch
from scipy.special import j1

from dolens import load_lens
from dolens.analysis.conditions import conditions
from dolens.analysis.modulation_transfer import diffraction_limited_transfer
from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.huygens import huygens_irradiance, huygens_modulation, huygens_point_spread
from dolens.diffraction.modulation_transfer import diffraction_modulation
from dolens.diffraction.point_spread import point_spread
from dolens.diffraction.wavefront import pupil_wavefront
from dolens.errors import InputError
from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture
from dolens.prescriptions import lens_from_prescription
from tests.diffraction.perfect_lenses import N, hyperbola, relay

WAVELENGTH, LAMBDA = 500.0, 500e-6
AXIS = [(0.0, 0.0)]


def cells(found):
    """Distances (M, M), mm, of cells from the centre of a window."""
    count, half = found.irradiance.shape[-1], 1e-3 * float(found.half_width_um[0])
    place = (torch.arange(count).double() + 0.5) * (2.0 * half / count) - half
    return torch.hypot(place[:, None], place[None]).numpy()


def jinc(v):
    """2·J₁(v)/v."""
    v = np.maximum(np.abs(v), 1e-9)
    return 2.0 * j1(v) / v


@pytest.mark.parametrize("rays", [None, 20, 32, 45, 60])
def test_airy_s_pattern_and_its_sampling_error(rays):
    """[2J₁(v)/v]², with π·a²/(λf)² of the light at its peak; the estimate is the error's size."""
    options = {"cells": 24, "half_width_um": 60.0}
    if rays:  # sums so coarse that they err by some of their estimates
        options = {"cells": 15, "half_width_um": 40.0, "rays": rays}
    lens = hyperbola(100.0, 1.0)
    found = huygens_point_spread(lens, conditions(lens, AXIS, [WAVELENGTH]), **options)
    peak = 1e-6 * math.pi / (LAMBDA * 100.0) ** 2
    expected = jinc(2.0 * math.pi / LAMBDA / 100.0 * cells(found)) ** 2
    wrong = float(np.abs(found.irradiance[0].numpy() / peak - expected).max())
    if rays:
        assert wrong < 3.0 * float(found.sampling_error) + 2e-4
        return
    assert wrong < 4e-4
    assert 0.0 < float(found.sampling_error) < 1e-3
    assert float(found.strehl_ratio) == pytest.approx(1.0, abs=1e-4)
    assert found.diffraction == (True,)


@pytest.mark.parametrize("inner", [0.3, 0.6])
def test_a_ring_s_pattern(inner):
    """[2J₁(v)/v - ε²·2J₁(εv)/(εv)]²/(1 - ε²)² (Born and Wolf, 8.6.2)."""
    stop = ClearAperture(Circle(1.0), Circle(inner))
    lens = hyperbola(100.0, stop)
    found = huygens_point_spread(
        lens,
        conditions(lens, AXIS, [WAVELENGTH]),
        cells=24,
        half_width_um=60.0,
    )
    v = 2.0 * math.pi / LAMBDA / 100.0 * cells(found)
    expected = ((jinc(v) - inner**2 * jinc(inner * v)) / (1.0 - inner**2)) ** 2
    peak = 1e-6 * math.pi * (1.0 - inner**2) / (LAMBDA * 100.0) ** 2
    np.testing.assert_allclose(found.irradiance[0].numpy() / peak, expected, atol=2e-3)


@pytest.mark.parametrize("waves", [0.5, 1.6, 4.5])
def test_far_out_of_focus_the_axis_follows_sinc_squared(waves):
    """Fresnel's diffraction of a wave that converges at f beyond a hole of radius a, on the axis at
    f + δ: π·a²/(λ(f + δ))²·(sin πW/πW)², W = a²/2λ·(1/f - 1/(f + δ)) (Born and Wolf, 8.8.2).

    The hole is the exit pupil, which the lens makes of the stop 4 mm of glass before it.
    """
    focal, larger = 100.0, 1.0 / (1.0 - 4.0 / N / 100.0)
    shift = 2.0 * waves * LAMBDA * focal**2
    lens = hyperbola(focal, 1.0, defocus=shift)
    front = pupil_wavefront(
        lens.system(), ObjectPoints.at_infinity(AXIS), WAVELENGTH, [[0.0, 0.0]], 128
    )
    zero = torch.zeros(1).double()
    centre = float(huygens_irradiance(front, zero, zero) / front.flux)
    aperture, near, far = larger, focal * larger, focal * larger + shift
    phase = math.pi * 0.5 * aperture**2 * (1.0 / near - 1.0 / far) / LAMBDA
    perfect = math.pi * aperture**2 / (LAMBDA * far) ** 2
    assert centre == pytest.approx((math.sin(phase) / phase) ** 2 * perfect, abs=2e-4 * perfect)


def test_a_tilted_image_keeps_its_light_and_stretches():
    """A plane turned by 60° about x meets the cone of light over twice the length along y; where
    one point of it is in focus its pattern is Airy's, along y by 1/cos wider.
    """
    rows = {
        "1": {
            "type": "paraxial_lens",
            "focal_length": 100.0,
            "semi_diameter": 0.5,
            "thickness": 100.0,
            "material": "air",
        },
        "2": {"type": "coordinate_break", "tilt_x": 60.0},
    }
    lens = lens_from_prescription({"surfaces": rows, "sensor": {"distance": 0.0}})
    found = huygens_point_spread(
        lens, conditions(lens, AXIS, [WAVELENGTH]), cells=24, half_width_um=150.0
    )
    assert float(found.held) == pytest.approx(0.93, abs=0.04)
    place = (torch.arange(24).double() + 0.5) * (300.0 / 24) - 150.0
    x, y = 1e-3 * place[None].numpy(), 1e-3 * place[:, None].numpy() * math.cos(math.radians(60.0))
    expected = jinc(2.0 * math.pi / LAMBDA * 0.5 / 100.0 * np.hypot(x, y)) ** 2
    pattern = (found.irradiance[0] / found.irradiance[0].max()).numpy()
    expected = expected / expected.max()
    np.testing.assert_allclose(pattern, expected, atol=5e-3)


def test_both_ways_agree_for_the_triplet(root):
    """Off the axis, clipped: the transform of the fitted pupil, and the sum over its rays; they
    differ by no more than they say of themselves.
    """
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml").requires_grad_(False)
    field = [(0.0, 20.0)]
    where = conditions(lens, field, [587.5618])
    sums = huygens_point_spread(lens, where, cells=17, half_width_um=30.0)
    # At the centres of as many cells: the mean over a fifteenth of each.
    fine = point_spread(lens, where, cells=17 * 15, half_width_um=30.0)
    transform = fine.irradiance[0, 7::15, 7::15]
    wrong = (sums.irradiance[0] - transform).abs().max() / transform.max()
    assert float(wrong) < 2.0 * float(sums.sampling_error) + float(fine.sampling_error)
    assert float(sums.sampling_error) < 0.01
    assert float(sums.strehl_ratio) == pytest.approx(float(fine.strehl_ratio), abs=2e-3)


def test_a_near_object_s_image_is_perfect_too():
    """Two hyperboloids relay the axial point at 1:1 and F/6."""
    lens = relay(60.0)
    where = conditions(lens, AXIS, [WAVELENGTH], 60.0)
    found = huygens_point_spread(lens, where, cells=24, half_width_um=12.0)
    assert float(found.strehl_ratio) == pytest.approx(1.0, abs=1e-4)


def test_fewer_rays_than_half_turns_are_refused():
    lens = hyperbola(100.0, 2.0)
    where = conditions(lens, AXIS, [WAVELENGTH])
    with pytest.raises(InputError, match="differ by more than half a turn; give 1"):
        huygens_point_spread(lens, where, half_width_um=1000.0, rays=64)
    with pytest.raises(InputError, match="too many to add up"):
        huygens_point_spread(lens, where, cells=512, rays=1024)
    with pytest.raises(InputError, match="two cells"):
        huygens_point_spread(lens, where, cells=1)


def test_mtf_is_the_overlap_of_two_pupils():
    lens = hyperbola(100.0, 2.5)
    cutoff = 1.0 / (LAMBDA * 20.0)
    frequencies = cutoff * torch.tensor([0.0, 0.2, 0.5, 0.8]).double()
    found = huygens_modulation(lens, conditions(lens, AXIS, [WAVELENGTH]), frequencies)
    expected = diffraction_limited_transfer(frequencies, WAVELENGTH, 20.0)
    for curve in (found.tangential[0], found.sagittal[0]):
        wrong = (curve - expected).abs()
        assert float(wrong.max()) < float(found.sampling_error)
        # What lies beyond the window is missing at low frequencies alone.
        assert float(wrong[1:].max()) < 3e-3
    assert float(found.sampling_error) < 0.03


def test_mtf_by_wavelets_is_the_autocorrelation_s(root):
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml").requires_grad_(False)
    frequencies = [20.0, 50.0, 100.0]
    where = conditions(lens, [(0.0, 0.0)], [587.5618])
    sums = huygens_modulation(lens, where, frequencies)
    other = diffraction_modulation(lens, where, frequencies)
    allowed = float(sums.sampling_error + other.sampling_error)
    for one, two in ((sums.tangential, other.tangential), (sums.sagittal, other.sagittal)):
        assert float((one - two).abs().max()) < allowed
    assert allowed < 0.05


@pytest.mark.parametrize("name, step", [("surfaces.2.curvature", 1e-6), ("sensor_distance", 1e-4)])
def test_gradients_are_derivatives(name, step):
    lens = hyperbola(50.0, 5.0, defocus=0.02)
    stored = dict(lens.named_parameters())[name].detach()
    x, y = torch.tensor([0.0, 0.003, 0.001]).double(), torch.tensor([0.0, -0.002, 0.004]).double()

    def values(value):
        front = pupil_wavefront(
            *(lens.system({name: value}), ObjectPoints.at_infinity(AXIS), WAVELENGTH),
            *([[0.0, 0.0]], 24, 50.0),
        )
        return huygens_irradiance(front, x, y)[0]

    at = stored.clone().requires_grad_()
    gradient = torch.stack([torch.autograd.grad(v, at, retain_graph=True)[0] for v in values(at)])
    near = [
        (values(stored + k * step) - values(stored - k * step)) / (2 * k * step) for k in (1, 2)
    ]
    assert torch.allclose(gradient, (4.0 * near[0] - near[1]) / 3.0, rtol=2e-5)
