"""Merit functions of spots: their rays, their residuals, and derivatives against differences."""

import math

import numpy as np
import pytest
import torch

from dolens import Rays, load_lens
from dolens.analysis.pupil_quadrature import (
    gaussian_quadrature,
    square_grid,
    with_chief_rays,
)
from dolens.errors import InputError
from dolens.optimize import DampedLeastSquares, DesignVariables, MeritSettings
from dolens.optimize.image_quality import WavefrontResiduals, without_edges
from dolens.optimize.linear_least_squares import damped_step
from dolens.optimize.merit_settings import LOSSES
from dolens.optimize.ray_intercept_quality import RayInterceptResiduals

LINES = (656.2725, 587.5618, 486.1327)


@pytest.fixture
def triplet(root):
    return load_lens(root / "conf/lens/cooke_triplet.yaml")


@pytest.fixture
def nikon(root):
    return load_lens(root / "conf/lens/nikon.yaml", index_model="do")


def rms_radii(lens, spots):
    """As the definition says, spot by spot."""
    hit = lens.trace(spots.rays)
    assert bool(hit.valid.all())
    radii = []
    for spot in range(spots.count):
        mine = spots.spot == spot
        points, weight = hit.position[mine, :2].detach(), spots.weight[mine]
        assert float(weight.sum()) == pytest.approx(1.0, rel=1e-12)
        mean = (weight[:, None] * points).sum(0)
        mean = torch.where(spots.centred[spot], 0.0, mean)
        radii.append(math.sqrt(float((weight * (points - mean).square().sum(-1)).sum())))
    return np.array(radii)


def test_the_square_grid_gives_the_reference_s_spots(triplet, reference):
    """RMS radii of tests/reference: 31×31 rays through the first vertex plane, 28 digits."""
    entries = reference("rms_triplet__dfc.json")["entries"]
    for entry in entries:
        spots = square_grid(
            triplet, [(float(entry["view_deg"]), 0.0)], [float(entry["wavelength"])]
        )
        assert len(spots.weight) == entry["n_valid"] and spots.launched == 961
        assert rms_radii(triplet, spots)[0] == pytest.approx(float(entry["rms"]), rel=1e-9)


def test_the_published_nikon_start(nikon):
    """Table II without its aspheres: 28.06 µm on average over twelve spots (reference/README)."""
    with torch.no_grad():
        aspheres = ["surfaces.1[78].a*", "surfaces.1[78].conic"]
        for parameter in nikon.variables(aspheres).values():
            parameter.zero_()
    spots = square_grid(nikon, nikon.fields.points, nikon.wavelengths)
    assert spots.launched == 12 * 961 and len(spots.weight) < 0.15 * spots.launched
    assert 1e3 * rms_radii(nikon, spots).mean() == pytest.approx(28.06, abs=0.005)


@pytest.mark.parametrize("field", [(0.0, 0.0), (0.0, 10.0), (0.0, 20.0), (7.0, 14.0)])
def test_quadrature_agrees_with_a_fine_sampling(triplet, field):
    """Few rays by Gauss give what many on a fine polar grid give, whatever clips the light."""
    few = rms_radii(triplet, gaussian_quadrature(triplet, [field], [587.5618], 6, 24))[0]
    many = rms_radii(triplet, gaussian_quadrature(triplet, [field], [587.5618], 40, 160))[0]
    assert few == pytest.approx(many, rel=3e-3)


def test_symmetry_saves_rays_and_nothing_else(triplet):
    """Half of the arms for a field along y, one for the axis: the radii stay."""
    assert triplet.system().rotationally_symmetric
    fields = [(0.0, 0.0), (0.0, 12.0)]
    spots = gaussian_quadrature(triplet, fields, LINES, 5, 16)
    assert len(spots.weight) == 3 * (5 + 5 * 8)
    assert spots.centred.tolist() == [[True, True]] * 3 + [[True, False]] * 3
    turned = gaussian_quadrature(triplet, [(12.0, 0.0)], LINES, 5, 16)
    assert len(turned.weight) == 3 * 5 * 16
    assert rms_radii(triplet, spots)[3:] == pytest.approx(rms_radii(triplet, turned), rel=1e-6)


def test_a_field_without_light_is_an_error_that_names_it(triplet):
    with pytest.raises(InputError, match=r"field \(0.0, 80.0\)"):
        gaussian_quadrature(triplet, [(0.0, 80.0)], LINES)
    with pytest.raises(InputError, match=r"field \(0.0, 80.0\)"):
        square_grid(triplet, [(0.0, 80.0)], LINES, half_width=5.0)


def merit_of(lens, variables=None, **settings):
    variables = DesignVariables(lens, variables or {"surfaces.*.curvature": None})
    options = {"fields": [(0.0, 0.0), (0.0, 12.0)], "wavelengths": LINES, **settings}
    options.setdefault("sampling_options", {"rings": 3, "arms": 6})
    return MeritSettings(**options).build(lens, variables), variables


