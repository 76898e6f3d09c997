"""Lenses are one form where nothing that matters differs, and others where something does."""

import copy
import math
from dataclasses import replace

import pytest
import torch

from dolens import load_lens
from dolens.errors import InputError
from dolens.lens_search.form_coordinates import FormArrays
from dolens.lens_search.forms import (
    TOLERANCE,
    FoundLens,
    distinct,
    form_coordinates,
    form_distances,
    form_numbers,
    lens_distance,
)
from dolens.optics.paraxial import first_order
from dolens.optics.ray_tracing import trace_rays
from dolens.optimize import DampedLeastSquares
from tests.lenses import GLASS, lens_of_rows

PLANE = math.inf


def lens(rows, stop=1, sensor=100.0, fields=(0, 5, 10), **data):
    """A lens of rows (radius, thickness, material); a radius of None is an aperture."""
    data |= {"fields": {"angles": [[0, y] for y in fields]}, "reference_wavelength": 587.5618}
    waves = [656.2725, 587.5618, 486.1327]
    return lens_of_rows(
        *rows, semi_diameter=8.0, sensor=sensor, stop=stop, wavelengths=waves, **data
    )


def changed(one, **values):
    other = copy.deepcopy(one)
    with torch.no_grad():
        for name, value in values.items():
            other.variables([name.replace("_", ".", 2)])[name.replace("_", ".", 2)].fill_(value)
    return other


def scaled(one, factor):
    """The same lens in another unit of length."""
    other = copy.deepcopy(one)
    with torch.no_grad():
        for name, parameter in other.named_parameters():
            parameter.mul_(1.0 / factor if name.endswith("curvature") else factor)
    for surface in other.surfaces.values():
        surface.aperture = surface.aperture.resized(factor * surface.semi_diameter)
    return other


def found(one, merit, start=0):
    return FoundLens(one, merit, (1.0,), start)


@pytest.fixture(scope="module")
def triplet():
    return load_lens("cooke_triplet").requires_grad_(False)


MENISCUS = [(40.0, 4.0, GLASS), (60.0, 10.0, "air"), (80.0, 4.0, GLASS), (-80.0, 0.0, "air")]


def test_the_same_lens_at_another_scale_is_the_same_form(triplet):
    assert lens_distance(triplet, scaled(triplet, 7.3)) < 1e-12


def test_a_lens_moves_little_where_it_is_optimised_again(triplet):
    """Both end in the minimum of the same mean square spot, from curvatures 3 % apart."""
    names = [f"surfaces.{n}.curvature" for n in range(1, 7)]
    fields = torch.tensor([[0.0, 0.0], [0.0, 14.0], [0.0, 20.0]], dtype=torch.float64)
    pupil = 0.9 * torch.tensor([[0, 1], [0, -1], [1, 0], [0.6, 0.6]], dtype=torch.float64)
    rays = triplet.aim(fields[:, None], pupil, 587.5618)
    best = []
    for share in (1.0, 1.03):
        start = torch.stack([p.detach() for p in triplet.variables(names).values()])
        signs = torch.tensor([1.0, -1.0, 1.0, 1.0, -1.0, 1.0], dtype=torch.float64)
        u = (start * (1.0 + (share - 1.0) * signs)).requires_grad_()

        def residuals(u=u):
            values = dict(zip(names, u.unbind(), strict=True))
            system = triplet.system(values)
            points = trace_rays(system.opened(), rays).position[..., :2]
            spread = points - points.mean(1, keepdim=True)
            focal = first_order(system, 587.5618).efl - 50.0
            return torch.cat([10.0 * spread.flatten(), focal[None]])

        optimizer = DampedLeastSquares([u])
        for _ in range(7):
            optimizer.step(residuals)
        other = copy.deepcopy(triplet)
        for name, value in zip(names, u.detach(), strict=True):
            other.variables([name])[name].copy_(value)
        best.append(other)
    assert lens_distance(*best) < 0.2 * TOLERANCE
    assert lens_distance(*best) < 0.5 * lens_distance(best[0], triplet)


