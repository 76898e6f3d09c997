"""The estimator of spectra against Bayes' formula with whole matrices, by brute force."""

import math

import pytest
import torch

from dolens.reconstruction.quality import spectral_angle
from dolens.reconstruction.spectral_wiener import (
    SpectralCamera,
    SpectralPrior,
    SpectralWiener,
    spectral_prior,
)

SIDE, BANDS, MAPS = 6, 4, 3
COLOURS = {None: [[0, 0], [0, 0]], "RGGB": [[0, 1], [1, 2]], "GBRG": [[1, 2], [0, 1]]}


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(4)


@pytest.fixture
def prior(generator):
    spectra = torch.linalg.qr(torch.rand(BANDS, BANDS, generator=generator).double()).Q[:, :MAPS]
    return SpectralPrior(
        spectra,
        torch.tensor([0.5, 0.1, 0.02], dtype=torch.float64),
        torch.tensor([1.0, 0.3, 0.1], dtype=torch.float64),
        torch.tensor([2.0, 1.5, 3.0], dtype=torch.float64),
        torch.full((BANDS,), 0.3, dtype=torch.float64),
        torch.zeros((), dtype=torch.float64),
    )


def camera_of(pattern, generator):
    functions = torch.rand(BANDS, 3, 3, generator=generator).double()
    functions = functions / functions.sum((-2, -1), keepdim=True)  # no veil
    responses = torch.rand(1 if pattern is None else 3, BANDS, generator=generator).double()
    return SpectralCamera(functions, responses, pattern, (0.02, 0.01))


def measurement_matrix(camera):
    """(pixels, bands, pixels), each pixel of a periodic image by a loop over its neighbours."""
    colours = COLOURS[camera.pattern]
    found = torch.zeros(SIDE, SIDE, BANDS, SIDE, SIDE, dtype=torch.float64)
    for row in range(SIDE):
        for column in range(SIDE):
            response = camera.responses[colours[row % 2][column % 2]]
            for i in range(3):
                for j in range(3):
                    there = (row - i + 1) % SIDE, (column - j + 1) % SIDE
                    found[row, column, :, there[0], there[1]] += (
                        response * camera.functions[:, i, j]
                    )
    return found.reshape(SIDE**2, BANDS, SIDE**2)


def scene_covariance(prior):
    """(bands, pixels, bands, pixels), by the cosines of the power spectra."""
    power = prior.power(SIDE, SIDE)
    at = torch.cartesian_prod(torch.arange(SIDE), torch.arange(SIDE)).double()
    apart = at[:, None] - at
    turns = torch.einsum("pqi,fi->pqf", apart, at) / SIDE
    covariance = torch.einsum("pqf,kf->kpq", torch.cos(2 * math.pi * turns), power.flatten(1))
    covariance = covariance / SIDE**2
    return torch.einsum("lk,mk,kpq->lpmq", prior.spectra, prior.spectra, covariance)


@pytest.mark.parametrize("pattern", COLOURS)
def test_estimate_and_error_are_those_of_bayes_with_whole_matrices(pattern, prior, generator):
    camera = camera_of(pattern, generator)
    wiener = SpectralWiener(camera, prior, (SIDE, SIDE), margin=0)
    matrix = measurement_matrix(camera).reshape(SIDE**2, -1)
    covariance = scene_covariance(prior).reshape(BANDS * SIDE**2, -1)
    light = torch.tensor(COLOURS[pattern])[torch.arange(SIDE)[:, None] % 2, torch.arange(SIDE) % 2]
    noise = torch.diag((0.02 * camera.responses @ prior.mean + 0.01)[light.flatten()])
    gain = covariance @ matrix.T @ torch.linalg.inv(matrix @ covariance @ matrix.T + noise)
    raw = torch.rand(1, 1, SIDE, SIDE, generator=generator).double()
    wanted = (gain @ raw.flatten()).reshape(1, BANDS, SIDE, SIDE)
    torch.testing.assert_close(wiener(raw), wanted, rtol=1e-9, atol=1e-9)
    left = (covariance - gain @ matrix @ covariance).trace() / (BANDS * SIDE**2)
    assert float(wiener.expected_error) == pytest.approx(float(left), rel=1e-9)


def test_an_image_is_what_the_pixels_collect(generator):
    camera = camera_of("RGGB", generator)
    scene = torch.rand(1, BANDS, SIDE, SIDE, generator=generator)
    image = camera.image(scene)[0]
    whole = measurement_matrix(camera).reshape(SIDE**2, -1).float() @ scene.flatten()
    whole = whole.reshape(SIDE, SIDE)[1:-1, 1:-1]
    # The pixel (1, 1) of the scene is the first of the image.
    for row in range(SIDE - 2):
        for column in range(SIDE - 2):
            colour = COLOURS["RGGB"][(row + 1) % 2][(column + 1) % 2]
            assert float(image[colour, row, column]) == pytest.approx(
                float(whole[row, column]), abs=1e-5
            )


def test_light_beyond_the_window_is_an_even_veil(generator):
    camera = camera_of(None, generator)
    half = SpectralCamera(0.5 * camera.functions, camera.responses, None, camera.noise)
    scene = torch.rand(1, BANDS, SIDE, SIDE, generator=generator)
    veil = 0.5 * torch.einsum("cl,nl->c", camera.responses.float(), scene.mean((-2, -1)))
    wanted = 0.5 * camera.image(scene) + veil
    torch.testing.assert_close(half.image(scene), wanted, rtol=1e-4, atol=1e-5)


def test_a_prior_finds_variances_and_exponents_of_fields_that_have_them(generator):
    side, exponent = 64, torch.tensor([3.0, 2.0])
    frequency = torch.hypot(*torch.meshgrid(*2 * [torch.fft.fftfreq(side)], indexing="ij"))
    frequency[0, 0] = math.inf
    fields = torch.randn(24, 2, side, side, generator=generator)
    fields = torch.fft.fft2(fields) * frequency ** (-0.5 * exponent[:, None, None])
    fields = torch.fft.ifft2(fields).real
    fields = fields / fields.std((0, 2, 3), keepdim=True) * torch.tensor([2.0, 1.0])[:, None, None]
    basis = torch.linalg.qr(torch.rand(5, 5, generator=generator)).Q[:, :2]
    found = spectral_prior(torch.einsum("lk,nkhw->nlhw", basis, fields), 2)
    assert (found.spectra.T.float() @ basis).abs().diag().tolist() == pytest.approx(
        [1, 1], abs=0.01
    )
    assert found.variance.tolist() == pytest.approx([4.0, 1.0], rel=0.02)
    assert found.exponent.tolist() == pytest.approx(exponent.tolist(), abs=0.25)
    assert float(found.outside) == pytest.approx(0.0, abs=1e-6)


def test_angles_of_spectra_know_nothing_of_brightness_and_leave_dark_pixels_out():
    truth = torch.zeros(1, 2, 1, 3)
    truth[0, 0] = torch.tensor([[1.0, 0.5, 0.001]])
    found = torch.tensor([[3.0, 1.0, 0.0], [0.0, 3.0**0.5, 1.0]])[None, :, None]
    assert float(spectral_angle(found, truth)) == pytest.approx(30.0, abs=0.05)  # of 0° and 60°
