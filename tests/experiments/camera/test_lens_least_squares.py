"""A camera's lens moved by least squares, in turns with the network."""

import math
from functools import partial

import pytest
import torch

from dolens import Lens
from dolens.analysis.pupil_quadrature import gaussian_quadrature
from dolens.errors import InputError
from dolens.experiments.camera.lens_optimizer import CameraOptimizer, LensLeastSquares
from dolens.optimize.variables import DesignVariables
from dolens.prescriptions import load_lens
from dolens.reconstruction.wiener import linear_error, natural_spectrum
from tests.experiments.tiny_experiment import (
    CAMERA,
    FIXED_WINDOWS,
    IN_TURNS,
    ONE_EPOCH,
    TINY_DOUBLET,
    UNPICTURED,
    UNTESTED,
)

DOUBLET = [*TINY_DOUBLET, *FIXED_WINDOWS, UNPICTURED]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"every": 0}, "least_squares.every: 0"),
        ({"trust_radius": -1.0}, "least_squares.trust_radius: -1.0"),
        ({"trust_radius": 2.0, "max_trust_radius": 1.0}, "least_squares.max_trust_radius: 1.0"),
        ({"first_iterations": -1}, "least_squares.first_iterations: -1"),
        ({"strength": 2.0}, "least_squares.strength: 2.0"),
    ],
)
def test_settings_out_of_range_are_errors(settings, message):
    with pytest.raises(InputError, match=message):
        LensLeastSquares(**settings)


def test_optimizers_out_of_range_are_errors():
    with pytest.raises(InputError, match=r"'newton' is unknown \(allowed: adam, dls"):
        CameraOptimizer(torch.optim.Adam, "newton")
    with pytest.raises(InputError, match=r"optimizer\.until: 1\.5; allowed: 0 to 1"):
        CameraOptimizer(torch.optim.Adam, until=1.5)
    with pytest.raises(InputError, match=r"optimizer.network.lr: .* learning_rates.network is"):
        CameraOptimizer(partial(torch.optim.Adam, lr=0.1))


def test_rays_move_farther_while_the_slope_is_kept_and_less_far_where_it_turns():
    """A loss that falls evenly, and then one that changes its mind at every step."""
    triplet = load_lens("cooke_triplet").requires_grad_(False)
    variables = DesignVariables(triplet, {"surfaces.1.curvature": {"scale": 0.01}})
    spots = [gaussian_quadrature(triplet, [(0, 0)], [550.0], 3, 6, symmetry=False)]
    steps = LensLeastSquares(every=1, trust_radius=1e-4, max_trust_radius=3e-4)
    reaches = []
    for slope in (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0):
        variables.scaled.grad = torch.tensor([slope], dtype=torch.float64)
        steps.gather(variables)
        reaches.append(steps.step(triplet, variables, spots, 0.01)["reach"])
    assert reaches[1:4] == pytest.approx([1.25e-4, 1.25**2 * 1e-4, 1.25**3 * 1e-4])
    assert reaches[5] == 3e-4
    assert reaches[6:] == pytest.approx([3e-4 * 0.7**k for k in (1, 2, 3, 4)])


def test_the_plate_moves_in_turns_and_within_its_bounds(trained):
    """Six steps of the network, three of the lens."""
    metrics = trained(*CAMERA, *IN_TURNS, "data.steps_per_epoch=6", ONE_EPOCH, *UNTESTED).metrics
    assert metrics["lens_steps/taken"] == 3.0
    assert metrics["variables/surfaces.5.x3"] != pytest.approx(1.5e-5, rel=1e-4)
    for name in ("x3", "x2y", "xy2", "y3"):
        assert abs(metrics[f"variables/surfaces.5.{name}"]) <= 4.0e-5 * (1.0 + 1e-6)


def test_a_doublet_holds_its_focal_length(trained):
    """The solve holds it through the steps of least squares too."""
    found = trained(*DOUBLET, *IN_TURNS)
    assert found.metrics["lens_steps/taken"] == 2.0
    efl = float(found.lens().first_order().efl.detach())
    assert efl == pytest.approx(67.57969, rel=1e-5)
    assert math.isfinite(found.metrics["test/psnr_db/field"])


