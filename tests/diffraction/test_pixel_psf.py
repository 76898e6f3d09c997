"""Kernels of pixels with diffraction, and the choice of how light is propagated."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import dblquad, quad
from scipy.special import j1

from dolens.diffraction import pixel_psf as wave_psf
from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.pixel_psf import (
    PixelWindow,
    fine_grid,
    pixel_matrix,
    propagation,
    quadratic_b_spline,
    wave_kernels,
)
from dolens.diffraction.propagation import DiffractionSettings, choose_propagation
from dolens.diffraction.pupil_fit import fit_pupil, regular_pupil
from dolens.diffraction.wavefront import pupil_wavefront
from dolens.errors import InputError
from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture
from dolens.rendering.psf import axial_point_spread_functions, splat
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor
from tests.diffraction.perfect_lenses import ellipse, hyperbola, pinhole

AXIS = ObjectPoints.at_infinity([[0.0, 0.0]])
CENTRE = [[0.0, 0.0]]
LINES = [656.2725, 587.5618, 486.1327]
DEPTHS = [8000.0, 6000.0, 4500.0]


@pytest.fixture
def coding(wavefront_coding):
    """The wavefront-coding lens, with its cubic plate where no other strength is given."""
    return lambda plate=1.5e-5, dtype=torch.float64: wavefront_coding(plate, dtype)


def on_axis(depths: list[float]) -> list[list[float]]:
    return [[0.0, 0.0, -depth] for depth in depths]


def test_pixels_integrate_airy_s_pattern():
    """∫∫ [2J₁(v)/v]²·β(x)·β(y), by scipy, for a pixel of 0.9 Airy radii."""
    f, a = 200.0, 2.0
    radius = 0.61 * 500e-6 * f / a
    pitch, size = 0.9 * radius, 7
    found = wave_kernels(hyperbola(f, a).system(), AXIS, 500.0, CENTRE, PixelWindow(pitch, size))[0]
    scale = 2.0 * math.pi / 500e-6 * a / f
    peak = math.pi * a * a / (500e-6 * f) ** 2

    def beta(u: float) -> float:
        return 0.75 - u * u if abs(u) < 0.5 else 0.5 * max(1.5 - abs(u), 0.0) ** 2

    def collected(column: int, row: int) -> float:
        def light(y: float, x: float) -> float:
            v = max(scale * math.hypot(x, y) * pitch, 1e-9)
            return peak * (2.0 * j1(v) / v) ** 2 * beta(x - column) * beta(y - row) * pitch**2

        total = 0.0
        for left in (-1.5, -0.5, 0.5):
            for low in (-1.5, -0.5, 0.5):
                total += dblquad(
                    light,
                    column + left,
                    column + left + 1.0,
                    row + low,
                    row + low + 1.0,
                    epsabs=1e-7,
                    epsrel=1e-6,
                )[0]
        return total

    for column, row in ((0, 0), (1, 0), (2, 1), (3, 3)):
        expected = collected(column, row)
        for i, j in ((column, row), (-column, row), (-row, -column)):
            assert float(found[3 + j, 3 + i]) == pytest.approx(expected, abs=2e-4)


def test_the_pixel_s_weight_is_a_splat_s():
    grid = fine_grid(9, 3, torch.zeros((), dtype=torch.float64))
    matrix = pixel_matrix(9, 3, grid)
    assert torch.allclose(matrix.sum(1), torch.full((9,), 3.0).double())
    inside = (grid.abs() < 3.5).nonzero().flatten()
    for j in inside[::5].tolist():
        point = splat(
            grid[j : j + 1] + 4.0, torch.full((1,), 4.0).double(), torch.ones(1).double(), 9
        )
        assert torch.allclose(matrix[:, j], point.sum(1), atol=1e-15)
    area = quad(lambda u: float(quadratic_b_spline(torch.tensor(u))), -1.5, 1.5)[0]
    assert area == pytest.approx(1.0)


def test_kernels_add_up_to_the_light_that_passes(coding):
    """An axial point's to one, less the tails of the window; the triplet's to its vignetting."""
    kernels = wave_kernels(
        coding().system(), on_axis(DEPTHS), LINES, [[0.0, 0.0]] * 3, PixelWindow(0.0069, 65)
    )
    assert kernels.shape == (3, 65, 65)
    assert float(kernels.min()) >= 0.0
    sums = kernels.detach().sum((1, 2))
    wide = wave_kernels(
        coding().system(), on_axis(DEPTHS), LINES, [[0.0, 0.0]] * 3, PixelWindow(0.0276, 65)
    )
    assert torch.all((sums > 0.99) & (sums < 1.0))
    # Light in Airy's tails falls as one over the window's width.
    assert torch.all((wide.sum((1, 2)) > sums) & (wide.sum((1, 2)) < 1.001))
    assert torch.allclose(1.0 - wide.sum((1, 2)), 0.25 * (1.0 - sums), atol=1.5e-3)


def test_a_shifted_window_holds_the_shifted_kernel(coding):
    """The reference sphere moves with the window, the light does not."""
    lens, pitch = coding(), 0.0069
    points = on_axis([8000.0])
    centred = wave_kernels(lens.system(), points, 550.0, CENTRE, PixelWindow(pitch, 49))[0]
    moved = wave_kernels(
        lens.system(), points, 550.0, [[-2 * pitch, 3 * pitch]], PixelWindow(pitch, 49)
    )[0]
    # x = -2 pixels is stored two columns to the right, y = 3 three rows down.
    wrong = (moved[:-3, :-2] - centred[3:, 2:]).abs().max() / centred.max()
    assert float(centred[:, :2].max()) < 0.1 * float(centred.max())
    assert float(wrong) < 2e-3


def test_an_oblique_star_moves_by_the_focal_length():
    """By f·tan θ: x to the left and y downwards from the window's middle."""
    pitch, lens = 0.002, hyperbola(50.0, 1.0)
    angles = [math.degrees(math.atan(pixels * pitch / 50.0)) for pixels in (4, -6)]
    fields = ObjectPoints.at_infinity([[0.0, 0.0], angles])
    axis, star = wave_kernels(lens.system(), fields, 500.0, CENTRE * 2, PixelWindow(pitch, 33))
    assert torch.allclose(star[:-6, :-4], axis[6:, 4:], atol=2e-3 * float(axis.max()))
    assert divmod(int(star.argmax()), 33) == (16 - 6, 16 - 4)


