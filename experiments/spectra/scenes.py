"""Photographs become scenes of spectra: each pixel keeps its colour, and gets a spectrum that has
it under daylight.

A scene has a few materials.  A material is a small set of spectra, most of them measured and some
synthetic bells; the spectrum of a colour is the mixture of theirs, with weights of at least zero,
that has this colour and the least sum of squared weights (synthetic ones count more).  Where in a
scene which material is follows from smoothed colour and place, so that pixels of one colour have
different spectra at different places.
"""

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor
from torch.nn.functional import avg_pool2d

from dolens.experiments.data.camera_data import Split
from dolens.experiments.spectra.reflectances import BANDS, Reflectances
from dolens.sensor.noise import generator_of

# Steps along each side of the triangle of colours r + g + b = 1, in which mixtures are found.
_STEPS = 12
_MATERIALS, _MEASURED, _BELLS = 4, 5, 4
# Weight of squared weights beside squared errors of colours, and how much more bells count.
_RIDGE, _BELL_COST = 1e-5, 4.0


def spectral_scene(rgb: Tensor, spectra: Reflectances, split: Split, seed: int) -> Tensor:
    """Return reflectances, (L, H, W), whose colours under daylight are those of a photograph.

    Args:
        rgb: linear light, (3, H, W).
        spectra: that are mixed.
        split: which of the measured ones.
        seed: of the choice of spectra, and of places.
    """
    generator = generator_of(seed)
    share = _places(rgb, generator)
    return sum(
        share[n] * _of_material(rgb, _material(spectra, split, generator), spectra.colour)
        for n in range(_MATERIALS)
    )


def _material(spectra: Reflectances, split: Split, generator: torch.Generator) -> Tensor:
    """Return the spectra of a material, (M, L), the measured ones first."""
    measured = spectra.measured[split]
    chosen = torch.randperm(len(measured), generator=generator)[:_MEASURED]
    centre = 400.0 + 300.0 * torch.rand(_BELLS, 1, generator=generator)
    # One bell for each end and two for the middle, so that all colours can be mixed.
    centre[:4, 0] = torch.tensor([440.0, 520.0, 560.0, 640.0]) + 0.1 * (centre[:4, 0] - 550.0)
    width = 12.0 + 20.0 * torch.rand(_BELLS, 1, generator=generator)
    bells = torch.exp(-0.5 * ((torch.tensor(BANDS) - centre) / width).square())
    return torch.cat([measured[chosen], bells])


def _places(rgb: Tensor, generator: torch.Generator) -> Tensor:
    """Return the share of each material, (M, H, W), of sum one."""
    height, width = rgb.shape[-2:]
    smooth = avg_pool2d(rgb[None], 9, 1, 4, count_include_pad=False)[0]
    colour = smooth / smooth.sum(0, keepdim=True).clamp(min=1e-3)
    down, across = torch.meshgrid(
        torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij"
    )
    features = torch.cat([colour[:2], smooth.mean(0, keepdim=True), torch.stack([down, across])])
    features = features - features.mean((-2, -1), keepdim=True)
    features = features / features.std((-2, -1), keepdim=True).clamp(min=1e-3)
    slopes = torch.randn(_MATERIALS, len(features), generator=generator)
    return torch.softmax(3.0 * torch.einsum("mf,fhw->mhw", slopes, features), 0)


def _of_material(rgb: Tensor, material: Tensor, colour: Tensor) -> Tensor:
    """Return the mixture (L, H, W) of every pixel, interpolated among those of a few colours."""
    table = _mixtures(material, colour)
    total = rgb.sum(0)
    share = rgb[:2] / total.clamp(min=1e-6) * _STEPS
    low = share.floor().clamp(0, _STEPS - 1)
    fraction = share - low
    upper = (fraction.sum(0) > 1.0).float()
    row, column = low.long()
    # The cell's triangle below its diagonal, or the one above it.
    first = torch.where(upper.bool(), 1.0 - fraction[1], fraction[0])
    second = torch.where(upper.bool(), 1.0 - fraction[0], fraction[1])
    step = upper.long()
    corner = table[row + step, column + step] * (1.0 - first - second)[..., None]
    corner = corner + table[row + 1, column] * first[..., None]
    corner = corner + table[row, column + 1] * second[..., None]
    return (corner * total[..., None]).movedim(-1, 0)


def _mixtures(material: Tensor, colour: Tensor) -> Tensor:
    """Return the spectra, (S + 2, S + 2, L), of the colours (i, j, S - i - j)/S."""
    table = torch.zeros(_STEPS + 2, _STEPS + 2, material.shape[1])
    colours = (colour @ material.mT).double().numpy()
    cost = np.full(len(material), 1.0)
    cost[_MEASURED:] = _BELL_COST
    system = np.vstack([colours, np.sqrt(_RIDGE) * np.diag(cost)])
    for i in range(_STEPS + 1):
        for j in range(_STEPS + 1 - i):
            wanted = np.zeros(len(system))
            wanted[:3] = np.array([i, j, _STEPS - i - j]) / _STEPS
            table[i, j] = torch.tensor(nnls(system, wanted)[0]).float() @ material
    return table