FIRST = [
    "optimizer.lens=dls",
    "optimizer.least_squares.first_iterations=15",
    "optimizer.least_squares.strength=1.0",
    "optimizer.until=0.0",
]


def linear_errors(lens: Lens) -> float:
    """The mean error of the best linear filter over windows, from spots on pixels.

    Zones have weights by their shares of the circle; each colour has a filter of its own.
    """
    pitch, weights = 0.03, {0.0: 0.06, 10.2: 0.35, 14.1: 0.4, 19.7: 0.19}
    spectrum = natural_spectrum(64, 64, 0.04, 64.0, torch.zeros((), dtype=torch.float64))
    colours = (656.2725, 587.5618, 486.1327)
    fields = [(0.0, angle) for angle in weights]
    spots = gaussian_quadrature(lens, fields, colours, 12, 32, symmetry=False)
    positions = lens.trace(spots.rays).position[:, :2].double()
    total = 0.0
    for number in range(spots.count):
        landed, share = positions[spots.spot == number], spots.weight[spots.spot == number]
        landed = landed - (share[:, None] * landed).sum(0)
        at = (landed / pitch).round().long() + 31
        inside = ((at >= 0) & (at < 63)).all(1)
        function = torch.zeros(63, 63, dtype=torch.float64)
        function.index_put_((at[inside, 1], at[inside, 0]), share[inside], accumulate=True)
        error = linear_error(function[None, None], spectrum, 1e-5)
        weight = weights[float(spots.fields[number, 1])] / len(colours)
        total += weight * float(error.filter_per_depth)
    return total


def test_a_lens_that_is_designed_first_is_better_for_linear_filters(trained):
    """As spots on pixels tell; and then it stands still, since `until` is 0."""
    found = trained(*DOUBLET, *FIRST, *UNTESTED, ONE_EPOCH)
    metrics = found.metrics
    first, begun = (metrics[f"lens_first/deconvolved_error{e}"] for e in ("", "_before"))
    assert first < 0.9 * begun
    assert metrics["lens_steps/taken"] == 0.0
    after, before = (linear_errors(found.lens(n)) for n in ("final", "initial"))
    assert after < 0.95 * before


def test_a_lens_that_is_designed_first_alone_needs_no_network_to_train(trained):
    """Behind a network that is held nothing moves in the steps that follow."""
    held = [o for o in DOUBLET if not o.startswith("network")]
    short = [ONE_EPOCH, "test=false", "objective=lens_first/deconvolved_error"]
    short += ["optimizer.least_squares.first_iterations=5"]
    one, three = (
        trained(*held, *FIRST, *short, f"data.steps_per_epoch={steps}").metrics for steps in (1, 3)
    )
    assert one["lens_first/deconvolved_error"] < 0.9 * one["lens_first/deconvolved_error_before"]
    moved = {name: value for name, value in one.items() if name.startswith("variables/")}
    assert moved and moved == {name: three[name] for name in moved}


def test_a_lens_stands_still_after_its_share_of_the_steps(trained):
    """Adam moves it in the first two of four steps, as if they had been all."""
    same = [*DOUBLET, *UNTESTED, "scheduler.T_max=100"]
    ends = [
        trained(*same, setting).metrics["variables/surfaces.1.curvature"]
        for setting in ("optimizer.until=0.5", ONE_EPOCH)
    ]
    assert ends[0] == pytest.approx(ends[1], rel=1e-9)


def test_the_plate_that_a_network_learned_has_the_least_deconvolved_error(trained):
    """Coefficients that `experiment=wavefront_coding` learned by Adam with its network, seed 0."""
    first = [f"optimizer.least_squares.first_{s}" for s in ("iterations=20", "damping=0.3")]
    short = ["data.steps_per_epoch=1", ONE_EPOCH, *UNTESTED]
    alone = ["optimizer.lens=dls", "optimizer.until=0.0"]
    metrics = trained(*CAMERA, *alone, *first, *short).metrics
    assert metrics["variables/sensor_distance"] == pytest.approx(95.80, abs=0.02)
    learned = {"x3": 8.79e-6, "x2y": 5.43e-6, "xy2": 3.94e-6, "y3": 8.35e-6}
    for name, value in learned.items():
        assert metrics[f"variables/surfaces.5.{name}"] == pytest.approx(value, abs=2e-6)