def test_precisions_agree(coding):
    found = {}
    for dtype in (torch.float32, torch.float64):
        lens = coding(dtype=dtype)
        found[dtype] = wave_kernels(
            lens.system(), on_axis(DEPTHS), LINES, [[0.0, 0.0]] * 3, PixelWindow(0.0069, 33)
        )
        assert found[dtype].dtype == dtype
    wrong = (found[torch.float32] - found[torch.float64]).abs().max()
    assert float(wrong) < 2e-5 * float(found[torch.float64].max())


def test_finer_settings_change_little(coding, triplet):
    """What the default leaves, against four times the samples everywhere."""
    fine = DiffractionSettings(rays=48, degree=16, samples=384, subsamples=8)
    field = ObjectPoints.at_infinity([[5.0, 12.0]])
    cases = [
        (coding().system(), on_axis([8000.0]), CENTRE, PixelWindow(0.0069, 65), 1e-3),
        (coding(0.0).system(), on_axis([5200.0]), CENTRE, PixelWindow(0.0069, 33), 1e-3),
        (triplet.system(), field, [[4.37, 10.62]], PixelWindow(0.003, 33), 3e-3),
    ]
    for system, points, centre, window, tolerance in cases:
        usual = wave_kernels(system, points, 550.0, centre, window)
        exact = wave_kernels(system, points, 550.0, centre, window, fine)
        assert float((usual - exact).abs().max()) < tolerance * float(exact.max())
        assert float((usual - exact).abs().sum()) < 6e-3 * float(exact.sum())