def gradient_by_differences(merit, scaled, step=1e-6):
    start, gradient = scaled.detach().clone(), []
    for k in range(len(start)):
        ends = []
        for sign in (1.0, -1.0):
            with torch.no_grad():
                scaled.copy_(start)
                scaled[k] += sign * step
            ends.append(merit().sum_of_squares())
        gradient.append((ends[0] - ends[1]) / (4.0 * step))
    with torch.no_grad():
        scaled.copy_(start)
    return torch.tensor(gradient, dtype=torch.float64)


OPERANDS = [
    {"kind": "efl", "target": 49.0, "weight": 30.0},
    {"kind": "bfd", "min": 50.0, "weight": 2.0},
    {"kind": "f_number", "max": 4.0, "weight": 100.0},
    {"kind": "total_track", "target": 55.0},
    {"kind": "centre_thickness", "min": 2.0, "weight": 5.0},
    {"kind": "air_gap", "max": 5.0},
    {"kind": "edge_thickness", "min": 3.0},
    {"kind": "edge_air_gap", "min": 3.0},
    {"kind": "chief_ray_angle", "max": 10.0, "field": [0, 18]},
    {"kind": "distortion", "target": 0.0, "field": [0, 18], "weight": 20.0},
]
CASES = {
    "centroid": {},
    "chief ray": {"reference": "chief"},
    "grid": {"sampling": "square_grid", "sampling_options": {"count": 15}},
    "weights": {"field_weights": [1.0, 3.0], "wavelength_weights": [1.0, 2.0, 0.5]},
    "operands": {"operands": OPERANDS},
    "polychromatic reference": {"reference_spectrum": "polychromatic"},
    "chief ray of the field": {"reference_spectrum": "polychromatic", "reference": "chief"},
    "wavefront": {"quality": "wavefront"},
    "wavefront about the chief ray": {"quality": "wavefront", "reference": "chief"},
    "modulation": {"quality": "modulation", "quality_options": {"frequencies": [20.0, 50.0]}},
    "encircled energy": {"quality": "encircled_energy", "quality_options": {"radius_um": 15.0}},
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize(
    "variables",
    [
        {"surfaces.*.curvature": {"scale": 0.01}, "thicknesses.*": None, "sensor_distance": None},
        {
            "surfaces.*.curvature": {"scale": 0.01},
            "surfaces.5.curvature": {"pickup": "surfaces.1.curvature", "factor": -0.5},
            "surfaces.6.curvature": {"solve": "efl", "target": 50.0},
            "sensor_distance": {"solve": "paraxial_focus", "defocus": -0.1},
        },
        {"surfaces.[1-4].curvature": {"scale": 0.01}, "sensor_distance": {"solve": "best_focus"}},
    ],
    ids=["free", "pickup and solves", "best focus"],
)
def test_the_gradient_is_that_of_differences(triplet, case, variables):
    """Of everything together; the Jacobian's model must have it too."""
    settings = dict(CASES[case])
    focused = "best_focus" in str(variables)
    is_loss = settings.get("quality") in LOSSES
    if is_loss and focused:
        with pytest.raises(InputError, match="'best_focus' goes with the merit's spots"):
            merit_of(triplet, variables, **settings)
        return
    merit, design = merit_of(triplet, variables, **settings)
    value = merit()
    model = value.linear_model()
    if not is_loss:
        assert model.sum_of_squares == pytest.approx(value.sum_of_squares(), rel=1e-9)
    # Paths of 70 mm are rounded to some 1e-14 mm, which small differences of waves would show.
    step = 1e-4 if settings.get("quality") == "wavefront" else 1e-6
    expected = gradient_by_differences(merit, design.scaled, step)
    close = {"rtol": 2e-5, "atol": 1e-6 * float(expected.abs().max())}
    assert torch.allclose(model.gradient, expected, **close)
    if focused and case == "operands":
        return  # a plain gradient does not know how the total track follows the focus
    # The same for optimizers that take a gradient.
    loss = merit().loss()
    assert loss.item() == pytest.approx(value.sum_of_squares(), rel=1e-9)
    (gradient,) = torch.autograd.grad(loss, design.scaled)
    assert torch.allclose(0.5 * gradient, expected, **close)


def test_the_squared_radius_as_a_loss_takes_the_classical_step(triplet):
    """With L the squared spot radius, its residuals are the classical ones to rounding."""
    grid = {"sampling": "square_grid", "sampling_options": {"count": 15}}
    classical, _ = merit_of(triplet, **grid)
    as_loss, _ = merit_of(triplet, quality="spot_size", **grid)
    here, there = classical(), as_loss()
    assert there.sum_of_squares() == pytest.approx(here.sum_of_squares(), rel=1e-12)
    models = here.linear_model(), there.linear_model()
    damping = 1e-3 * models[0].column_norms.square()
    first, second = (damped_step(model, damping) for model in models)
    assert torch.allclose(first, second, rtol=1e-9, atol=0.0)


def test_a_wavefront_s_defocus(root):
    """A defocus δz adds cos θ·δz to the path of a ray at θ, on the axis, by closed form."""
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml")
    spots = gaussian_quadrature(lens, [(0.0, 0.0)], [587.5618], 8, 8, symmetry=False)
    quality = WavefrontResiduals(spots, torch.ones(1).double())
    slopes = quality.slopes(quality.values(lens))
    rms = float((quality.ray_weights[:, None] * slopes.square()).sum().sqrt())
    hit = lens.trace(spots.rays)
    # Slope of the wavefront's edge, from the marginal rays themselves.
    cosine = hit.direction[:, 2].detach()
    expected = float((quality.ray_weights * (cosine - cosine @ quality.ray_weights) ** 2).sum())
    assert rms == pytest.approx(expected**0.5 / 587.5618e-6, rel=1e-6)
    # And by moving the sensor.
    ends = []
    for shift in (-1e-4, 1e-4):
        moved = load_lens(root / "conf/lens/cooke_triplet.yaml")
        with torch.no_grad():
            moved.sensor_distance += shift
        ends.append(quality.values(moved).deviations)
    assert torch.allclose((ends[1] - ends[0]) / 2e-4, slopes, rtol=1e-6, atol=1e-6)


def test_the_jacobian_is_that_of_forward_mode(triplet):
    """JᵀJ of the kernels' sweeps against jacfwd through the reference."""
    merit, design = merit_of(triplet)
    model = merit().linear_model()
    spots, lens = merit.quality.spots, merit.lens
    names = list(design())

    def residuals(theta):
        values = dict(zip(names, theta.unbind(), strict=True))
        from dolens.optics.ray_tracing import trace_rays

        hit = trace_rays(lens.system(values).traced_by("reference"), spots.rays)
        points = hit.position[:, :2]
        means = torch.zeros(spots.count, 2, dtype=points.dtype)
        means = means.index_add(0, spots.spot, spots.weight[:, None] * points)
        means = torch.where(spots.centred, 0.0, means)
        root = (spots.weight * merit.quality.weights[spots.spot]).sqrt()
        return 1e3 * (root[:, None] * (points - means[spots.spot])).reshape(-1)

    theta = torch.stack(list(design().values())).detach()
    jacobian = torch.func.jacfwd(residuals)(theta)
    scale = jacobian.square().sum(0).sqrt()
    found = model.root.T @ model.root / scale / scale[:, None]
    expected = jacobian.T @ jacobian / scale / scale[:, None]
    assert torch.allclose(found, expected, atol=1e-10)


def test_sums_serve_where_rows_would_not_fit(triplet, monkeypatch):
    from dolens.optimize import ray_intercept_quality

    merit, _ = merit_of(triplet, sampling="square_grid", sampling_options={"count": 21})
    rows = merit().linear_model()
    monkeypatch.setattr(ray_intercept_quality, "MOST_STORED", 0)
    sums = merit().linear_model()
    assert torch.allclose(sums.gradient, rows.gradient, rtol=1e-8)
    assert torch.allclose(sums.root.T @ sums.root, rows.root.T @ rows.root, rtol=1e-8)


def test_opened_apertures_clip_nothing_and_change_nothing_else(triplet):
    opened = without_edges(triplet)
    position = torch.tensor([[0.0, 0.0, -5.0], [0.0, 3.0, -5.0], [0.0, 8.0, -5.0]]).double()
    rays = Rays(position, torch.tensor([0.0, 0.0, 1.0]).double().expand(3, 3), 587.5618)
    for backend in ("reference", "cpu"):
        triplet.backend = opened.backend = backend
        here, there = triplet.trace(rays), opened.trace(rays)
        assert here.valid.tolist() == [True, True, False]
        assert there.valid.tolist() == [True, True, True]
        assert torch.equal(here.position, there.position)
    assert float(opened.first_order().f_number) == float(triplet.first_order().f_number)


def test_chief_rays_weigh_nothing(triplet):
    spots = gaussian_quadrature(triplet, [(0.0, 0.0), (0.0, 15.0)], LINES, 3, 6)
    with_chief = with_chief_rays(triplet, spots)
    assert with_chief.weight[with_chief.chief].tolist() == [0.0] * 6
    assert rms_radii(triplet, with_chief) == pytest.approx(rms_radii(triplet, spots), rel=1e-12)
    chief = RayInterceptResiduals(with_chief, torch.ones(6).double() / 6, "chief").values(triplet)
    centroid = RayInterceptResiduals(spots, torch.ones(6).double() / 6).values(triplet)
    assert bool((chief.mean_squares >= centroid.mean_squares).all())
    with pytest.raises(InputError, match="hold no chief rays"):
        RayInterceptResiduals(spots, torch.ones(6).double() / 6, "chief")


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"kind": "efg", "target": 1.0}, "kind: 'efg' is unknown"),
        ({"kind": "efl"}, "give a target, or limits"),
        ({"kind": "efl", "target": 1.0, "min": 0.5}, "give a target, or limits"),
        ({"kind": "efl", "min": 2.0, "max": 1.0}, "min exceeds max"),
        ({"kind": "efl", "target": 50.0, "weight": 0.0}, "weight must be positive"),
        ({"kind": "efl", "target": "long"}, "must be a number"),
        ({"kind": "air_gap", "min": 0.1, "gaps": [9]}, "gaps 1 to 5, not 9"),
        ({"kind": "efl", "target": 50.0, "wieght": 2.0}, "unknown key 'wieght'"),
    ],
)
def test_bad_operands_are_refused(triplet, settings, said):
    with pytest.raises(InputError, match=said):
        merit_of(triplet, operands=[settings])


