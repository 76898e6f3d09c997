"""First-order optics against closed forms, reference data of 28 digits, and plain numbers."""

import math
from decimal import Decimal

import pytest
import torch
import yaml

from dolens import InputError, load_lens
from dolens.optics.paraxial import TwoRays, chief_ray_magnification, exit_pupil, through_surfaces
from dolens.optics.paraxial_rays import ParaxialNumbers
from dolens.prescriptions import lens_from_prescription

N = 1.5
GLASS = f"{N}/60"
D_LINE = 587.5618


def singlet(r1, r2, thickness, behind="air", semi_diameter=5.0):
    surface = {"type": "sphere", "semi_diameter": semi_diameter}
    return lens_from_prescription(
        {
            "surfaces": {
                "1": {**surface, "radius": r1, "thickness": thickness, "material": GLASS},
                "2": {**surface, "radius": r2, "material": behind},
            },
            "sensor": {"distance": 50.0},
        }
    )


def keplerian_telescope():
    """Thin lenses of 100 mm and 50 mm, 150 mm apart; the stop is the objective."""
    surface = {"type": "sphere", "semi_diameter": 5.0}
    rows = [(100.0, 0.0, GLASS), (-100.0, 150.0, "air"), (50.0, 0.0, GLASS), (-50.0, None, "air")]
    surfaces = {}
    for number, (radius, thickness, material) in enumerate(rows, 1):
        surfaces[str(number)] = {**surface, "radius": radius, "material": material}
        if thickness is not None:
            surfaces[str(number)]["thickness"] = thickness
    return lens_from_prescription({"surfaces": surfaces, "sensor": {"distance": 10.0}})


def close(found, expected, rel=1e-12, abs=1e-12):
    return float(found.detach()) == pytest.approx(expected, rel=rel, abs=abs)


def test_a_thick_lens_obeys_the_lensmaker_s_equation():
    r1, r2, d = 40.0, -60.0, 8.0
    found = singlet(r1, r2, d).first_order()
    power = (N - 1) * (1 / r1 - 1 / r2 + (N - 1) * d / (N * r1 * r2))
    f = 1 / power
    assert close(found.power, power)
    assert close(found.efl, f)
    assert close(found.bfd, f * (1 - (N - 1) * d / (N * r1)))
    assert close(found.ffd, -f * (1 + (N - 1) * d / (N * r2)))
    assert close(found.front_principal, -f * (N - 1) * d / (N * r2))
    assert close(found.rear_principal, d - f * (N - 1) * d / (N * r1))
    # In one and the same medium the nodal points are the principal points.
    assert close(found.front_nodal, float(found.front_principal.detach()))
    assert close(found.rear_nodal, float(found.rear_principal.detach()))


def test_both_principal_planes_of_a_ball_lens_go_through_its_centre():
    radius = 6.0
    found = singlet(radius, -radius, 2 * radius).first_order()
    assert close(found.efl, N * radius / (2 * (N - 1)))
    assert close(found.front_principal, radius)
    assert close(found.rear_principal, radius)


def test_one_refracting_surface_has_its_nodal_points_at_its_centre():
    radius = 30.0
    lens = lens_from_prescription(
        {
            "surfaces": {
                "1": {"type": "sphere", "radius": radius, "semi_diameter": 5.0, "material": GLASS}
            },
            "sensor": {"distance": 90.0},
        }
    )
    found = lens.first_order()
    assert close(found.efl, radius / (N - 1))
    assert close(found.focus, N * radius / (N - 1))
    assert close(found.ffd, -radius / (N - 1))
    assert close(found.front_principal, 0.0)
    assert close(found.rear_principal, 0.0)
    assert close(found.front_nodal, radius)
    assert close(found.rear_nodal, radius)


