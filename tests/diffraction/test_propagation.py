"""The field on the sensor, by both ways of propagation."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.fft import next_fast_len
from scipy.integrate import quad, simpson
from scipy.special import j0, j1, jn_zeros

from dolens import Lens
from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.field_pupil import fast_length
from dolens.diffraction.propagation import direct_field, fourier_field
from dolens.diffraction.pupil_fit import fit_pupil, regular_pupil
from dolens.diffraction.reference_sphere import path_beyond
from dolens.diffraction.wavefront import pupil_wavefront
from dolens.errors import InputError
from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture, Rectangle
from dolens.optics.surfaces.even_asphere import EvenAsphere
from dolens.optics.surfaces.plane import Plane
from tests.diffraction.perfect_lenses import (
    AIR,
    GLASS,
    N,
    ellipse,
    hyperbola,
    hyperbola_height,
    pinhole,
)

AXIS = ObjectPoints.at_infinity([[0.0, 0.0]])
CENTRE = [[0.0, 0.0]]
WAVELENGTH = 500.0
LAMBDA = 500e-6
ZERO = torch.zeros(1).double()


def fourier(lens, x, y=ZERO, samples=128, degree=10, points=AXIS, radius=None):
    """Irradiance (Y, X) by the Fourier transform."""
    rays = pupil_wavefront(lens.system(), points, WAVELENGTH, CENTRE, 32, radius)
    field = fourier_field(regular_pupil(fit_pupil(rays, degree), samples), x, y)
    return field.abs().square()[0].detach()


def direct(lens, x, y=ZERO, samples=96, points=AXIS, radius=None):
    """Irradiance (Y, X) by adding up rays."""
    rays = pupil_wavefront(lens.system(), points, WAVELENGTH, CENTRE, samples, radius)
    rows, columns = torch.meshgrid(y, x, indexing="ij")
    field = direct_field(rays, columns.flatten(), rows.flatten()).reshape(rows.shape)
    return field.abs().square().detach()


def bessel_ratio(v):
    """2·J₁(v)/v."""
    v = np.maximum(np.abs(v), 1e-9)
    return 2.0 * j1(v) / v


@pytest.mark.parametrize("way", [fourier, direct])
@pytest.mark.parametrize(
    "lens, length", [(hyperbola(100.0, 1.0), 100.0), (ellipse(50.0, 1.0), 150.0 / N)]
)
def test_airy_s_pattern(way, lens, length):
    """[2J₁(v)/v]², v = k·r·a/f, with π·a²/(λ·f)² of the light through the pupil at its peak.

    In glass the wavelength is λ/n, and so in `length` the distance is.
    """
    zero = 0.61 * LAMBDA * length
    x = torch.linspace(0.0, 3.0 * zero, 40).double()
    expected = bessel_ratio(2.0 * math.pi / LAMBDA / length * x.numpy()) ** 2
    peak = math.pi / (LAMBDA * length) ** 2
    found = way(lens, x)[0] / peak
    np.testing.assert_allclose(found, expected, atol=4e-4)
    # First zero at 1.22·λ·N.
    about = 1.2196698912665045 * LAMBDA * length / 2.0 * torch.linspace(0.97, 1.03, 61).double()
    dark = about[int(way(lens, about)[0].argmin())]
    assert float(dark / about[30]) == pytest.approx(1.0, abs=2e-3)


def test_encircled_energy_of_airy_s_disc():
    """1 - J₀² - J₁² (Born and Wolf, 8.5.2), up to the seventh dark ring."""
    lens = hyperbola(100.0, 2.5)
    scale = 2.0 * math.pi / LAMBDA * 2.5 / 100.0
    radii = np.linspace(0.0, jn_zeros(1, 7)[-1] / scale, 1401)
    light = fourier(lens, torch.from_numpy(radii), samples=160)[0].numpy()
    for ring in (0, 3, 6):
        upto = np.searchsorted(radii, jn_zeros(1, 7)[ring] / scale) + 1
        v = scale * radii[upto - 1]
        found = simpson(2.0 * math.pi * radii[:upto] * light[:upto], x=radii[:upto])
        assert found == pytest.approx(1.0 - j0(v) ** 2 - j1(v) ** 2, abs=5e-4)


@pytest.mark.parametrize("focal_length, aperture", [(50.0, 12.5), (50.0, 20.0)])
def test_a_fast_lens_has_its_own_apodised_pattern(focal_length, aperture):
    """Hankel's transform of A(s), A² = h·dh/(s·ds): at F/2 and F/1.25 no Airy pattern."""
    edge = sine_at(aperture, focal_length)

    def amplitude(s: float) -> float:
        d = 1e-6
        after, before = (hyperbola_height(s + t, focal_length) for t in (d, -d))
        return math.sqrt((after**2 - before**2) / (4.0 * d * s) / math.pi) / aperture

    x = torch.linspace(0.0, 4.0, 12).double() * 0.5 * LAMBDA / edge
    expected = [
        (2.0 * math.pi / LAMBDA)
        * quad(lambda s, r=r: amplitude(s) * j0(2 * math.pi / LAMBDA * r * s) * s, 1e-5, edge)[0]
        for r in x.tolist()
    ]
    expected = np.square(expected)
    lens = hyperbola(focal_length, aperture)
    airy = bessel_ratio(2.0 * math.pi / LAMBDA * edge * x.numpy()) ** 2
    assert np.abs(expected / expected[0] - airy).max() > 5e-3
    for found in (fourier(lens, x, degree=12, samples=192), direct(lens, x, samples=160)):
        np.testing.assert_allclose(found[0] / expected[0], expected / expected[0], atol=2e-4)