def test_another_bending_and_a_mirrored_lens_are_other_forms():
    one = lens([(50.0, 4.0, GLASS), (PLANE, 0.0, "air")])
    mirrored = lens([(PLANE, 4.0, GLASS), (-50.0, 0.0, "air")])
    assert lens_distance(one, mirrored) > 2.0 * TOLERANCE
    symmetric = lens([(100.0, 4.0, GLASS), (-100.0, 0.0, "air")])
    assert lens_distance(one, symmetric) > TOLERANCE


def test_the_order_of_different_elements_has_a_meaning_and_that_of_equal_ones_has_not():
    crown = [(60.0, 4.0, GLASS), (-60.0, 3.0, "air")]
    flint = [(-70.0, 2.0, "1.62/36.37"), (70.0, 3.0, "air")]
    assert lens_distance(lens(crown + flint), lens(flint + crown)) > 2.0 * TOLERANCE
    assert lens_distance(lens(crown + crown + flint), lens(crown + crown + flint)) == 0.0


def test_a_plane_plate_has_no_place_within_its_air_space():
    first, last = [(60.0, 4.0, GLASS)], [(80.0, 4.0, GLASS), (-80.0, 0.0, "air")]
    thin, thick = (PLANE, 1.0, GLASS), (PLANE, 3.0, "1.62/36.37")

    def with_plates(a, b, c, plates):
        (one, other) = plates
        rows = [*first, (200.0, a, "air"), one, (PLANE, b, "air"), other, (PLANE, c, "air"), *last]
        return lens(rows)

    one = with_plates(2.0, 5.0, 3.0, (thin, thick))
    assert lens_distance(one, with_plates(6.0, 1.0, 3.0, (thin, thick))) < 1e-12
    assert lens_distance(one, with_plates(6.0, 3.0, 1.0, (thick, thin))) < 1e-12
    # More air in all is another lens.
    assert lens_distance(one, with_plates(2.0, 15.0, 3.0, (thin, thick))) > TOLERANCE


def test_a_plate_in_front_of_the_lens_may_stand_anywhere():
    rest = [(60.0, 4.0, GLASS), (-80.0, 0.0, "air")]
    near, far = ([(PLANE, 2.0, GLASS), (PLANE, gap, "air"), *rest] for gap in (1.0, 40.0))
    assert lens_distance(lens(near, stop=3), lens(far, stop=3)) < 1e-12


def test_a_stop_of_its_own_does_nothing_but_stand_somewhere():
    plain = lens(MENISCUS, stop=2)
    apart = lens([*MENISCUS[:1], (60.0, 0.0, "air"), (None, 10.0, "air"), *MENISCUS[2:]], stop=3)
    assert lens_distance(plain, apart) < 1e-3
    later = lens([*MENISCUS[:1], (60.0, 8.0, "air"), (None, 2.0, "air"), *MENISCUS[2:]], stop=3)
    assert lens_distance(apart, later) > TOLERANCE


def test_glass_counts_by_index_and_dispersion():
    def of(glass):
        return lens([(60.0, 4.0, glass), (-60.0, 0.0, "air")])

    assert lens_distance(of("1.5168/64.17"), of("1.5180/64.17")) < TOLERANCE
    assert lens_distance(of("1.5168/64.17"), of("1.56/64.17")) > TOLERANCE
    assert lens_distance(of("1.62/60.3"), of("1.62/36.4")) > TOLERANCE


def test_another_number_of_elements_is_another_form(triplet):
    assert lens_distance(triplet, load_lens("double_gauss")) == math.inf


def test_an_asphere_departs_from_its_sphere():
    def of(conic):
        front = {"type": "conic", "radius": 60.0, "conic": conic, "thickness": 4.0}
        return lens([front | {"material": GLASS}, (-60.0, 0.0, "air")])

    sphere = lens([(60.0, 4.0, GLASS), (-60.0, 0.0, "air")])
    assert lens_distance(sphere, of(0.0)) < 1e-12
    assert lens_distance(sphere, of(-400.0)) > TOLERANCE


