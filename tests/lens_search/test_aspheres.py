"""A search's aspheres are polynomials; limits hold within the beam as well as at its edge."""

import math
from dataclasses import replace

import pytest
import torch

from dolens.analysis.conditions import field_scans
from dolens.analysis.field_curves import parabasal_rays
from dolens.errors import InputError
from dolens.lens_search.arrangement import Arrangement
from dolens.lens_search.designs import Designs, designed_lens
from dolens.lens_search.form_coordinates import lens_arrays
from dolens.lens_search.merit import SearchMerit
from dolens.lens_search.operands import asphere_slopes, sags
from dolens.lens_search.paraxial import Tangents
from dolens.lens_search.search import SearchPlan, Stage, grown_starts
from dolens.lens_search.specification import Limits, Specification
from dolens.lens_search.starts import inserted, random_starts, taken_out
from dolens.optics.surfaces.clear_aperture import Circle

# Two plastic lenses of a small camera; the first is spherical in front of its cemented neighbour.
CAMERA = Specification(
    focal_length=4.0,
    f_number=3.0,
    fields=(0.0, 15.0, 25.0),
    wavelengths=(587.5618, 486.1327),  # the second is the reference
    groups=(1, 2),
    glasses=("1.531/56", "1.585/30", "1.531/56"),
    stops=(0,),
    asphere_terms=(0, 2, 3),
    limits=Limits(
        glass=(0.3, 1.5), air=(0.05, 1.5), glass_edge=0.2, track=6.0, chief_ray_angle=25.0
    ),
)
ARRANGEMENT = Arrangement.of(CAMERA, 0)


def lenses(count=2):
    """Starts whose coefficients are not zero."""
    merit = SearchMerit.of(ARRANGEMENT, CAMERA, 2, 3)
    u = random_starts(merit, 40, torch.Generator().manual_seed(1))[:count].clone()
    first = ARRANGEMENT.image_column + 1
    bent = torch.randn(u[:, first:].shape, generator=torch.Generator().manual_seed(2)).double()
    u[:, first:] = 0.05 * bent
    return u


def conditions(merit, count):
    full = merit.full(count)
    return replace(full, f_number=2.5 * full.f_number, field=0.4 * full.field)


def test_a_cemented_surface_has_the_terms_of_the_element_in_front_of_it():
    assert ARRANGEMENT.terms == (0, 0, 2, 2, 3)
    assert ARRANGEMENT.aspheres == [2, 3, 4]
    assert ARRANGEMENT.variables == 5 + 5 + 1 + 7


def test_derivatives_with_respect_to_coefficients_are_differences_of_values():
    merit = SearchMerit.of(ARRANGEMENT, CAMERA, 2, 3)
    u = lenses()
    here = conditions(merit, len(u))
    model, step = merit.evaluate(u, here), 1e-6
    rows = merit._evaluate(u, here).derivatives
    assert bool(torch.isfinite(model.merit).all())
    for column in range(ARRANGEMENT.variables):
        off = torch.zeros_like(u)
        off[:, column] = step
        above, below = u + off, u - off
        slope = (merit.deviations(above, here) - merit.deviations(below, here)) / (2 * step)
        torch.testing.assert_close(rows[:, :, column], slope, rtol=1e-6, atol=1e-7)
        values = merit.evaluate(above, here).merit - merit.evaluate(below, here).merit
        largest = model.gradient.abs().amax(1)
        assert bool(
            ((values / (4 * step) - model.gradient[:, column]).abs() < 1e-6 * largest).all()
        )


def test_sags_and_slopes_are_those_of_the_lens_that_is_written():
    merit = SearchMerit.of(ARRANGEMENT, CAMERA)
    u = lenses(1)
    lens = designed_lens(ARRANGEMENT, CAMERA, u[0], "camera")
    numbers, f = merit.lens_numbers(u), CAMERA.focal_length
    for surface in ARRANGEMENT.aspheres:
        written = lens.system().surfaces[surface + 1]  # the stop is first
        for height in (0.05, 0.2):
            rows = torch.zeros((1, 1 + ARRANGEMENT.variables, 1), dtype=torch.float64)
            rows[0, 0, 0] = height
            r = torch.tensor([height * f], dtype=torch.float64)
            sag, slope, _, _ = written.shape.sag_and_gradient(written.parameters, r, 0.0 * r)
            own = sags(ARRANGEMENT, numbers, [surface], Tangents(rows)).value
            assert float(own.detach()) * f == pytest.approx(float(sag), rel=1e-12)
            own = asphere_slopes(ARRANGEMENT, numbers, [surface], Tangents(rows)).value
            assert float(own) == pytest.approx(float(slope), rel=1e-12)


def test_a_form_counts_an_asphere_as_its_lens_does():
    u = lenses(1)
    merit = SearchMerit.of(ARRANGEMENT, CAMERA, 2, 3)
    arrays = Designs(
        ARRANGEMENT, u, torch.zeros(1, 3), torch.zeros(1), torch.zeros(1), (("start",),)
    ).arrays(merit)
    lens = designed_lens(ARRANGEMENT, CAMERA, u[0], "camera")
    for surface in list(lens.surfaces.values())[
        1:
    ]:  # real beams may be lower than the paraxial one
        surface.aperture = replace(surface.aperture, edge=Circle(10.0))
    written = lens_arrays(lens)
    height = arrays.heights[0] * CAMERA.focal_length
    torch.testing.assert_close(
        height[1:], written.heights[0, 1:], rtol=1e-6, atol=1e-9
    )  # behind the stop
    torch.testing.assert_close(arrays.departures, written.departures, rtol=1e-6, atol=1e-9)