def sine_at(height: float, focal_length: float) -> float:
    low, high = 0.0, 0.99 / N
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (
            (middle, high) if hyperbola_height(middle, focal_length) < height else (low, middle)
        )
    return low


@pytest.mark.parametrize("way", [fourier, direct])
@pytest.mark.parametrize("waves", [0.5, 1.0, 2.3])
def test_a_defocused_pupil(way, waves):
    """On the axis sinc²(W₀₂₀/λ); off it the integral over the radius (Born and Wolf, 8.8)."""
    f, a = 100.0, 2.5
    # W₀₂₀ = δ·a²/(2·f·(f + δ)) of rays that head for f and meet a sensor at f + δ.
    spread = 2.0 * waves * LAMBDA * f / a**2
    shift = spread * f / (1.0 - spread)
    lens = hyperbola(f, a, defocus=shift)
    x = torch.linspace(0.0, 4.0, 9).double() * 0.61 * LAMBDA * f / a
    scale = 2.0 * math.pi / LAMBDA * a / (f + shift)
    expected = []
    for r in x.tolist():
        parts = [
            quad(
                lambda p, t=t, r=r: 2 * p * t(2 * math.pi * waves * p * p) * j0(scale * r * p), 0, 1
            )[0]
            for t in (math.cos, math.sin)
        ]
        expected.append(parts[0] ** 2 + parts[1] ** 2)
    assert expected[0] == pytest.approx(np.sinc(waves) ** 2, abs=1e-12)
    peak = math.pi * a**2 / (LAMBDA * (f + shift)) ** 2
    np.testing.assert_allclose(way(lens, x)[0] / peak, expected, atol=6e-4)


@pytest.mark.parametrize("way", [fourier, direct])
def test_a_ring_and_a_rectangle(way):
    f, zero = 250.0, 0.61 * LAMBDA * 250.0 / 2.5
    x, y = torch.linspace(0.0, 3.0 * zero, 9).double(), torch.linspace(0.0, 2.0 * zero, 4).double()
    v = 2.0 * math.pi / LAMBDA / f * torch.hypot(x, y[:, None]).numpy()
    ring = hyperbola(f, ClearAperture(Circle(2.5), Circle(1.0)))
    expected = (2.5**2 * bessel_ratio(2.5 * v) - bessel_ratio(v)) ** 2 / 2.5**2
    found = way(ring, x, y) * (LAMBDA * f) ** 2 / math.pi
    np.testing.assert_allclose(found, expected, atol=2e-3 * expected.max())

    box = hyperbola(f, ClearAperture(Rectangle(2.0, 1.0)))
    along = np.sinc(2.0 * 2.0 / (LAMBDA * f) * x.numpy()) ** 2
    up = np.sinc(2.0 * 1.0 / (LAMBDA * f) * y.numpy()) ** 2
    # Relative to the light through the circle about its corners, of area 5π.
    found = way(box, x, y) * (LAMBDA * f) ** 2 / (8.0**2 / (5.0 * math.pi))
    np.testing.assert_allclose(found, up[:, None] * along, atol=2e-3)