@pytest.mark.parametrize("name", ["cooke_triplet", "nikon", "large_fov_doublet", "asphere"])
def test_foci_principal_planes_and_reference_agree(reference, root, name):
    """In air a focus lies one EFL from its principal plane; at infinity F/# is the working one."""
    lens = load_lens(root / "conf" / "lens" / f"{name}.yaml")
    key = {"cooke_triplet": "triplet", "nikon": "nikon_original", "asphere": "asphere_initial"}
    for nm, expected in reference("first_order.json")["data"][key.get(name, "largefov")][
        "dfc"
    ].items():
        found = lens.first_order(float(nm))
        efl = float(expected["efl"])
        assert close(found.focus - found.rear_principal, efl, 1e-11)
        assert close(found.front_principal - found.ffd, efl, 1e-11)
        assert close(found.working_f_number, float(expected["fno_stop"]))
        assert close(found.image, float(expected["z_focus"]))
        assert close(found.magnification, 0.0)


@pytest.mark.parametrize("distance", [400.0, 200.0, 150.0, 60.0])
def test_a_thin_lens_at_finite_conjugates(distance):
    """1/s' = 1/f - 1/s, m = -s'/s, working F-number F(1 - m) with the stop at the lens."""
    lens = singlet(100.0, -100.0, 0.0)
    found = lens.first_order(D_LINE, distance)
    image = 1 / (1 / 100.0 - 1 / distance)
    assert close(found.image, image)
    assert close(found.magnification, -image / distance)
    assert close(found.working_f_number, 10.0 * (1 + image / distance))
    # The chief ray goes straight through the lens to the sensor.
    system, pupil = lens.system(), exit_pupil(lens.system(), D_LINE)
    assert close(chief_ray_magnification(system, D_LINE, distance), -50.0 / distance)
    assert close(pupil.z, 0.0) and close(pupil.diameter, 10.0)


def test_an_object_at_the_front_focus_is_imaged_at_infinity():
    lens = singlet(100.0, -100.0, 0.0)
    # In exact binary fractions: power 1/64, object 64 mm away.
    with torch.no_grad():
        lens.surfaces["1"].curvature.fill_(1 / 64)
        lens.surfaces["2"].curvature.fill_(-1 / 64)
    for distance in (64.0, torch.tensor(64.0, dtype=torch.float64)):
        found = lens.first_order(D_LINE, distance)
        assert math.isinf(float(found.image.detach()))
        assert math.isinf(float(found.magnification.detach()))
        assert math.isinf(float(found.working_f_number.detach()))


def test_object_distances_that_are_none():
    lens = singlet(100.0, -100.0, 4.0)
    far = lens.first_order(D_LINE)
    for infinite in (math.inf, torch.tensor(math.inf, dtype=torch.float64)):
        found = lens.first_order(D_LINE, infinite)
        assert float(found.image.detach()) == float(far.image.detach())
        rays = lens.paraxial_rays(5.0, D_LINE, infinite)
        assert torch.equal(rays.chief.height, lens.paraxial_rays(5.0).chief.height)
    for wrong in (0.0, -10.0, math.nan):
        with pytest.raises(InputError, match="object_distance must be positive"):
            lens.first_order(D_LINE, wrong)


# --- afocal and telecentric ----------------------------------------------------------------------
def test_a_plate_is_afocal_and_poisons_no_gradient():
    lens = singlet(math.inf, math.inf, 10.0)
    found = lens.first_order(D_LINE, 100.0)
    for value in (found.efl, found.bfd, found.focus, found.f_number, found.rear_principal):
        assert float(value.detach()) == math.inf
    assert float(found.power.detach()) == 0.0
    # A plate moves the image by d(1 - 1/n) and keeps its size.
    assert close(found.image, -100.0 + 10.0 * (1 - 1 / N))
    assert close(found.magnification, 1.0)
    everything = [value for value in vars(found).values() if isinstance(value, torch.Tensor)]
    everything += [*found.entrance_pupil, *found.exit_pupil]
    total = sum(torch.where(torch.isinf(value), 0.0 * found.power, value) for value in everything)
    for gradient in torch.autograd.grad(total, list(lens.parameters()), allow_unused=True):
        assert gradient is None or torch.isfinite(gradient)
    # Power is what moves: d(power)/dc₁ = n - 1.
    (slope,) = torch.autograd.grad(lens.first_order().power, lens.surfaces["1"].curvature)
    assert close(slope, N - 1)