def test_at_unit_magnification_a_lens_may_be_turned_end_for_end():
    rows = [(40.0, 4.0, GLASS), (-90.0, 0.0, "air")]
    turned = [(90.0, 4.0, GLASS), (-40.0, 0.0, "air")]
    focal = float(lens(rows).first_order().efl)

    def near(rows, stop):
        made = lens(rows, stop=stop)
        first = made.first_order()
        # Principal planes at 2f on either side.
        made.object_distance = 2.0 * focal - float(first.front_principal)
        last = float(made.thicknesses["1"])
        made.sensor_distance.fill_(2.0 * focal + float(first.rear_principal) - last)
        made.fields = made.fields._replace(kind="heights", points=((0.0, 0.0), (0.0, 5.0)))
        return made

    assert lens_distance(near(rows, 1), near(turned, 2)) < 0.05 * TOLERANCE
    # In parallel light it is another lens.
    assert lens_distance(lens(rows), lens(turned, stop=2)) > TOLERANCE


def test_groups_begin_with_their_best_and_say_which_starts_led_there(triplet):
    other = changed(triplet, surfaces_3_curvature=-0.06)
    near = changed(triplet, surfaces_3_curvature=-1.0 / 22.3)
    lenses = [
        *(found(triplet, 2.0, 7), found(other, 1.5, 3), found(near, 1.0, 9)),
        *(found(other, math.nan, 4), found(scaled(triplet, 2.0), 3.0, 7)),
    ]
    first, second = distinct(lenses)
    assert first.places == (2, 0, 4) and first.best is lenses[2] and first.starts == (7, 9)
    assert second.places == (1,) and second.starts == (3,)
    with pytest.raises(InputError, match="tolerance"):
        distinct(lenses, 0.0)


def arrays(count, generator):
    """Random doublets of one structure."""

    def random(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    return FormArrays(
        0.02 * (2.0 * random(count, 4) - 1.0),
        5.0 + 10.0 * random(count, 4),
        torch.tensor([1.0, 1.5, 1.0, 1.6, 1.0], dtype=torch.float64).expand(count, 5),
        10.0 + 5.0 * random(count, 4),
        torch.full((count,), 100.0, dtype=torch.float64),
    )


def test_batches_are_grouped_as_pairs_are():
    """Every lens is near the best of its form, and no best is near a better one."""
    coordinates = form_coordinates(arrays(60, torch.Generator().manual_seed(1)))
    # Two of each lens, slightly apart, in another order.
    order = torch.randperm(120, generator=torch.Generator().manual_seed(2))
    twice = coordinates.taken(torch.cat([torch.arange(60)] * 2)[order])
    merit = torch.rand(120, generator=torch.Generator().manual_seed(3)).double()
    tolerance = 0.1
    numbers = form_numbers(twice, merit, tolerance)
    bests = []
    for number in range(int(numbers.max()) + 1):
        members = torch.nonzero(numbers == number).flatten()
        best = int(members[merit[members].argmin()])
        away = form_distances(twice.taken(members), twice.taken([best]))
        assert bool((away <= tolerance).all())
        if bests:
            to_better = form_distances(twice.taken(bests), twice.taken([best]))
            assert float(to_better.min()) > tolerance
            assert float(merit[best]) >= float(merit[bests[-1]])
        bests.append(best)
    assert 1 < len(bests) <= 60


def test_arrays_that_do_not_go_together_are_named():
    good = arrays(3, torch.Generator().manual_seed(1))
    with pytest.raises(InputError, match="gaps must be"):
        form_coordinates(
            FormArrays(good.curvatures, good.gaps[:2], *list(vars(good).values())[2:5])
        )
    afocal = torch.zeros(3, dtype=torch.float64)
    with pytest.raises(InputError, match="without a focal length"):
        form_coordinates(replace(good, focal_lengths=afocal))
