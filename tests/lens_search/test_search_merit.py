"""The merit of a search is that of real lenses, and its derivatives are its own."""

import math
from dataclasses import replace

import pytest
import torch

from dolens.analysis.conditions import conditions as conditions_of
from dolens.analysis.spot_diagram import spot_diagram
from dolens.errors import InputError
from dolens.lens_search.arrangement import AIR, STOP, Arrangement
from dolens.lens_search.designs import designed_lens
from dolens.lens_search.merit import SearchMerit
from dolens.lens_search.paraxial import numbers_of, paraxial
from dolens.lens_search.real_beams import real_beams
from dolens.lens_search.real_pupils import with_real_beams
from dolens.lens_search.search_rays import half_pupil
from dolens.lens_search.specification import Limits, Specification
from dolens.lens_search.starts import inserted, taken_out

QUARTET = Specification(
    focal_length=100.0,
    f_number=3.0,
    fields=(0.0, 10.5, 15.0),
    wavelengths=(486.1327, 587.5618, 656.2725),
    groups=(1, 1, 1, 1),
    glasses=("1.6204/60.31", "1.6200/36.37", "1.6200/36.37", "1.6204/60.31"),
    limits=Limits(glass=(2.0, 120.0), back_focus=30.0, track=250.0),
)
ARRANGEMENT = Arrangement((1, 1, 1, 1), 2)
# A lens of the double Gauss kind, in focal lengths: curvatures, gaps with the stop, image distance.
START = [
    *(1.9, 0.5, 1.2, 2.9, -3.0, -1.3, 0.1, -1.6),
    *(0.08, 0.01, 0.1, 0.12, 0.12, 0.1, 0.01, 0.08, 0.68),
]


def lenses(count, spread=0.003):
    generator = torch.Generator().manual_seed(3)
    start = torch.tensor(START, dtype=torch.float64)
    off = torch.randn(count, len(start), generator=generator, dtype=torch.float64)
    return start * (1.0 + spread * off)


@pytest.fixture(scope="module")
def merit():
    return SearchMerit.of(ARRANGEMENT, QUARTET)


@pytest.fixture(scope="module")
def conditions(merit):
    """Unequal in all that is held, so that nothing of it is left out of a derivative."""
    found = merit.full(4)
    generator = torch.Generator().manual_seed(4)
    weights = torch.rand(found.field_weights.shape, generator=generator, dtype=torch.float64)
    shifts = 0.02 * torch.randn(found.shifts.shape, generator=generator, dtype=torch.float64)
    return replace(
        found,
        f_number=torch.tensor([8.0, 7.0, 6.0, 6.5], dtype=torch.float64),
        field=torch.tensor([0.4, 0.5, 0.6, 0.7], dtype=torch.float64),
        field_weights=weights,
        shifts=shifts,
        pupils=torch.tensor([0.02, 0.97, 0.01, -0.01, 0.99, 0.02]).double().expand(4, 3, 6),
    )


def test_the_sequence_has_cemented_surfaces_once_and_the_stop_in_its_air_space():
    found = Arrangement((1, 2, 1), 2)
    assert found.sequence == (0, 1, 2, 3, 4, STOP, 5, 6)
    assert found.gap_media == (0, AIR, 1, 2, AIR, AIR, 3)
    assert found.variables == 7 + 7 + 1
    # In glass, behind the first surface of the second group.
    within = Arrangement((1, 2, 1), 1, 1)
    assert within.sequence == (0, 1, 2, STOP, 3, 4, 5, 6)
    assert within.gap_media == (0, AIR, 1, 1, 2, AIR, 3)


def test_the_gradient_is_the_difference_of_the_merit(merit, conditions):
    u = lenses(4)
    found = merit.evaluate(u, conditions)
    assert bool(torch.isfinite(found.merit).all())
    step = 1e-6
    for column in range(u.shape[1]):
        ends = []
        for side in (step, -step):
            moved = u.clone()
            moved[:, column] += side
            ends.append(merit.evaluate(moved, conditions).merit)
        # The gradient of the model is half of the merit's.
        difference = (ends[0] - ends[1]) / (4.0 * step)
        error = (difference - found.gradient[:, column]).abs()
        assert bool((error < 1e-6 * found.gradient.abs().amax(-1)).all()), column


def test_the_model_is_that_of_gauss_and_newton_near_zero_residuals(merit, conditions):
    """g of a short step is g + H·step, up to the residuals' own curvature."""
    u = lenses(4)
    found = merit.evaluate(u, conditions)
    assert torch.allclose(found.hessian, found.hessian.mT)
    assert bool((torch.linalg.eigvalsh(found.hessian) > -1e-9).all())


def test_paraxial_numbers_are_those_of_the_lens(merit):
    u = lenses(1)
    lens = designed_lens(ARRANGEMENT, QUARTET, u[0], "made")
    found = paraxial(ARRANGEMENT, numbers_of(ARRANGEMENT, u.unbind(-1), list(merit.indices)))
    first_order = lens.first_order(587.5618)
    assert 100.0 / float(found.power) == pytest.approx(first_order.efl.item(), rel=1e-12)
    assert 100.0 * float(found.back_focus) == pytest.approx(first_order.bfd.item(), rel=1e-12)
    pupil = 100.0 * float(found.entrance_pupil)
    assert pupil == pytest.approx(first_order.entrance_pupil.z.item(), rel=1e-10)


# A quartet of 6.4 µm, mm: radii, gaps with the stop, image distance.
RADII = (92.3998, 290.546, -88.7409, -102.231, 54.1515, -127.0626, -37.1968, 320.955)
GAPS = (4.1945, 6.6717, 65.478, 0.05, 0.05, 75.2021, 3.8137, 2.0, 30.0)