def test_a_telescope_magnifies_all_objects_alike():
    lens = keplerian_telescope()
    assert abs(float(lens.first_order().power.detach())) < 1e-15
    for distance in (50.0, 1e3, 1e5):
        assert close(lens.first_order(D_LINE, distance).magnification, -0.5, 1e-9)
    marginal, chief, _ = lens.paraxial_rays(1.0)
    # The beam shrinks by f₂/f₁ and turns by as much more.
    assert close(marginal.height[-1] / marginal.height[0], -0.5)
    assert close(marginal.slope_after[-1], 0.0, abs=1e-16)
    assert close(chief.slope_after[-1] / chief.slope_before[0], -2.0)


def test_a_telecentric_lens_has_its_exit_pupil_at_infinity():
    surface = {"type": "sphere", "semi_diameter": 5.0}
    lens = lens_from_prescription(
        {
            "stop": 1,
            "surfaces": {
                "1": {"type": "aperture", "semi_diameter": 4.0, "thickness": 64.0,
                      "material": "air"},
                "2": {**surface, "radius": 64.0, "thickness": 0.0, "material": GLASS},
                "3": {**surface, "radius": -64.0, "material": "air"},
            },
            "sensor": {"distance": 64.0},
        }
    )  # fmt: skip
    found = lens.first_order()
    assert float(found.exit_pupil.z.detach()) == math.inf
    assert float(found.exit_pupil.diameter.detach()) == math.inf
    assert close(found.efl, 64.0)
    gradient = torch.autograd.grad(
        found.efl + torch.where(torch.isinf(found.exit_pupil.z), 0.0, found.exit_pupil.z),
        lens.thicknesses["1"],
        allow_unused=True,
    )[0]
    assert gradient is None or float(gradient) == 0.0
    assert close(lens.paraxial_rays(3.0).chief.slope_after[-1], 0.0)


@pytest.mark.parametrize("distance", [None, 700.0])
@pytest.mark.parametrize(
    "name", ["cooke_triplet", "nikon", "large_fov_doublet", "asphere", "wavefront_coding"]
)
@pytest.mark.parametrize("model", ["dfc", "do"])
def test_the_two_paraxial_rays(root, name, distance, model):
    lens = load_lens(root / "conf" / "lens" / f"{name}.yaml", torch.float64, model)
    found = lens.first_order(546.074, distance)
    marginal, chief, invariant = lens.paraxial_rays(3.0, 546.074, distance)
    stop = lens.stop - 1
    radius = lens.surfaces[str(lens.stop)].semi_diameter
    assert close(marginal.height[stop], radius)
    assert close(chief.height[stop], 0.0, abs=1e-13 * radius)
    # The chief ray heads for the entrance pupil, and seems to leave from the exit pupil.
    z = lens.system().vertices
    assert close(chief.height[0] + found.entrance_pupil.z * chief.slope_before[0], 0.0, abs=1e-13)
    last = found.exit_pupil.z - z[len(lens.surfaces) - 1]
    assert close(chief.height[-1] + last * chief.slope_after[-1], 0.0, abs=1e-11)
    # The marginal ray goes through the image of the axial point.
    to_image = found.image - z[len(lens.surfaces) - 1]
    assert close(marginal.height[-1] + to_image * marginal.slope_after[-1], 0.0, abs=1e-11)
    # The chief ray's height there is the image height.
    height = chief.height[-1] + to_image * chief.slope_after[-1]
    field = math.radians(3.0)
    n = float(lens.system().indices(546.074)[0])
    ideal = found.efl * n * math.tan(field) if distance is None else 3.0 * found.magnification
    assert close(height, float(ideal.detach()), 1e-11)
    # Lagrange's invariant is one number before and behind all surfaces: n'u'ȳ' at the image.
    indices = torch.tensor([float(i) for i in lens.system().indices(546.074)], dtype=torch.float64)
    for slope, other, index in (
        (marginal.slope_before, chief.slope_before, indices[:-1]),
        (marginal.slope_after, chief.slope_after, indices[1:]),
    ):
        everywhere = index * (slope * chief.height - other * marginal.height)
        assert (everywhere / invariant - 1.0).abs().max() < 1e-11
    assert close(indices[-1] * marginal.slope_after[-1] * height / invariant, 1.0, 1e-10)