@pytest.mark.parametrize(
    "name, step",
    [("surfaces.5.x3", 1e-8), ("surfaces.2.curvature", 1e-7), ("thicknesses.2", 1e-4)],
)
def test_gradients_are_derivatives(coding, name, step):
    lens = coding()
    generator = torch.Generator().manual_seed(3)
    weight = torch.randn(21, 21, generator=generator, dtype=torch.float64)
    stored = dict(lens.named_parameters())[name].detach()
    # The grid follows the pupil, which the gradient leaves out: an error like that of the sum.
    settings = DiffractionSettings(samples=256, subsamples=4)
    arguments = (on_axis([8000.0]), 600.0, CENTRE, PixelWindow(0.0069, 21), settings)

    def value(x: torch.Tensor) -> torch.Tensor:
        return (weight * wave_kernels(lens.system({name: x}), *arguments)).sum()

    x = stored.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(value(x), x)
    h = [(value(stored + k * step) - value(stored - k * step)) / (2 * k * step) for k in (1, 2)]
    assert float(gradient) == pytest.approx(float(4.0 * h[0] - h[1]) / 3.0, rel=1e-3)


def test_gradients_know_the_stop_s_shadow(triplet):
    """In the triplet the stop is in the middle: curvatures before it change what passes."""
    stored = triplet.surfaces["1"].curvature.detach()
    settings = DiffractionSettings(samples=128, subsamples=3, degree=12)

    def light(x: torch.Tensor) -> torch.Tensor:
        system = triplet.system({"surfaces.1.curvature": x})
        points, centre = ObjectPoints.at_infinity([[0.0, 10.0]]), [[0.0, 8.84]]
        return wave_kernels(system, points, 550.0, centre, PixelWindow(0.004, 45), settings).sum()

    x = stored.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(light(x), x)
    h = 1e-5
    expected = float(light(stored + h) - light(stored - h)) / (2.0 * h)
    assert abs(expected) > 1.0
    assert float(gradient) == pytest.approx(expected, rel=0.02)


def test_large_aberrations_blur_as_rays_do(coding):
    """At low frequencies: the pixel-integrated spectra of the wave and of the ray PSF."""
    lens = coding(3e-5)
    sensor = Sensor(64, 64, 0.0069)
    geometric = axial_point_spread_functions(
        lens, PlanarScene((8000.0,), (550.0,)), sensor, 97, 200
    )[0, 0]
    wave = wave_kernels(lens.system(), on_axis([8000.0]), 550.0, CENTRE, PixelWindow(0.0069, 97))[0]
    assert float(wave.sum()) == pytest.approx(1.0, abs=6e-3)
    spectra = [torch.fft.fft2(k / k.sum())[:5, :5] for k in (geometric, wave)]
    # 4/97 of the sampling frequency is 6 cycles/mm, a fiftieth of the cut-off.
    assert float((spectra[0] - spectra[1]).abs().max()) < 0.02
    assert float(spectra[0].abs().min()) < 0.7
    # The fringes are diffraction's alone.
    assert float((geometric - wave).abs().max()) > 0.2 * float(geometric.max())


def test_direct_integration_gives_the_same_kernels(coding):
    arguments = (on_axis([5200.0]), 550.0, CENTRE, PixelWindow(0.0069, 5))
    lens = coding(2e-6)
    kernels = [
        wave_kernels(
            lens.system(), *arguments, DiffractionSettings(method=method, samples=96, subsamples=3)
        )
        for method in ("fourier", "direct")
    ]
    assert float((kernels[0] - kernels[1]).abs().max()) < 2e-3 * float(kernels[0].max())