def test_spots_of_real_beams_are_those_of_the_lens_through_its_stop():
    specification = replace(QUARTET, wavelengths=(587.5618,), glasses=("1.5168/64.17",))
    merit = SearchMerit.of(ARRANGEMENT, specification, 8, 16)
    numbers = [*(100.0 / radius for radius in RADII), *(gap / 100.0 for gap in GAPS)]
    u = torch.tensor([numbers], dtype=torch.float64)
    conditions = with_real_beams(merit, u, merit.full(1))
    spots = merit.spots(u, conditions)[0]
    lens = designed_lens(ARRANGEMENT, specification, u[0], "made")
    fields = [(0.0, angle) for angle in specification.fields]
    where = conditions_of(lens, fields, specification.wavelengths)
    exact = spot_diagram(lens, where).polychromatic_rms
    torch.testing.assert_close(spots, exact, rtol=5e-3, atol=0.0)
    # Paraxial circles of the pupil are another beam.
    paraxial_spots = merit.spots(u, merit.full(1))[0]
    assert float((paraxial_spots / exact - 1.0).abs().max()) > 0.03


def test_apertures_clip_as_much_light_as_may_be_vignetted():
    """The outermost beam is an ellipse of 0.7 of the stop's area; the axial one loses nothing."""
    specification = replace(
        QUARTET, wavelengths=(587.5618,), glasses=("1.5168/64.17",), vignetting=0.3
    )
    merit = SearchMerit.of(ARRANGEMENT, specification, 8, 16)
    numbers = [*(100.0 / radius for radius in RADII), *(gap / 100.0 for gap in GAPS)]
    u = torch.tensor([numbers], dtype=torch.float64)
    lens = designed_lens(ARRANGEMENT, specification, u[0], "made")
    beams = real_beams(lens, count=3)
    assert float(beams.vignetted[0]) == 0.0 and float(beams.failed.max()) == 0.0
    assert 0.05 < float(beams.vignetted[-1]) <= 0.3
    # The ellipse of the merit is within the light that passes: its spots are no larger than that
    # of the whole stop, whose outermost rays are aberrated most.
    vignetted = merit.spots(u, with_real_beams(merit, u, merit.full(1)))[0]
    whole = replace(merit, specification=replace(specification, vignetting=0.0))
    open_spots = whole.spots(u, with_real_beams(whole, u, whole.full(1)))[0]
    assert float(vignetted[0] / open_spots[0]) == pytest.approx(1.0, rel=1e-9)
    assert float(vignetted[-1]) < float(open_spots[-1])


@pytest.mark.parametrize(
    ("rings", "arms", "rim"),
    [(2, 4, False), (3, 6, False), (4, 8, False), (4, 6, True)],
)
def test_half_a_pupil_integrates_even_polynomials_exactly(rings, arms, rim):
    """Rings that end at the rim are exact for one power less than others."""
    points, weight = half_pupil(rings, arms, rim=rim)
    assert float(points.norm(dim=-1).max()) == pytest.approx(1.0, abs=1e-14) or not rim
    x, y = points.unbind(-1)
    assert bool((x > 0.0).all())
    for power in range(2 * rings - rim):
        # The mean of r^(2k) over the circle.
        mean = float((weight * (x * x + y * y) ** power).sum())
        assert mean == pytest.approx(1.0 / (power + 1), rel=1e-12)
    assert float((weight * y * y).sum()) == pytest.approx(0.25, rel=1e-12)
    assert float((weight * y).sum()) == pytest.approx(0.0, abs=1e-14)


@pytest.mark.parametrize("stop", range(4))
def test_a_shell_on_a_surface_moves_the_focus_little(stop):
    """Its two curvatures are those of the surface, to 0.02: a lens of no power."""
    groups = (1, 2, 1)
    arrangement = Arrangement(groups, stop)
    glass = ("1.5168/64.17",)
    specification = replace(QUARTET, groups=groups, glasses=glass)
    generator = torch.Generator().manual_seed(stop)
    u = 0.3 * torch.rand(3, arrangement.variables, generator=generator, dtype=torch.float64)
    u[:, arrangement.surfaces :] += 0.02

    def power(arrangement, values):
        wider = replace(specification, groups=arrangement.groups)
        return SearchMerit.of(arrangement, wider, 1, 1).paraxial_of(values)[0]

    before = power(arrangement, u)
    for found in inserted(arrangement, u, specification):
        assert sum(found.arrangement.groups) == 5
        after = power(found.arrangement, found.values)
        assert bool(((after - before).abs() < 0.04).all()), found.words


def test_a_shell_that_is_put_in_and_taken_out_leaves_the_curvatures():
    u = lenses(2)
    for found in inserted(ARRANGEMENT, u, QUARTET):
        outs = [
            back
            for back in taken_out(found.arrangement, found.values)
            if torch.equal(back.values[:, :8], u[:, :8])
        ]
        assert outs, found.words
        assert outs[0].arrangement.groups == ARRANGEMENT.groups


def test_what_a_specification_cannot_mean_is_said():
    with pytest.raises(InputError, match="fields must begin with 0"):
        replace(QUARTET, fields=(5.0,))
    with pytest.raises(InputError, match="one for all or 4"):
        replace(QUARTET, glasses=("1.5168/64.17", "1.6/40"))
    with pytest.raises(InputError, match="stops: from 0 to 4, not 5"):
        replace(QUARTET, stops=(5,))
    with pytest.raises(InputError, match=r"limits\.glass"):
        Limits(glass=(5.0, 2.0))
    assert math.isclose(QUARTET.wavelengths[QUARTET.reference], 587.5618)
