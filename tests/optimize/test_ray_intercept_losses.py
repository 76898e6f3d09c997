"""Losses of ray intercepts, against closed forms; optimizers by number; edges that follow light."""

import math

import pytest
import torch
from scipy.special import j1

from dolens import load_lens
from dolens.analysis.pupil_quadrature import gaussian_quadrature
from dolens.errors import InputError
from dolens.optimize import DampedLeastSquares, DesignVariables, MeritSettings
from dolens.optimize.automatic_semi_diameters import fitted_semi_diameters
from dolens.optimize.ray_intercept_quality import EncircledEnergy, Modulation, RayGroups
from dolens.optimize.variables import by_number_of_variables


def disc(radius_mm, rings=60, arms=64):
    """Points (2, N) spread evenly over a disc."""
    radius = ((torch.arange(rings).double() + 0.5) / rings).sqrt() * radius_mm
    angle = (torch.arange(arms).double() + 0.5) * (2.0 * math.pi / arms)
    x, y = radius[:, None] * angle.cos(), radius[:, None] * angle.sin()
    points = torch.stack((x.flatten(), y.flatten()))
    count = points.shape[1]
    weight = torch.full((count,), 1.0 / count, dtype=torch.float64)
    return points, RayGroups(weight, torch.zeros(count, dtype=torch.int64), torch.ones(1).double())


def test_the_modulation_of_a_disc():
    """2·J₁(x)/x with x = 2πνr (Goodman, Introduction to Fourier Optics)."""
    points, spots = disc(0.005)
    loss = Modulation(frequencies=[20.0, 50.0, 100.0])
    x = 2.0 * math.pi * torch.tensor([20.0, 50.0, 100.0]).double() * 0.005
    expected = torch.from_numpy(2.0 * j1(x.numpy()) / x.numpy()).abs()
    found = loss.transfer(points, spots)
    assert torch.allclose(found[:, 0, 0], expected, atol=2e-4)
    assert torch.allclose(found[:, 1, 0], expected, atol=2e-4)
    assert loss(points, spots).item() == pytest.approx(float((1 - expected).square().mean()), abs=1e-3)  # fmt: skip # noqa: E501


def test_the_encircled_energy_of_a_disc():
    """A circle of radius r holds (r/R)² of a disc of radius R."""
    points, spots = disc(0.010)
    loss = EncircledEnergy(radius_um=5.0, softness_um=0.02)
    assert loss(points, spots).item() == pytest.approx((1.0 - 0.25) ** 2, rel=0.02)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Modulation(frequencies=[]), "frequencies"),
        (lambda: Modulation(frequencies=[50.0, -1.0]), "frequencies"),
        (lambda: Modulation(frequencies=[50.0], target=[1.0, 0.5]), "target"),
        (lambda: EncircledEnergy(radius_um=0.0), "radius_um"),
    ],
)
def test_losses_say_what_is_wrong(make, said):
    with pytest.raises(InputError, match=said):
        make()


@pytest.mark.parametrize("curvature", ["directions", "step"])
def test_a_loss_falls_at_every_step(root, curvature):
    """Whichever curvature the model has, damping sees to it."""
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml", dtype=torch.float64)
    variables = DesignVariables(lens, {"surfaces.*.curvature": {"scale": 0.01}})
    merit = MeritSettings(
        fields=[(0.0, 0.0), (0.0, 12.0)],
        wavelengths=[587.5618],
        quality="modulation",
        quality_options={"frequencies": [50.0], "curvature": curvature},
        sampling_options={"rings": 5, "arms": 10},
    ).build(lens, variables)
    optimizer = DampedLeastSquares([variables.scaled])
    merits = [merit().sum_of_squares()]
    for _ in range(8):
        merits.append(float(optimizer.step(merit)))
    assert merits == sorted(merits, reverse=True) and merits[-1] < 0.6 * merits[0]


@pytest.mark.parametrize(("count", "kind"), [(3, DampedLeastSquares), (4, torch.optim.SGD)])
def test_the_number_of_variables_chooses(count, kind):
    numbers = torch.zeros(count, requires_grad=True)
    for params in ([numbers], [{"params": [numbers], "lower": None, "upper": None}]):
        chosen = by_number_of_variables(params, 3, DampedLeastSquares, torch.optim.SGD)
        assert type(chosen) is kind


def test_edges_follow_the_light(root):
    """Rays out to the rims pass fitted edges, and one step farther out they do not."""
    lens = load_lens(root / "conf/lens/double_gauss.yaml", dtype=torch.float64)
    fields = [(0.0, 0.0), (0.0, 10.0), (0.0, 22.0)]
    spots = gaussian_quadrature(lens, fields, [587.5618], 40, 80)
    own = {number: surface.semi_diameter for number, surface in lens.surfaces.items()}
    fitted = fitted_semi_diameters(lens, spots)
    assert fitted["6"] == pytest.approx(own["6"], rel=0.01)  # rims clip a little of the axial beam
    assert all(fitted[number] <= own[number] for number in own)
    # Surfaces that clip the tilted beams are met at their rims.
    assert max(fitted[n] / own[n] for n in own if n != "6") == pytest.approx(1.0, abs=2e-3)