def test_marechal_s_strehl_ratio():
    """exp(-(k·σ)²) for a singlet's spherical aberration, σ = S_I/8·√(4/45) in closed form."""
    for aperture in (1.3, 1.6):
        lens = hyperbola(aperture=aperture)
        with torch.no_grad():
            lens.surfaces["2"].conic.fill_(0.0)
            aberration = float(lens.seidel(0.1, WAVELENGTH).total.spherical) / 8.0
            rays = pupil_wavefront(lens.system(), AXIS, WAVELENGTH, CENTRE, 160)
            pupil = regular_pupil(
                fit_pupil(pupil_wavefront(lens.system(), AXIS, WAVELENGTH, CENTRE)), 160
            )
            flat = replace(pupil, opd=torch.zeros_like(pupil.opd))
            peaks = [fourier_field(p, ZERO, ZERO).abs().square() for p in (pupil, flat)]
        strehl = float(peaks[0] / peaks[1])
        sigma = 2.0 * math.pi / LAMBDA * aberration * math.sqrt(4.0 / 45.0)
        loss = 1.0 - math.exp(-(sigma**2))
        assert 0.005 < loss < 0.1
        # The closed form leaves higher orders out, some per cent of σ.
        assert 1.0 - strehl == pytest.approx(loss, rel=0.05)
        traced = 2.0 * math.pi / LAMBDA * float(rays.rms)
        assert float(rays.strehl_ratio) == pytest.approx(math.exp(-(traced**2)), abs=0.01 * loss)
        assert strehl == pytest.approx(float(rays.strehl_ratio), abs=0.01 * loss)


def test_energy_is_kept():
    """Over one whole period of the discrete transform the flux is Σ|P|² (Parseval)."""
    rays = pupil_wavefront(hyperbola(50.0, 5.0, 0.1).system(), AXIS, WAVELENGTH, CENTRE)
    samples = 64
    pupil = regular_pupil(fit_pupil(rays), samples)
    step = (pupil.cosines[0, :, 1] - pupil.cosines[0, :, 0]).tolist()
    grid = torch.arange(samples).double() / samples - 0.5
    x, y = (grid * LAMBDA / s for s in step)
    light = fourier_field(pupil, x, y).abs().square().sum() * (x[1] - x[0]) * (y[1] - y[0])
    kept = pupil.amplitude.square().sum() * math.prod(step)
    assert float(light) == pytest.approx(float(kept), rel=1e-12)
    # Cells on the edge keep the square of their share.
    assert float(kept) == pytest.approx(float(pupil.flux), rel=0.02)
    assert float(pupil.flux) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("radius", [None, math.inf, 30.0])
def test_both_ways_agree_for_any_sphere(triplet, radius):
    """Off the axis, clipped by two apertures, and whatever the sphere's radius."""
    points, centre = ObjectPoints.at_infinity([[4.0, 14.0]]), [[3.485, 12.425]]
    x, y = torch.linspace(-0.02, 0.02, 11).double(), torch.linspace(-0.02, 0.04, 9).double()
    rows, columns = torch.meshgrid(y, x, indexing="ij")
    rays = pupil_wavefront(triplet.system(), points, 550.0, centre, 160, radius)
    added = direct_field(rays, columns.flatten(), rows.flatten()).abs().square()
    rays = pupil_wavefront(triplet.system(), points, 550.0, centre, 32, radius)
    assert len(rays.clipping) == 2
    pupil = regular_pupil(fit_pupil(rays, 12), 224)
    transformed = fourier_field(pupil, x, y).abs().square()[0]
    wrong = (transformed - added.reshape(transformed.shape)).abs().max() / added.max()
    assert float(wrong) < 2e-3


def test_the_triplet_s_psf_is_that_of_optiland(triplet, reference):
    """Sums over rays on the same sphere; see tests/reference/wavefront_optiland.py.

    Optiland weighs rays equally, and its pupils have staircases for edges: a per cent is what it
    changes by with its number of rays.
    """
    document = reference("wavefront_optiland.json")
    for row, tolerance in zip(document["cases"], (1e-3, 3e-3, 4e-3, 1.5e-2), strict=True):
        if row["object_distance"] is None:
            points = ObjectPoints.at_infinity([[0.0, row["field"]]])
        else:
            points = ObjectPoints.at([[0.0, row["field"], -row["object_distance"]]])
        expected = torch.tensor(row["psf"], dtype=torch.float64)
        count = len(expected)
        step = (torch.arange(count).double() - 0.5 * (count - 1)) * document["psf_step_mm"]
        x, y = (step + row["psf_centre"][i] - row["centre"][i] for i in (0, 1))
        rays = pupil_wavefront(
            triplet.system(),
            points,
            document["wavelength_nm"],
            [row["centre"][:2]],
            32,
            row["radius"],
        )
        field = fourier_field(regular_pupil(fit_pupil(rays, 12), 192), x, y)
        found = field.abs().square()[0]
        assert float((found / found.max() - expected).abs().max()) < tolerance


def bumpy(bumps: float) -> Lens:
    """A hyperbola behind a plate with bumps of r²⁰, for which no polynomial of low degree does."""
    plain = hyperbola(50.0, 2.5)
    plate = EvenAsphere(3.0, {"curvature": 0.0, "conic": 0.0, "a20": bumps / 2.5**20})
    surfaces = [plain.surfaces["1"], plate, Plane(5.0, {}), plain.surfaces["2"]]
    return Lens(surfaces, [1.0, 1.0, 4.0], 50.0, [AIR, GLASS, AIR, GLASS, AIR], stop=1)