def test_the_choice_is_explained(coding, triplet):
    chosen = propagation(
        coding().system(), on_axis(DEPTHS), LINES, [[0.0, 0.0]] * 3, PixelWindow(0.0069, 65)
    )
    assert chosen.fourier.tolist() == [True] * 3
    assert all(reason.startswith("fourier: fit") for reason in chosen.reasons)
    assert float(chosen.fit_residual.max()) < 1e-6
    # (α·ρ)²/2R at the window's edge where light goes: α = 0.06, some 0.15 mm, R = 100 mm.
    assert 1e-4 < float(chosen.sphere_term.max()) < 0.01

    coarse = DiffractionSettings(degree=2)
    chosen = propagation(
        coding().system(), on_axis([8000.0]), 550.0, CENTRE, PixelWindow(0.0069, 65), coarse
    )
    assert not bool(chosen.fourier)
    assert "path difference is fitted to" in chosen.reasons[0]

    strict = DiffractionSettings(phase_error=1e-6, degree=16)
    chosen = propagation(
        coding().system(), on_axis([8000.0]), 550.0, None, PixelWindow(0.0069, 65), strict
    )
    assert "distances to the window bend" in chosen.reasons[0]

    # A hole's oblique light: αρ/R = 0.57·1.65/61 at the window's edge.
    aside = ObjectPoints.at_infinity([[0.0, 35.0]])
    chosen = propagation(pinhole(2.0).system(), aside, 500.0, None, PixelWindow(0.1, 31))
    assert float(chosen.distortion) == pytest.approx(0.0154, rel=0.1)
    assert chosen.reasons[0].startswith("direct: the window's edge is displaced by")

    rays = pupil_wavefront(hyperbola().system(), AXIS, 500.0, CENTRE, 24)
    pupil = regular_pupil(fit_pupil(rays), 96)
    assert bool(choose_propagation(fit_pupil(rays), pupil.flux, 0.05).fourier)
    wrong = replace(pupil, flux=1.05 * pupil.flux)
    chosen = choose_propagation(fit_pupil(rays), wrong.flux, 0.05)
    assert chosen.reasons[0].startswith("direct: the flux through the fitted pupil errs by 0.05")

    dark = ObjectPoints.at_infinity([[0.0, 60.0]])
    chosen = propagation(triplet.system(), dark, 550.0, [[0.0, 40.0]], PixelWindow(0.004, 9))
    assert chosen.reasons == ("fourier: no light passes",)


def test_an_edge_that_no_aperture_makes_is_integrated_directly():
    """An ellipsoid whose aperture is wider than itself, R/√(1 - 1/n²) = 1.34·R."""
    lens = ellipse(1.0, 1.2)
    lens.surfaces["1"].aperture = ClearAperture(Circle(1.5))
    chosen = propagation(lens.system(), AXIS, 500.0, CENTRE, PixelWindow(2e-4, 5))
    assert "direct: rays at the pupil's edge miss a surface" in chosen.reasons[0]
    assert float(chosen.fit_residual) < 1e-9
    kernel = wave_kernels(lens.system(), AXIS, 500.0, CENTRE, PixelWindow(2e-4, 5))[0]
    # Some light is lost at the rim, and most is in a disc of 0.61·λ/0.745/n.
    assert float(kernel.argmax()) == 12
    assert 0.5 < float(kernel.sum()) < (1.342 / 1.5) ** 2


def test_only_what_needs_it_is_integrated_directly(coding, monkeypatch, caplog):
    """Of two points one bends beyond the limit; the other's kernel is the transform's."""
    integrated = []
    by_integration = wave_psf._by_integration

    def counting(wavefront, window):
        integrated.append(len(wavefront.wavelength))
        return by_integration(wavefront, window)

    monkeypatch.setattr(wave_psf, "_by_integration", counting)
    lens = coding(0.0)
    points, centres, size = on_axis([5200.0, 4000.0]), [[0.0, 0.0]] * 2, 17
    terms = propagation(
        lens.system(), points, 550.0, centres, PixelWindow(0.0069, size)
    ).sphere_term.tolist()
    assert terms[0] < 0.9 * terms[1]
    limit, counts = 0.5 * (terms[0] + terms[1]), {"samples": 72, "subsamples": 2}
    settings = DiffractionSettings(phase_error=limit, **counts)
    with caplog.at_level("INFO"):
        kernels = wave_kernels(
            lens.system(), points, 550.0, centres, PixelWindow(0.0069, size), settings
        )
    assert integrated == [1]
    assert "direct: distances to the window" in caplog.text
    whole = DiffractionSettings(method="fourier", **counts)
    same = wave_kernels(lens.system(), points, 550.0, centres, PixelWindow(0.0069, size), whole)
    assert torch.equal(kernels[0], same[0])
    assert not torch.equal(kernels[1], same[1])
    assert float((kernels[1] - same[1]).abs().max()) < 5e-3 * float(same[1].max())


