"""How spots answer to one error: against finite differences and against closed forms."""

import math

import pytest
import torch

from dolens import InputError
from dolens.analysis.pupil_quadrature import gaussian_quadrature
from dolens.prescriptions import lens_from_prescription
from dolens.tolerancing import linear_spots, sensitivities, spot_weights

NAMES = (
    "elements.front.tilt_x",
    "elements.middle.tilt_y",
    "elements.rear.decenter_x",
    "elements.middle.decenter_y",
    "elements.front.shift_z",
    "surfaces.3.curvature",
    "thicknesses.3",
    "sensor_distance",
)


def test_derivatives_equal_central_differences_of_traced_lenses(
    triplet, spots, moved, traced_spots
):
    model = linear_spots(triplet, spots, NAMES)
    step = 1e-5
    for column, name in enumerate(NAMES):
        h = 0.01 * step if name.endswith("curvature") else step
        (above, rms_above), (below, rms_below) = (
            traced_spots(moved(triplet, {name: sign * h}), spots) for sign in (1, -1)
        )
        centroid, rms = (above - below) / (2 * h), (rms_above - rms_below) / (2 * h)
        scale = float(centroid.abs().max()), float(rms.abs().max())
        torch.testing.assert_close(
            model.centroid_jacobian[..., column], centroid, rtol=1e-6, atol=1e-6 * scale[0]
        )
        torch.testing.assert_close(
            model.rms_jacobian[:, column], rms, rtol=1e-5, atol=1e-6 * scale[1]
        )
    centroids, radii = traced_spots(triplet, spots)
    torch.testing.assert_close(model.centroids, centroids, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(model.rms_radii, radii, rtol=1e-10, atol=0.0)


def test_a_lens_that_is_off_already_has_derivatives_where_it_stands(
    triplet, spots, moved, traced_spots
):
    tilted = moved(triplet, {"elements.middle.tilt_x": math.radians(0.4)})
    name, h = "elements.middle.tilt_x", 1e-5
    model = linear_spots(tilted, spots, [name])
    radii = [traced_spots(moved(tilted, {name: sign * h}), spots)[1] for sign in (1, -1)]
    torch.testing.assert_close(
        model.rms_jacobian[:, 0], (radii[0] - radii[1]) / (2 * h), rtol=1e-5, atol=1e-7
    )


@pytest.fixture
def thin_pair():
    """Two nearly thin lenses 30 mm apart and a plate before the sensor, for a narrow beam."""
    thin = 1e-3
    surfaces = {
        "1": {"type": "sphere", "radius": 100.0, "thickness": thin, "material": "1.5"},
        "2": {"type": "sphere", "radius": -100.0, "thickness": 30.0, "material": "air"},
        "3": {"type": "sphere", "radius": 80.0, "thickness": thin, "material": "1.5"},
        "4": {"type": "sphere", "radius": -80.0, "thickness": 5.0, "material": "air"},
        "5": {"type": "plane", "thickness": 6.0, "material": "1.6"},
        "6": {"type": "plane", "material": "air"},
    }
    for row in surfaces.values():
        row["semi_diameter"] = 5.0
    surfaces["1"]["semi_diameter"] = 0.05
    prescription = {
        "name": "thin pair",
        "index_model": "dfc",
        "stop": 1,
        "surfaces": surfaces,
        "elements": {
            "first": {"surfaces": [1, 2]},
            "second": {"surfaces": [3, 4]},
            "plate": {"surfaces": [5, 6]},
        },
        "sensor": {"distance": 30.0, "diameter": 10.0},
    }
    lens = lens_from_prescription(prescription, torch.float64)
    first_order = lens.first_order(587.5618)
    with torch.no_grad():
        lens.sensor_distance.copy_(first_order.image - lens.system().vertices[5])
    return lens


@pytest.fixture
def motion(thin_pair):
    """Derivative of the axial spot's centroid, (2,), by a parameter."""
    spots = gaussian_quadrature(thin_pair, [(0.0, 0.0)], [587.5618], 2, 4, symmetry=False)

    def by(name):
        return linear_spots(thin_pair, spots, [name]).centroid_jacobian[0, :, 0].tolist()

    return by


def test_a_decentred_lens_moves_the_image_by_what_its_magnification_leaves(motion, thin_pair):
    """A thin lens of magnification m moves its image by (1 - m) of its own displacement.

    The first images infinity (m = 0), and the second passes that on m-fold.
    """
    magnification = float(thin_pair.first_order(587.5618).efl.detach()) / 100.0
    for axis in (0, 1):
        for element, expected in (("first", magnification), ("second", 1.0 - magnification)):
            found = motion(f"elements.{element}.decenter_{'xy'[axis]}")
            assert found[axis] == pytest.approx(expected, abs=2e-5)
            assert found[1 - axis] == pytest.approx(0.0, abs=1e-12)


def test_a_tilted_plate_moves_the_image_by_t_times_one_less_one_over_n(motion):
    """A turn about +x leans the normal towards -y, and light follows it."""
    expected = 6.0 * (1.0 - 1.0 / 1.6)
    assert motion("elements.plate.tilt_x") == pytest.approx([0.0, -expected], abs=1e-5)
    assert motion("elements.plate.tilt_y") == pytest.approx([expected, 0.0], abs=1e-5)


def test_a_plate_minds_neither_its_place_nor_its_distance(motion):
    for name in ("decenter_x", "decenter_y", "shift_z"):
        assert motion(f"elements.plate.{name}") == pytest.approx([0.0, 0.0], abs=1e-12)


def test_what_a_whole_tolerance_does_where_the_derivative_says_nothing(
    triplet, moved, traced_spots
):
    """On the axis RMS is stationary in a decentre: no first order, and yet it doubles the spot."""
    spots = gaussian_quadrature(triplet, [(0.0, 0.0)], [587.5618], 4, 12, symmetry=False)
    name, step = "elements.middle.decenter_y", 0.1
    found = sensitivities(
        linear_spots(triplet, spots, [name]), torch.tensor([step]).double(), spot_weights(None, 1)
    )
    assert abs(float(found.rms_jacobian)) < 1e-9
    exact = float(traced_spots(moved(triplet, {name: step}), spots)[1])
    assert exact > 2.0 * float(found.rms)
    assert found.rms_at_ends[:, 0, 0].tolist() == pytest.approx([exact, exact], rel=0.01)
    rise = float(found.increase(refocused=False))
    assert rise == pytest.approx(exact - float(found.rms), rel=0.02)


def test_refocusing_never_makes_a_lens_worse(triplet, spots):
    model = linear_spots(triplet, spots, NAMES)
    steps = torch.full((len(NAMES),), 1e-4, dtype=torch.float64)
    weights = spot_weights(None, spots.count)
    found = sensitivities(model, steps, weights)
    fixed = (found.rms_at_ends.square() @ weights, found.rms.square() @ weights)
    free = (found.rms_at_ends_refocused.square() @ weights, found.rms_refocused.square() @ weights)
    for with_focus, without in zip(free, fixed, strict=True):
        assert bool((with_focus <= without * (1 + 1e-12)).all())
    # And what the sensor's own place does is undone.
    assert float(found.increase()[-1]) == pytest.approx(0.0, abs=1e-12)


def test_rays_of_half_a_pupil_are_refused(triplet_without_elements):
    lens = triplet_without_elements
    spots = gaussian_quadrature(lens, [(0.0, 10.0)], [587.5618])
    with pytest.raises(InputError, match="symmetry=False"):
        linear_spots(lens, spots, ["thicknesses.1"])


@pytest.fixture
def triplet_without_elements(root):
    from dolens import load_lens

    return load_lens(root / "conf/lens/cooke_triplet.yaml")


def test_the_whole_pupil_has_the_spots_of_the_half(triplet_without_elements, traced_spots):
    """Symmetry saves rays; without it nothing but their number changes."""
    lens, fields = triplet_without_elements, [(0.0, 0.0), (0.0, 14.0)]
    half = gaussian_quadrature(lens, fields, [587.5618], 4, 12)
    whole = gaussian_quadrature(lens, fields, [587.5618], 4, 12, symmetry=False)
    assert not bool(whole.centred.any())
    assert len(whole.weight) == 2 * 4 * 12 and len(half.weight) == 4 + 4 * 6
    centroids, radii = traced_spots(lens, whole)
    assert centroids[:, 0].abs().max() < 1e-12
    hit = lens.trace(half.rays).position[half.spot == 1, :2].detach()
    weight = half.weight[half.spot == 1, None]
    centre = (weight * hit).sum(0) * torch.tensor([0.0, 1.0])
    rms = (weight * (hit - centre).square()).sum().sqrt()
    assert float(radii[1]) == pytest.approx(float(rms), rel=1e-9)