def test_direct_integration_is_right_where_the_fit_is_not():
    """Against Hankel's transform of the traced radial profile, by scipy on a fine grid."""
    lens = bumpy(8.0 * LAMBDA).requires_grad_(False)
    profile = pupil_wavefront(lens.system(), AXIS, WAVELENGTH, CENTRE, 513)
    middle = 256
    row = slice(middle, None)
    sines = profile.direction[0, middle, row].norm(dim=-1).numpy()
    opd = profile.opd[0, middle, row].numpy()
    inside = np.hypot(*profile.crossings[1][0, middle, row].numpy().T) <= 2.5
    sines, opd = sines[inside], opd[inside]
    amplitude = profile.amplitude[0, middle, row].numpy()[inside]
    x = torch.linspace(0.0, 0.03, 7).double()
    expected = []
    for r in x.tolist():
        integrand = amplitude * sines * j0(2.0 * math.pi / LAMBDA * r * sines)
        whole = np.exp(2j * math.pi * opd / LAMBDA) * integrand
        expected.append(abs(2.0 * math.pi / LAMBDA * simpson(whole, x=sines)) ** 2)
    expected = np.array(expected)
    rays = pupil_wavefront(lens.system(), AXIS, WAVELENGTH, CENTRE, 256)
    found = direct_field(rays, x, torch.zeros_like(x)).abs().square()[0].numpy()
    few = pupil_wavefront(lens.system(), AXIS, WAVELENGTH, CENTRE, 32)
    assert float(fit_pupil(few, 10).residual) > 0.1
    np.testing.assert_allclose(found, expected, atol=0.01 * expected.max())
    fitted = fourier(lens, x, samples=256)[0].numpy()
    assert np.abs(fitted - expected).max() > 0.03 * expected.max()


def test_light_beyond_a_hole_is_fresnel_s():
    """On the axis behind a hole of Fresnel number F = a²/λd: 4·sin²(πF/2) of the free light.

    All of it is diffraction at the edge: no ray of the hole's comes from there.
    """
    a = 0.5
    for number in (9.0, 10.0):
        lens = pinhole(a, a * a / (number * LAMBDA))
        expected = 4.0 * math.sin(0.5 * math.pi * number) ** 2
        for found in (fourier(lens, ZERO, samples=400), direct(lens, ZERO, samples=256)):
            assert float(found) * math.pi * a * a == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize("radius", [50.0, 3.0, -20.0, math.inf])
def test_distances_are_those_of_points(radius):
    """|Q + ρ - (Q - R·α)|, with the sign of R, less R; of an infinite sphere α·ρ."""
    generator = torch.Generator().manual_seed(5)
    alpha = 0.8 * torch.rand(200, 2, generator=generator).double() - 0.4
    rho = torch.rand(200, 2, generator=generator).double() - 0.5
    along, squared = (alpha * rho).sum(-1), rho.square().sum(-1)
    beyond, ratio = path_beyond(along, squared, torch.tensor(1.0 / radius, dtype=torch.float64))
    if math.isinf(radius):
        assert torch.equal(beyond, along) and bool((ratio == 1.0).all())
        return
    height = (1.0 - alpha.square().sum(-1)).sqrt()
    step = torch.cat([rho + radius * alpha, radius * height[:, None]], -1)
    distance = math.copysign(1.0, radius) * step.norm(dim=-1)
    assert torch.allclose(beyond, distance - radius, rtol=0.0, atol=1e-13)
    assert torch.allclose(ratio, distance / radius, rtol=1e-14)


def test_points_must_be_pairs():
    rays = pupil_wavefront(hyperbola().system(), AXIS, WAVELENGTH, CENTRE)
    with pytest.raises(InputError, match="points"):
        direct_field(rays, torch.zeros(3), torch.zeros(2))
    with pytest.raises(InputError, match="degree"):
        fit_pupil(rays, 30)


def test_single_precision_sums_keep_the_phases():
    rays = pupil_wavefront(hyperbola(50.0, 5.0, 0.4).system(), AXIS, WAVELENGTH, CENTRE)
    x = torch.linspace(-0.05, 0.05, 30).double()
    pupil = regular_pupil(fit_pupil(rays), 128)
    pupil = replace(pupil, opd=pupil.opd + 1e4 * LAMBDA)
    double = fourier_field(pupil, x, x).abs().square().detach()
    single = fourier_field(pupil, x, x, torch.float32).abs().square().detach()
    assert single.dtype == torch.float32
    assert float((single - double).abs().max() / double.max()) < 1e-5


def test_lengths_of_transforms_are_scipys():
    assert [fast_length(n) for n in range(1, 4097)] == [next_fast_len(n) for n in range(1, 4097)]