def test_pieces_make_the_whole(coding, monkeypatch):
    lens = coding().requires_grad_(True)
    arguments = (on_axis(DEPTHS), LINES, [[0.0, 0.0]] * 3, PixelWindow(0.0069, 17))
    weight = torch.linspace(-1.0, 1.0, 17).double()

    def kernels() -> tuple[torch.Tensor, torch.Tensor]:
        found = wave_kernels(lens.system(), *arguments)
        (gradient,) = torch.autograd.grad((found @ weight).sum(), lens.surfaces["5"].x3)
        return found.detach(), gradient

    whole, gradient = kernels()
    monkeypatch.setattr(wave_psf, "_PIECE", 1)
    parts, same = kernels()
    assert torch.allclose(whole, parts, rtol=1e-12, atol=1e-15)
    assert float(gradient) == pytest.approx(float(same), rel=1e-10)


def test_a_dark_point_s_kernel_is_zero(triplet):
    triplet.requires_grad_(True)
    points = ObjectPoints.at_infinity([[0.0, 60.0], [0.0, 5.0]])
    found = wave_kernels(
        triplet.system(), points, 550.0, [[0.0, 40.0], [0.0, 4.38]], PixelWindow(0.004, 9)
    )
    sums = found.detach().sum((1, 2))
    assert float(sums[0]) == 0.0 and float(sums[1]) > 0.1
    found.square().sum().backward()
    for name, parameter in triplet.named_parameters():
        assert parameter.grad is None or bool(torch.isfinite(parameter.grad)), name


def test_an_obscuration_takes_its_light():
    whole = hyperbola(100.0, 2.5)
    ring = hyperbola(100.0, ClearAperture(Circle(2.5), Circle(1.0)))
    sums = [
        float(wave_kernels(lens.system(), AXIS, 500.0, CENTRE, PixelWindow(0.02, 65)).sum())
        for lens in (whole, ring)
    ]
    # Rays are launched over the ring, and the flux is the circle's less the middle's.
    assert sums[1] / sums[0] == pytest.approx(1.0 - 0.16, abs=5e-3)


def test_what_does_not_fit_is_refused(coding):
    system = coding().system()
    with pytest.raises(InputError, match="pitch"):
        wave_kernels(system, on_axis([8000.0]), 550.0, CENTRE, PixelWindow(0.0, 9))
    with pytest.raises(InputError, match="method"):
        DiffractionSettings(method="exact")
    with pytest.raises(InputError, match="phase_error"):
        DiffractionSettings(phase_error=0.0)
    with pytest.raises(InputError, match="samples"):
        DiffractionSettings(samples=1)
    with pytest.raises(InputError, match="too steep"):
        wave_kernels(system, on_axis([60.0]), 550.0, CENTRE, PixelWindow(0.0069, 9))


def test_the_b_spline():
    u = torch.linspace(-2.0, 2.0, 81).double()
    box = np.where(np.abs(np.linspace(-1.5, 1.5, 3001)) <= 0.5, 1.0, 0.0)
    thrice = np.convolve(np.convolve(box, box, "same"), box, "same") * 1e-6
    expected = np.interp(u.numpy(), np.linspace(-1.5, 1.5, 3001), thrice, 0.0, 0.0)
    np.testing.assert_allclose(quadratic_b_spline(u), expected, atol=2e-3)
