"""Scenes of spectra, and the derivative that the relief is learned by."""

from dataclasses import replace

import pytest
import torch

from dolens.experiments.running.run_settings import RunSettings
from dolens.experiments.running.training import build_module
from dolens.experiments.spectra import snapshot_spectra
from dolens.experiments.spectra.reflectances import BANDS, SETS, reflectances
from dolens.experiments.spectra.scenes import spectral_scene
from dolens.reconstruction.spectral_wiener import SpectralWiener, spectral_prior


@pytest.fixture(scope="module")
def spectra():
    return reflectances()


def test_no_measured_spectrum_stands_in_two_splits(spectra):
    names = [name for of_split in SETS.values() for name in of_split]
    assert len(names) == len(set(names))
    train, test = spectra.measured["train"], spectra.measured["test"]
    assert len(train) == 99 and len(test) == 54
    assert float(torch.cdist(train, test).min()) > 0.02


def test_daylight_and_colours_are_the_standards(spectra):
    """D65 at 450 nm has 1.17 times the power of 550 nm (CIE 15), and so 0.96 times the photons."""
    light = dict(zip(BANDS, spectra.light.tolist(), strict=True))
    assert light[450.0] / light[550.0] == pytest.approx(117.008 / 104.046 * 450 / 550, rel=1e-3)
    assert spectra.colour.sum(1).tolist() == pytest.approx([1.0, 1.0, 1.0])
    # The checker's red patch, number 15: sRGB 175, 54, 60 by its maker.
    red = spectra.colour @ spectra.measured["test"][14]
    assert red.tolist() == pytest.approx([0.43, 0.037, 0.045], abs=0.03)


def test_a_scene_keeps_its_colours_and_has_several_spectra_of_one_colour(spectra):
    rgb = 0.1 + 0.6 * torch.rand(3, 24, 32, generator=torch.Generator().manual_seed(1))
    rgb[:, :, 16:] = torch.tensor([0.5, 0.3, 0.2])[:, None, None]
    scene = spectral_scene(rgb, spectra, "test", 6)
    assert scene.shape == (31, 24, 32) and float(scene.min()) >= 0.0
    back = torch.einsum("cl,lhw->chw", spectra.colour, scene)
    torch.testing.assert_close(back, rgb, rtol=0.0, atol=0.02)
    assert torch.equal(scene, spectral_scene(rgb, spectra, "test", 6))
    same = scene[:, :, 20:].flatten(1)  # of one colour
    assert float((same.amax(1) - same.amin(1)).max()) > 0.02
    assert float((scene - spectral_scene(rgb, spectra, "test", 7)).abs().max()) > 0.02


def test_the_loss_follows_heights_as_differences_do(spectra, composed, monkeypatch):
    monkeypatch.setattr(snapshot_spectra, "BANDS", BANDS[::10])  # a tenth of the time
    cfg = composed("experiment=snapshot_spectra", "lens_dtype=float64")
    module = build_module(RunSettings.of(cfg))
    few = {"light": spectra.light[::10], "filters": spectra.filters[:, ::10]}
    module.__dict__["spectra"] = replace(spectra, **few)
    rgb = torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(0))
    prior = spectral_prior(spectral_scene(rgb[0], spectra, "train", 0)[None, ::10], 3)
    along = torch.randn(32, 32, generator=torch.Generator().manual_seed(1)).double()

    def error(step):
        heights = {module.learning.relief: module.relief + step * along}
        functions = module.functions(module.lens.with_values(heights))
        return SpectralWiener(module.camera("learned", functions), prior, (16, 16)).expected_error

    derivative = torch.autograd.grad(error(0.0), module.relief)[0]
    with torch.no_grad():
        difference = (error(1.0) - error(-1.0)) / 2.0
    assert float((derivative * along).sum()) == pytest.approx(float(difference), rel=1e-3)
