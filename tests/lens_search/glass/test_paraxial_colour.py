"""Paraxial colour of a batch of lenses: that of each lens by itself, with its derivatives."""

import math

import pytest
import torch

from dolens.lens_search.arrangement import Arrangement
from dolens.lens_search.glass.dispersion_coordinates import (
    conrady_basis,
    coordinates_of,
    material_text,
)
from dolens.lens_search.glass.paraxial_colour import paraxial_colour
from dolens.lens_search.paraxial import LensNumbers
from dolens.lens_search.tangents import Tangents
from dolens.optics.paraxial_rays import paraxial_rays
from dolens.prescriptions.build import lens_from_prescription

LINES = (486.1327, 587.5618, 656.2725)
GLASSES = ((1.6204, 60.31, 0.0), (1.62, 36.37, 0.003), (1.6204, 60.31, 0.0))
# The Cooke triplet of the supplement, its stop in front of the fourth surface, over 50 mm.
RADII = (22.014, -435.76, -22.213, 20.292, 79.684, -18.395)
GAPS = (3.259, 6.008, 1.0, 0.7, 4.05, 2.952)
IMAGE, SCALE = 42.208, 50.0
ARRANGEMENT = Arrangement((1, 1, 1), 2)


def variables(lenses=3):
    """Curvatures, gaps, image and the coordinates of three glasses, (L, 22), in units of 50 mm."""
    row = [SCALE / r for r in RADII] + [g / SCALE for g in GAPS] + [IMAGE / SCALE]
    row += [x for glass in GLASSES for x in coordinates_of(*glass)]
    scatter = torch.randn(lenses, len(row), generator=torch.Generator().manual_seed(0)).double()
    scatter[0] = 0.0
    return torch.tensor(row, dtype=torch.float64) * (1.0 + 0.02 * scatter)


def colour(columns):
    """Colour of lenses whose variables are numbers of any kind."""
    basis = conrady_basis(LINES)
    glasses = [columns[13 + 3 * g : 16 + 3 * g] for g in range(3)]
    lenses = []
    for w in range(3):
        glass = [basis.index_at(glass, w) for glass in glasses]
        indices = [1.0, glass[0], 1.0, glass[1], 1.0, glass[2], 1.0]
        lenses.append(LensNumbers(columns[:6], columns[6:12], columns[12], indices))
    return paraxial_colour(ARRANGEMENT, lenses, 1)


def traced(row):
    """The lens of one row of variables, in units of its scale."""
    media = [material_text(row[13 + 3 * g : 16 + 3 * g]) for g in range(3)]
    surfaces = {}
    # The stop, a plane, is surface 5, behind the second element.
    places = [0, 1, 2, 3, None, 4, 5]
    for number, place in enumerate(places, 1):
        # Gap n is behind entry n of the sequence.
        medium = media[place // 2] if place is not None and place % 2 == 0 else "air"
        surface = {"semi_diameter": 0.08, "material": medium}
        if place is not None:
            surface["radius"] = 1.0 / float(row[place])
        else:
            surface["radius"] = float("inf")
        if number < 7:
            surface["thickness"] = float(row[6 + number - 1])
        surfaces[str(number)] = surface
    prescription = {"stop": 5, "surfaces": surfaces, "sensor": {"distance": float(row[12])}}
    return lens_from_prescription(prescription, dtype=torch.float64)


def test_the_arrangement_is_that_of_the_traced_lens():
    assert ARRANGEMENT.sequence == (0, 1, 2, 3, -1, 4, 5)


def test_colour_is_that_of_each_lens_by_itself():
    values = variables()
    found = colour(list(values.T))
    for lens, row in enumerate(values):
        one = traced(row)
        first = [one.first_order(line) for line in LINES]
        last = one.system().vertices[6]
        heights = []
        for w, numbers in enumerate(first):
            focus = (numbers.focus - last).item()
            assert found.focus[w][lens].item() == pytest.approx(focus, rel=1e-10)
            blur = (focus - row[12].item()) / numbers.efl.item()
            assert found.axial[w][lens].item() == pytest.approx(blur, abs=1e-12)
            chief = paraxial_rays(one.system(), LINES[w], math.atan(1.0)).chief
            heights.append(chief.height[-1] + row[12] * chief.slope_after[-1])
        for w in range(3):
            lateral = (heights[w] - heights[1]).item()
            assert found.lateral[w][lens].item() == pytest.approx(lateral, abs=1e-11)


def test_derivatives_are_carried_along():
    values = variables()
    exact = torch.autograd.functional.jacobian(
        lambda v: torch.stack([*colour(list(v.T)).axial, *colour(list(v.T)).lateral]).sum(1), values
    )
    found = colour(Tangents.variables(values))
    numbers = [*found.axial, *found.lateral]
    rows = torch.stack([number.rows for number in numbers])
    torch.testing.assert_close(rows[:, 1:].transpose(1, 2), exact, rtol=1e-9, atol=1e-12)


def test_an_achromat_has_no_primary_colour_and_a_secondary_spectrum():
    """A thin doublet with the powers of the textbook: V₁/(V₁ - V₂) and -V₂/(V₁ - V₂)."""
    basis = conrady_basis(LINES)
    glasses = [(1.5168, 64.17, 0.0), (1.62004, 36.37, 0.0)]
    coordinates = torch.tensor([coordinates_of(*glass) for glass in glasses], dtype=torch.float64)
    n = basis.index(coordinates)
    powers = [64.17 / (64.17 - 36.37), -36.37 / (64.17 - 36.37)]
    kappa = [p / (g[0] - 1.0) for p, g in zip(powers, glasses, strict=True)]
    curvatures = [torch.tensor([c], dtype=torch.float64) for c in (kappa[0], 0.0, -kappa[1])]
    zero = torch.zeros(1, dtype=torch.float64)
    lenses = [
        LensNumbers(curvatures, [zero] * 3, zero + 1.0, [1.0, n[0, w], n[1, w], 1.0])
        for w in range(3)
    ]
    found = paraxial_colour(Arrangement((2,), 0), lenses, 1)
    assert found.primary_colour(0, 2).item() == pytest.approx(0.0, abs=1e-8)
    partial = (n[:, 0] - n[:, 1]) / (n[:, 0] - n[:, 2])
    expected = -(partial[0] - partial[1]) / (64.17 - 36.37)
    assert found.secondary_spectrum(0, 1, 2).item() == pytest.approx(expected.item(), rel=2e-3)
    assert torch.stack(list(found.lateral)).abs().max() < 1e-15
