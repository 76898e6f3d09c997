"""Neighbours of a lens do its task with its glasses; the lens itself is among them."""

import pytest
import torch

import dolens
from dolens import InputError
from dolens.analysis.conditions import conditions
from dolens.analysis.spot_diagram import spot_diagram
from dolens.lens_search.arrangement import Arrangement
from dolens.lens_search.designs import designed_lens
from dolens.lens_search.neighbours import KnownLens


@pytest.mark.parametrize("name", ["cooke_triplet", "double_gauss", "quartet"])
def test_a_lens_that_a_search_has_read_is_the_lens(name):
    """A stop on a surface becomes a plane at its vertex; first order is that of the lens."""
    lens = dolens.load_lens(name)
    known = KnownLens.of(lens, {}, 0.0)
    again = designed_lens(known.arrangement, known.specification, known.values, name)
    wave = lens.primary_wavelength
    for key in ("efl", "bfd"):
        values = [getattr(each.first_order(wave), key).item() for each in (again, lens)]
        assert values[0] == pytest.approx(values[1], rel=1e-9)
    rays = dolens.Rays(torch.tensor([0.0, 3.0, -10.0]), torch.tensor([0.0, 0.0, 1.0]), wave)
    there, here = (each.trace(rays).position for each in (again, lens))
    assert (there[:2] - here[:2]).abs().max().item() < 1e-9


def test_a_minimum_is_its_own_best_neighbour_and_others_are_no_better_for_their_starts():
    """Lenses about one that a search has finished find it again, or one that is better."""
    glasses = ["1.6204/60.31", "1.6200/36.37", "1.6204/60.31"]
    lens = dolens.search(50, 4.9, 20, 3, glasses=glasses, starts=60, batch=15, forms=1).best
    near = lens.search_neighbours(starts=30, forms=3)
    where = conditions(lens)
    own = 1e3 * float(spot_diagram(lens, where).polychromatic_rms.mean())
    assert near[0].found.mean_rms_spot_um < 1.02 * own
    for form in near:
        assert form.lens.first_order().efl.item() == pytest.approx(lens.first_order().efl.item())
        assert form.glasses == ", ".join(glasses)


def test_elements_of_one_glass_are_moved():
    """The packaged quartet is led to a better form of the same powers, which no start drew."""
    near = dolens.load_lens("quartet").search_neighbours(starts=5, forms=4)
    assert " out, shell behind " in " ".join(near[0].found.history)
    assert near[0].holds and len({form.powers for form in near}) > 1


def test_the_stop_is_moved_without_the_surfaces():
    """Rays do not know where the stop is."""
    lens = dolens.load_lens("cooke_triplet")
    known = KnownLens.of(lens, {}, 0.0)
    wave = lens.primary_wavelength
    ray = dolens.Rays(torch.tensor([0.0, 3.0, -10.0]), torch.tensor([0.0, 0.0, 1.0]), wave)
    there = lens.trace(ray).position
    for stop in range(4):
        other = Arrangement.of(known.specification, stop)
        moved = designed_lens(other, known.specification, known.with_stop(other), f"stop {stop}")
        assert moved.trace(ray).position[1].item() == pytest.approx(there[1].item(), abs=1e-9)


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        ("nikon", {}, "surface 17; allowed: spheres and planes"),
        ("la1509", {}, "has a near object"),
        ("published/maksutov_camera_200", {}, "has mirrors or tilted elements"),
        ("cooke_triplet", {"starts": 0}, "starts: 0; allowed"),
        ("cooke_triplet", {"spread": -1}, "spread: -1; allowed: 0 to below 10"),
        ("cooke_triplet", {"limits": {"trck": 70}}, "did you mean 'track'"),
        ("cooke_triplet", {"vignetting": 2.0}, "vignetting must lie from 0"),
        ("cooke_triplet", {"seconds": "ten"}, "seconds: 'ten'; allowed"),
    ],
)
def test_what_has_no_neighbours_is_refused_in_one_line(name, given, message):
    with pytest.raises(InputError, match=message):
        dolens.load_lens(name).search_neighbours(**given)
