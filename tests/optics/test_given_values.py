"""A lens with given values, wherever it is copied, is the lens that stores these values."""

import copy

import pytest
import torch

from dolens import Rays, load_lens
from dolens.analysis.pupil_quadrature import gaussian_quadrature
from dolens.optics.field_and_aperture import in_double_precision, with_aperture
from dolens.optimize.image_quality import without_edges
from dolens.rendering.whole_field import WholeField
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor
from dolens.tolerancing.sensitivity import linear_spots

GREEN = 587.5618
OFFSET = "media.1.index_offset"
STORED = {"surfaces.1.curvature": 0.047, "thicknesses.2": 6.1, "sensor_distance": 41.9}
STOP = 2.9


def given(lens):
    """Values with a graph, a smaller stop and a melt's index, which no lens stores."""
    numbers = {**STORED, f"surfaces.{lens.stop}.semi_diameter": STOP, OFFSET: 1e-3}
    values = {n: torch.tensor(v, dtype=lens.dtype, requires_grad=True) for n, v in numbers.items()}
    return lens.with_values({name: 1.0 * value for name, value in values.items()}), values


def storing(lens):
    """The same lens by hand."""
    found = copy.deepcopy(lens)
    with torch.no_grad():
        for name, value in STORED.items():
            found.get_parameter(name).fill_(value)
    stop = found.surfaces[str(found.stop)]
    stop.aperture = stop.aperture.resized(float(torch.tensor(STOP, dtype=lens.dtype)))
    return found.with_values({OFFSET: torch.tensor(1e-3, dtype=lens.dtype)})


def assert_same(found, expected):
    assert dict(found.named_parameters()).keys() == dict(expected.named_parameters()).keys()
    for name, value in expected.named_parameters():
        assert torch.equal(found.get_parameter(name), value), name
    assert [s.aperture for s in found.surfaces.values()] == [
        s.aperture for s in expected.surfaces.values()
    ]
    assert set(found.given) == set(expected.given) == {OFFSET}
    assert torch.equal(found.given[OFFSET], expected.given[OFFSET])
    assert found.given[OFFSET].dtype == expected.dtype and not found.given[OFFSET].requires_grad


COPIES = {
    "stored": lambda lens: lens.storing_its_values(),
    "hot": lambda lens: lens.at(80.0),
    "stopped down": lambda lens: with_aperture(lens, f_number=8.0),
}


@pytest.mark.parametrize("made", COPIES)
def test_copies_store_the_given_values(made):
    lens = load_lens("cooke_triplet")
    before = {name: value.detach().clone() for name, value in lens.named_parameters()}
    assert_same(COPIES[made](given(lens)[0]), COPIES[made](storing(lens)))
    assert all(torch.equal(value, before[name]) for name, value in lens.named_parameters())


def test_a_copy_in_double_precision_stores_the_given_values():
    lens = load_lens("cooke_triplet", dtype=torch.float32)
    found = in_double_precision(given(lens)[0])
    assert found.dtype == torch.float64
    assert_same(found, storing(lens).storing_its_values().double())


def test_given_values_are_converted_with_the_lens():
    lens = storing(load_lens("cooke_triplet", dtype=torch.float32))
    assert lens.double().given[OFFSET].dtype == torch.float64


def test_spots_and_their_derivatives_are_of_the_given_values():
    lens = load_lens("cooke_triplet")
    names = ["surfaces.2.curvature", "thicknesses.1"]
    spots = gaussian_quadrature(storing(lens), [(0.0, 5.0)], [GREEN], 3, 6, symmetry=False)
    found, expected = (linear_spots(each, spots, names) for each in (given(lens)[0], storing(lens)))
    for part in ("centroids", "centroid_jacobian", "points", "mixed", "tangents"):
        assert torch.equal(getattr(found, part), getattr(expected, part)), part


def test_a_whole_field_is_that_of_the_given_values():
    lens, scene, sensor = (
        load_lens("cooke_triplet"),
        PlanarScene((5000.0,), (640.0, 550.0, 460.0)),
        Sensor(24, 24, 0.05),
    )
    found, expected = (
        WholeField.of(each, scene, sensor, "none") for each in (given(lens)[0], storing(lens))
    )
    assert torch.equal(found.illumination.light, expected.illumination.light)


def test_a_lens_without_edges_has_the_given_values_and_their_gradients():
    lens = load_lens("cooke_triplet")
    position = torch.tensor([[0.0, 1.0, -5.0], [0.0, 8.0, -5.0]]).double()
    rays = Rays(position, torch.tensor([0.0, 0.0, 1.0]).double().expand(2, 3), GREEN)
    changed, values = given(lens)
    opened, expected = without_edges(changed), without_edges(storing(lens))
    hit = opened.trace(rays)
    assert bool(hit.valid.all())
    assert torch.equal(hit.position, expected.trace(rays).position)
    f_numbers = (float(each.first_order().f_number.detach()) for each in (opened, expected))
    assert next(f_numbers) == next(f_numbers)
    names = [*STORED, OFFSET]
    slopes = torch.autograd.grad(hit.position[0, 1], [values[name] for name in names])
    assert all(float(slope) != 0.0 for slope in slopes)
    assert opened.get_parameter("thicknesses.1") is lens.get_parameter("thicknesses.1")


def test_numbers_are_values_too_in_the_lens_s_precision():
    lens = load_lens("cooke_triplet", dtype=torch.float32)
    moved = lens.with_values({"sensor_distance": 42.5})
    assert moved.given["sensor_distance"].dtype == torch.float32
    shift = (moved.system().vertices[-1] - lens.system().vertices[-1]).item()
    assert shift == pytest.approx(42.5 - lens.sensor_distance.item(), abs=1e-4)
