"""Operands and image qualities of a user's own, as objects in the place of names."""

from dataclasses import dataclass

import pytest
import torch

from dolens import InputError, load_lens
from dolens.optimize import DampedLeastSquares, DesignVariables, MeritSettings
from dolens.optimize.operands import Operand
from dolens.optimize.ray_intercept_quality import SpotSize


@dataclass(frozen=True)
class TelephotoRatio(Operand):
    """Length of a lens, first vertex to sensor, over its focal length."""

    kind: str = "telephoto_ratio"

    def values(self, lens):
        return {self.kind: lens.system.vertices[-1] / lens.first_order.efl}


class MeanSquare:
    """The spots' size again, by a user's class."""

    def __call__(self, points, groups):
        squares = groups.weight * points.square().sum(0)
        sums = squares.new_zeros(len(groups.group_weights)).index_add(0, groups.group, squares)
        return 1e6 * (groups.group_weights * sums).sum()


@pytest.fixture
def triplet(root):
    return load_lens(root / "conf" / "lens" / "cooke_triplet.yaml").requires_grad_(False)


def merit_of(lens, **settings):
    variables = DesignVariables(lens, {"surfaces.[126].curvature": {"scale": 0.01}})
    common = {"fields": [(0, 0), (0, 14)], "wavelengths": [587.6], "reference": "centroid"}
    options = {"sampling_options": {"rings": 4, "arms": 8}, **common, **settings}
    return MeritSettings(**options).build(lens, variables), variables


def test_an_operand_of_one_s_own_counts_and_is_brought_within_its_limit(triplet):
    ratio = float(triplet.system().vertices[-1] / triplet.first_order().efl)
    merit, variables = merit_of(
        triplet, quality=None, operands=[TelephotoRatio(max=ratio - 0.05, weight=10.0)]
    )
    (item,) = merit().operands
    assert item.label == "telephoto_ratio"
    assert (item.value, item.deviation) == pytest.approx((ratio, 0.05), rel=1e-9)
    assert merit().sum_of_squares() == pytest.approx(0.25, rel=1e-9)
    optimizer = DampedLeastSquares([variables.parameter_group()])
    for _ in range(20):
        optimizer.step(merit)
    assert merit().operands[0].value <= ratio - 0.05 + 1e-9


def test_an_operand_says_what_is_wrong_with_its_limits():
    with pytest.raises(InputError, match="operand 'telephoto_ratio': give a target, or limits"):
        TelephotoRatio(weight=2.0)
    with pytest.raises(InputError, match="operand 'telephoto_ratio': min exceeds max"):
        TelephotoRatio(min=2.0, max=1.0)


def test_a_loss_of_one_s_own_is_minimised_as_one_with_a_name(triplet):
    """Value, gradient and least-squares step are those of the built-in loss of the same formula."""
    named, own = (merit_of(triplet, quality=q)[0] for q in ("spot_size", MeanSquare()))
    assert isinstance(named.quality.intercept_loss, SpotSize)
    assert own().sum_of_squares() == pytest.approx(named().sum_of_squares(), rel=1e-12)
    gradients = [merit().linear_model().gradient for merit in (own, named)]
    assert torch.allclose(*gradients, rtol=1e-9)
    with pytest.raises(InputError, match=r"merit\.quality_options: unknown key 'frequencies'"):
        merit_of(triplet, quality=MeanSquare(), quality_options={"frequencies": [50.0]})