def test_a_space_that_closes_within_the_beam_is_refused():
    """Two surfaces apart on the axis and at the edge, which cross at seven tenths of the way."""
    pair = replace(
        CAMERA,
        groups=(1, 1),
        glasses=("1.531/56",),
        asphere_terms=(2,),
        limits=Limits(glass=(0.1, 1.5), air=(0.02, 1.5), glass_edge=0.05, distortion=None),
    )
    arrangement = Arrangement.of(pair, 0)
    merit = SearchMerit.of(arrangement, pair, 2, 3)
    u = torch.zeros((2, arrangement.variables), dtype=torch.float64)
    u[:, :4] = torch.tensor([0.8, -0.2, -0.2, -0.8])
    s = arrangement.surfaces
    u[:, s : s + arrangement.gaps + 1] = torch.tensor([0.02, 0.2, 0.02, 0.2, 0.9])
    h = float(merit.first_order(u)[1].marginal[1][0]) / 6.0
    h += float(merit.first_order(u)[1].chief[1][0]) * math.tan(math.radians(25.0))
    # The bump 0.03·4(r/h)²(1 - (r/h)²) of the first lens's back is zero at both ends.
    columns = list(arrangement.coefficient_columns[1])
    u[1, 1] += 2.0 * 0.12 / h**2
    u[1, columns[0]] = -0.12 / h**4
    deviations = merit.deviations(u, merit.full(2))
    assert float(deviations[0, 1:].max()) < 0.0
    assert float(deviations[1, 1:].max()) == pytest.approx(0.03 - (0.02 - 0.0), abs=0.004)


def test_angles_of_chief_rays_are_those_of_rays_through_the_lens():
    merit = SearchMerit.of(ARRANGEMENT, CAMERA, 2, 3)
    u = lenses(1)
    here = conditions(merit, 1)
    lens = designed_lens(ARRANGEMENT, CAMERA, u[0], "camera")
    field = math.degrees(math.atan(0.4 * math.tan(math.radians(25.0))))
    (scan,) = field_scans(lens, edge=field, count=2)
    chief = parabasal_rays(lens, scan, [486.1327])
    slope = float(chief.slope[-1, 0].norm())
    expected = slope / math.hypot(1.0, slope) - math.sin(math.radians(0.999 * 25.0))
    assert float(merit.deviations(u, here)[0, -1]) == pytest.approx(expected, abs=1e-7)


def test_a_shell_beside_an_asphere_bends_no_ray():
    """Two like faces, a thin shell between them: the image hardly moves."""
    alone = replace(CAMERA, groups=(1,), glasses=("1.531/56",), asphere_terms=(2,))
    pair = replace(alone, groups=(1, 1))
    first, second = Arrangement.of(alone, 0), Arrangement.of(pair, 0)
    merit = SearchMerit.of(first, alone, 2, 3)
    u = random_starts(merit, 4, torch.Generator().manual_seed(1))[:1].clone()
    u[0, first.image_column + 1 :] = torch.tensor([-0.1, 0.05, 0.2, -0.1])
    made = [n for n in inserted(first, u, pair) if n.words == "shell behind surface 2"]
    assert [neighbour.arrangement for neighbour in made] == [second, second]
    for neighbour in made:
        front, shell = (second.coefficient_columns[n] for n in (1, 2))
        assert torch.equal(neighbour.values[0, list(front)], neighbour.values[0, list(shell)])
        back = taken_out(second, neighbour.values)[1]
        assert torch.allclose(back.values, u, atol=1e-14)


def test_an_aspheric_singlet_has_no_spherical_aberration():
    """Of spheres the best bending of n = 1.5 has a blur of 0.067·f/F³ (Smith, ch. 3)."""
    sphere = Specification(
        focal_length=10.0,
        f_number=2.0,
        fields=(0.0,),
        wavelengths=(587.5618,),
        groups=(1,),
        glasses=("1.5",),
        stops=(0,),
        limits=Limits(glass=(2.0, 2.5), air=(0.0, 0.1)),
    )
    stages = (Stage(2.0, 1.0, iterations=20), Stage(iterations=60))
    plan = SearchPlan(starts=12, batch=12, stages=stages, finished=1.0, escapes=0, finish_rounds=3)
    best = {}
    for terms in (0, 3):
        step = grown_starts(replace(sphere, asphere_terms=(terms,)), plan, ((0, 0), 0, 12))
        best[terms] = float(step.designs[0].merit.min())
    blur = 0.067 * 10.0 / 2.0**3
    assert 0.1 * blur < best[0] < blur
    assert best[3] < 1e-4 * best[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"asphere_terms": (1, 2)}, "one for all or 3"),
        ({"asphere_terms": (9,)}, "from 0 to 8"),
        ({"limits": lambda: Limits(slope=90.0)}, "between 0 and 90 degrees"),
    ],
)
def test_wrong_aspheres_are_named(change, message):
    with pytest.raises(InputError, match=message):
        replace(CAMERA, **{k: v() if callable(v) else v for k, v in change.items()})