@pytest.mark.parametrize("distance", [None, 300.0])
@pytest.mark.parametrize("name", ["cooke_triplet", "asphere", "wavefront_coding", "nikon"])
def test_gradients_of_every_first_order_quantity(root, name, distance):
    lens = load_lens(root / "conf" / "lens" / f"{name}.yaml")
    parameters = lens.variables(["surfaces.*.curvature", "thicknesses.*"])
    names = [
        "efl", "power", "ffd", "front_principal", "rear_principal", "front_nodal", "rear_nodal",
        "image", "magnification", "working_f_number",
    ]  # fmt: skip

    def quantities():
        found = lens.first_order(D_LINE, distance)
        rays = lens.paraxial_rays(10.0, D_LINE, distance)
        more = (rays.chief.height[0], rays.marginal.slope_after[-1], rays.lagrange_invariant)
        return torch.stack([*(getattr(found, name) for name in names), *more])

    exact = [
        torch.autograd.grad(value, parameters.values(), retain_graph=True, allow_unused=True)
        for value in quantities().unbind()
    ]
    for column, parameter in enumerate(parameters.values()):
        step = 1e-5 * max(abs(float(parameter.detach())), 1e-2)
        ends = []
        with torch.no_grad():
            kept = parameter.clone()
            for sign in (1, -1):
                parameter.copy_(kept + sign * step)
                ends.append(quantities())
            parameter.copy_(kept)
        slopes = (ends[0] - ends[1]) / (2 * step)
        # What rounding of the quantities leaves in the differences.
        rounding = 1e-14 * ends[0].abs() / step + 1e-8 * slopes.abs().max()
        for row, slope in enumerate(slopes.tolist()):
            gradient = exact[row][column]
            found = 0.0 if gradient is None else float(gradient)
            assert found == pytest.approx(slope, rel=1e-6, abs=float(rounding[row]))


def test_single_precision_stays_single(root):
    lens = load_lens(root / "conf" / "lens" / "cooke_triplet.yaml", torch.float32)
    found = lens.first_order(D_LINE, 500.0)
    rays = lens.paraxial_rays(5.0, D_LINE, 500.0)
    for value in (found.power, found.image, found.magnification, rays.chief.height):
        assert value.dtype == torch.float32


REFERENCE = {
    "asphere_initial": "asphere",
    "asphere_optimized": "asphere_optimized",
    "triplet": "cooke_triplet",
    "nikon_original": "nikon",
    "nikon_optimized": "nikon_optimized",
    "wfc_flat": "wavefront_coding",
    "wfc_cubic_1e-4": "wavefront_coding",  # a cubic plate has no first-order power
    "largefov": "large_fov_doublet",
}


def relative(found, expected):
    expected = float(expected)
    return abs(float(found.detach()) - expected) / max(abs(expected), 1e-300)


@pytest.mark.parametrize("model", ["dfc", "do", "paper"])
@pytest.mark.parametrize("lens_name", REFERENCE)
def test_every_first_order_property(reference, root, lens_name, model):
    entries = reference("first_order.json")["data"][lens_name][model]
    assert len(entries) == 5
    lens = load_lens(
        root / "conf" / "lens" / f"{REFERENCE[lens_name]}.yaml", torch.float64, index_model=model
    )
    for wavelength, expected in entries.items():
        found = lens.first_order(float(wavelength))
        assert lens.stop == expected["stop_surface"]
        assert relative(found.efl, expected["efl"]) < 1e-12
        assert relative(found.efl * found.image_index, expected["efl_image_space"]) < 1e-12
        assert relative(found.bfd, expected["bfd"]) < 1e-12
        assert relative(found.focus, expected["z_focus"]) < 1e-12
        assert relative(lens.system().vertices[-1], expected["z_sensor"]) < 1e-12
        if float(expected["ep_z"]) == 0.0:
            assert float(found.entrance_pupil.z) == 0.0
        else:
            assert relative(found.entrance_pupil.z, expected["ep_z"]) < 1e-12
        assert relative(found.entrance_pupil.diameter, expected["ep_diameter"]) < 1e-12
        assert relative(found.f_number, expected["fno_stop"]) < 1e-12