@pytest.mark.parametrize(
    ("variables", "said"),
    [
        ({"surfaces.1.curvature": {"pickup": "surfaces.9.curvature"}}, "no parameter"),
        ({"surfaces.1.curvature": {"pickup": "surfaces.1.curvature"}}, "one other parameter"),
        ({"surfaces.1.curvature": {"solve": "focus"}}, "solve: 'focus' is unknown"),
        ({"surfaces.1.curvature": {"solve": "best_focus"}}, "moves sensor_distance only"),
        ({"thicknesses.1": {"solve": "efl", "target": 3.0}}, "moves a curvature"),
        ({"surfaces.1.curvature": {"solve": "efl"}}, "to a target"),
        ({"surfaces.1.curvature": {"solve": "efl", "targt": 3.0}}, "unknown key 'targt'"),
    ],
)
def test_bad_pickups_and_solves_are_refused(triplet, variables, said):
    with pytest.raises(InputError, match=said):
        DesignVariables(triplet, variables)


@pytest.mark.parametrize(
    "options, words",
    [
        ({"operands": [{"kind": "efl", "target": 50.0, "weight": 1e300}]}, "weight must be"),
        (
            {"operands": [{"kind": "distortion", "target": 0.0, "field": [0.0, 1e9]}]},
            r"operand 'distortion': field: \[0.0, 1000000000.0\] degrees; allowed",
        ),
        ({"fields": [[0.0, 1e9]]}, r"merit.fields: \[0.0, 1000000000.0\] degrees; allowed"),
        ({"field_weights": [1e300, 1.0]}, "merit.field_weights: give 2 numbers from 0 to 1e"),
        ({"field_weights": ["a", "b"]}, r"merit.field_weights: \['a', 'b'\]; allowed: a list"),
        ({"fields": 3.0}, "merit.fields: 3.0; allowed: a list"),
        ({"fields": [3.0]}, r"merit.fields: \[3.0\]; allowed: a list"),
        ({"wavelengths": ["a"]}, r"merit.wavelengths: \['a'\]; allowed: a list"),
        ({"max_vignetting": "a"}, "merit.max_vignetting: 'a'; allowed: a number"),
        ({"operands": 3}, "merit.operands: 3; allowed: a list"),
        ({"operands": [{"kind": "distortion", "target": 0.0, "field": 1e9}]}, "is x and y, not 1"),
        ({"operands": [{"kind": "efl", "target": math.inf}]}, "'efl': target must be a number"),
        ({"operands": [{"kind": "efl", "min": math.nan}]}, "'efl': min must be a number, not nan"),
        ({"sampling_options": {"rings": 10**9}}, "rings and arms: 1000000000 and 12; allowed: 2"),
        ({"sampling": "square_grid", "sampling_options": {"count": 10**6}}, "count: 1000000; all"),
    ],
)
def test_numbers_out_of_all_proportion_are_named(triplet, options, words):
    with pytest.raises(InputError, match=words):
        merit_of(triplet, **options)


def test_a_target_beyond_all_numbers_has_no_merit(triplet):
    merit, variables = merit_of(triplet, operands=[{"kind": "efl", "target": 1e300}])
    with pytest.raises(InputError, match="cannot begin: the merit is inf"):
        DampedLeastSquares([variables.scaled]).step(merit)


def test_operands_that_no_variable_moves_are_named(triplet):
    """A thickness does not follow from a curvature."""
    merit, variables = merit_of(
        triplet, quality=None, operands=[{"kind": "total_track", "target": 60.0}]
    )
    with pytest.raises(InputError, match=r"^merit.operands: no variable moves total_track$"):
        DampedLeastSquares([variables.scaled]).step(merit)
