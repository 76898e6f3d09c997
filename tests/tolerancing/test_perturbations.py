"""Tolerances as they are written, and the errors drawn from them."""

import math

import pytest
import torch
from scipy import integrate, stats

from dolens import InputError
from dolens.tolerancing import scaled_tolerances, tolerances_from
from tests.refused import refused


def test_units_are_those_of_files(triplet):
    found = tolerances_from(
        triplet,
        {
            "elements.rear.tilt_y": 0.1,
            "thicknesses.2": {"half_range": 0.03},
            "surfaces.3.curvature": {"half_range": 0.002, "relative": True},
            "surfaces.4.curvature": 1e-5,
        },
    )
    # In the order of the lens, whatever that of the file.
    assert found.names == (
        "surfaces.3.curvature",
        "surfaces.4.curvature",
        "thicknesses.2",
        "elements.rear.tilt_y",
    )
    expected = [0.002 / -22.213, 1e-5, 0.03, math.radians(0.1)]
    assert found.steps.tolist() == pytest.approx(expected, rel=1e-12)
    labels = [found.label(column) for column in range(4)]
    assert labels == ["± 0.2 %", "± 1e-05 1/mm", "± 0.03 mm", "± 0.1°"]
    assert scaled_tolerances(found, 0.5).steps.tolist() == pytest.approx(
        [0.5 * s for s in expected]
    )


@pytest.mark.parametrize("distribution", ["uniform", "normal"])
def test_moments_are_those_of_the_distribution(triplet, distribution):
    """Integrated numerically over the density; and drawn numbers follow it, within the range."""
    found = tolerances_from(
        triplet, {"thicknesses.1": {"half_range": 0.02, "distribution": distribution}}
    )
    law = {
        "uniform": stats.uniform(-0.02, 0.04),
        "normal": stats.truncnorm(-2.0, 2.0, scale=0.01),
    }[distribution]
    for power, moment in ((2, found.variance), (4, found.fourth_moment)):
        expected, _ = integrate.quad(
            lambda x, n=power: x**n * law.pdf(x), -0.02, 0.02, epsabs=1e-14
        )
        assert float(moment) == pytest.approx(expected, rel=1e-6)
    drawn = found.draw(20_000, torch.Generator().manual_seed(1))[:, 0]
    assert float(drawn.abs().max()) <= 0.02
    assert stats.kstest(drawn.numpy(), law.cdf).pvalue > 0.01


def test_the_same_seed_gives_the_same_lenses(triplet, settings):
    found = tolerances_from(triplet, settings)

    def draw(count, seed):
        return found.draw(count, torch.Generator().manual_seed(seed))

    assert torch.equal(draw(50, 3), draw(50, 3))
    assert not torch.equal(draw(50, 3), draw(50, 4))
    # More lenses are the same ones and others.
    assert torch.equal(draw(50, 3)[:20], draw(20, 3))


def test_errors_are_independent(triplet, settings):
    found = tolerances_from(triplet, settings)
    drawn = found.draw(20_000, torch.Generator().manual_seed(0)) / found.steps
    correlation = torch.corrcoef(drawn.T) - torch.eye(len(found.names))
    assert float(correlation.abs().max()) < 5.0 / math.sqrt(20_000)


BAD = {
    "unknown parameter": ({"elements.back.tilt_x": 0.1}, "no parameter 'elements.back.tilt_x'"),
    "unknown key": (
        {"thicknesses.1": {"half_rang": 0.1}},
        "thicknesses.1: unknown key 'half_rang'",
    ),
    "no half-range": ({"thicknesses.1": {"relative": True}}, "thicknesses.1: half_range must be"),
    "negative": ({"thicknesses.1": -0.1}, "thicknesses.1: half_range must be a positive number"),
    "text": ({"thicknesses.1": "wide"}, "half_range must be a positive number, not 'wide'"),
    "not a number": ({"thicknesses.1": math.nan}, "half_range must be a positive number"),
    "distribution": (
        {"thicknesses.1": {"half_range": 0.1, "distribution": "gauss"}},
        "thicknesses.1: distribution: 'gauss' is unknown (allowed: uniform, normal)",
    ),
    "relative": (
        {"thicknesses.1": {"half_range": 0.1, "relative": "yes"}},
        "relative must be true or false",
    ),
    "a share of zero": (
        {"elements.front.tilt_x": {"half_range": 0.1, "relative": True}},
        "'elements.front.tilt_x' is zero",
    ),
    "twice": ({"thicknesses.*": 0.1, "thicknesses.1": 0.2}, "'thicknesses.1' has a tolerance"),
    "none": ({"thicknesses.1": None}, "tolerances: none is given"),
    "no mapping": ([0.1], "tolerances: must map parameters"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_gives_one_line_that_names_the_key(triplet, case):
    given, expected = BAD[case]
    with refused(expected):
        tolerances_from(triplet, given)


def test_arrays_are_refused(root):
    from dolens import load_lens

    lens = load_lens(root / "conf/lens/cooke_triplet.yaml")
    lens.surfaces["2"].register_parameter("table", torch.nn.Parameter(torch.zeros(3)))
    with pytest.raises(InputError, match=r"'surfaces.2.table' is an array"):
        tolerances_from(lens, {"surfaces.2.table": 0.1})


@pytest.mark.parametrize("factor", [0.0, -1.0, math.inf, "2"])
def test_a_factor_must_be_positive(triplet, factor):
    with pytest.raises(InputError, match="tolerance_factor: must be a positive number"):
        tolerances_from(triplet, {"thicknesses.1": 0.1}, factor)


def test_indices_and_irregular_surfaces_have_tolerances(triplet):
    found = tolerances_from(
        triplet,
        {
            "media.*.index_offset": 5e-4,
            "surfaces.[12].astigmatism_*": 1.4e-4,
            "thicknesses.1": 0.02,
        },
        factor=2.0,
    )
    assert found.names == (
        "thicknesses.1",
        *("surfaces.1.astigmatism_0", "surfaces.1.astigmatism_45"),
        *("surfaces.2.astigmatism_0", "surfaces.2.astigmatism_45"),
        *(f"media.{n}.index_offset" for n in (1, 3, 5)),
    )
    assert found.nominal.tolist() == pytest.approx([3.259, *[0.0] * 7])
    assert found.steps.tolist() == pytest.approx([0.04, *[2.8e-4] * 4, *[1e-3] * 3])
    assert [found.label(column) for column in (1, 5)] == ["± 0.00028 mm", "± 0.001"]
    # The air between the elements is no glass.
    with pytest.raises(InputError, match=r"^tolerances\.media\.2\.index_offset: .*media\.1"):
        tolerances_from(triplet, {"media.2.index_offset": 5e-4})
    with pytest.raises(InputError, match="is zero, and so is any share of it"):
        tolerances_from(triplet, {"media.1.index_offset": {"half_range": 0.1, "relative": True}})