FILES = ["cooke_triplet", "double_gauss", "large_fov_doublet", "nikon", "wavefront_coding"]


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("wavelength", [486.1327, 656.2725])
def test_the_lenses_pupils_and_magnifications(root, name, wavelength):
    """`paraxial` is itself tested against closed forms and reference data."""
    prescription = yaml.safe_load((root / f"conf/lens/{name}.yaml").read_text())
    system = lens_from_prescription(prescription).double().system()
    numbers = ParaxialNumbers.of(system)
    z, diameter = numbers.exit_pupil(wavelength)
    wanted = exit_pupil(system, wavelength)
    assert z == pytest.approx(float(wanted.z.detach()), rel=1e-12)
    assert diameter == pytest.approx(float(wanted.diameter.detach()), rel=1e-12)
    for depth in (500.0, 1e6):
        found = numbers.chief_ray_magnification(wavelength, depth)
        assert found == pytest.approx(
            float(chief_ray_magnification(system, wavelength, depth).detach()), rel=1e-11
        )


def test_a_stop_at_the_front_focus_is_seen_at_infinity():
    """Telecentric: D = 1 - t/f is nothing at t = f, and a stop there magnifies as the lens does."""
    lens = ParaxialNumbers(
        (0.0, 0.02, 0.0), (100.0, 0.0), 120.0, (_Air(), _Air(), _Glass(), _Air()), 1, 5.0,
        (1.0, 1.0, 1.0, 1.0),
    )  # fmt: skip
    assert lens.exit_pupil(550.0) == (math.inf, math.inf)
    # Chief rays through the front focus leave parallel to the axis: -f/(depth) for f = 100.
    assert lens.chief_ray_magnification(550.0, 400.0) == pytest.approx(-100.0 / 400.0)


@pytest.mark.parametrize("name", FILES)
def test_paraxial_rays_are_those_of_28_digits(root, name):
    """The same recurrence in decimals, from the same rays: rounding leaves parts in 10¹⁴."""
    prescription = yaml.safe_load((root / f"conf/lens/{name}.yaml").read_text())
    lens = lens_from_prescription(prescription, torch.float64).requires_grad_(False)
    system = lens.system()
    rays = lens.paraxial_rays(5.0, 587.5618)
    curvatures = [s.shape.paraxial_curvature(s.parameters) for s in system.surfaces]
    c, t, n = (
        [Decimal(float(v)) for v in values]
        for values in (curvatures, system.thicknesses, system.indices(587.5618))
    )
    y, u = (
        [Decimal(float(getattr(ray, what)[0])) for ray in rays[:2]]
        for what in ("height", "slope_before")
    )
    exact = list(through_surfaces(TwoRays(*y, n[0] * u[0], n[0] * u[1]), c, t, n))
    for ray, height, slope in ((rays.marginal, 0, 2), (rays.chief, 1, 3)):
        for found, wanted in (
            (ray.height, [step[height] for step in exact]),
            (ray.slope_after, [step[slope] / n[i + 1] for i, step in enumerate(exact)]),
        ):
            wanted = torch.tensor([float(w) for w in wanted], dtype=torch.float64)
            error = found - wanted
            assert float(error.abs().max()) < 3e-14 * float(found.abs().max())


class _Air:
    def index(self, wavelength):
        return 1.0


class _Glass:
    def index(self, wavelength):
        return torch.tensor(1.5, dtype=torch.float64)
