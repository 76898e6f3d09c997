"""Uniaxial crystals: ordinary and extraordinary rays, beside closed forms, Fermat and Maxwell."""

import math

import numpy as np
import pytest
import torch

import dolens
from dolens.errors import InputError
from dolens.optics.crystals import Crystal, refract_at_crystal
from dolens.optics.materials import index_model, parse_material
from dolens.optics.paraxial import exit_pupil, first_order
from dolens.optics.paraxial_rays import ParaxialNumbers
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Status
from dolens.optics.seidel import seidel
from dolens.prescriptions.build import lens_from_prescription, prescription_of

F64 = torch.float64
# Calcite at the D lines, as textbooks print it (Hecht, Optics, table 8.1).
N_O, N_E = 1.6584, 1.4864
CALCITE = f"{N_O} and {N_E}"


def lens_of(*rows, distance=10.0, elements=None, dtype=F64):
    """Return a lens of rows (material, thickness, radius or further keys)."""
    surfaces = {}
    for number, (material, thickness, *more) in enumerate(rows, 1):
        row = {"radius": math.inf, "semi_diameter": 20.0, "material": material}
        row.update(more[0] if more else {})
        if number < len(rows):
            row["thickness"] = thickness
        surfaces[number] = row
    prescription = {
        "name": "crystal",
        "stop": 1,
        "surfaces": surfaces,
        "sensor": {"distance": distance, "diameter": 40.0},
    }
    if elements:
        prescription["elements"] = elements
    return lens_from_prescription(prescription, dtype=dtype)


def plate(material, thickness=10.0):
    """Return a plane-parallel plate in air."""
    return lens_of((material, thickness), ("air", None))


def ray(slope_x=0.0, slope_y=0.0, y=0.0, dtype=F64):
    """Return a ray through (0, y, -1)."""
    d = torch.tensor([slope_x, slope_y, 1.0], dtype=dtype)
    return dolens.Rays(torch.tensor([0.0, y, -1.0], dtype=dtype), d / d.norm(), 589.3)


def test_calcite_at_45_degrees_walks_off_by_6_2_degrees():
    """tan ρ = (n_o² - n_e²)·tan θ/(n_e² + n_o²·tan² θ) of the wave along z, away from the axis."""
    path = plate(f"{CALCITE} extraordinary 0 1 1").trace(ray(), record=True)
    tangent = (N_O**2 - N_E**2) / (N_E**2 + N_O**2)
    assert float(path.points[1, 1]) == pytest.approx(-10.0 * tangent, rel=1e-14)
    assert math.degrees(math.atan(tangent)) == pytest.approx(6.22, abs=0.01)
    # Behind the plate it goes on as it came, and its path is that of the wave along z.
    torch.testing.assert_close(path.direction, torch.tensor([0.0, 0.0, 1.0], dtype=F64))
    index = math.sqrt(2.0) / math.sqrt(N_O**-2 + N_E**-2)
    assert float(path.path_length) == pytest.approx(11.0 + 10.0 * index, rel=1e-14)


def test_an_axis_across_the_plane_of_incidence_makes_an_isotropic_medium():
    """An extraordinary ray across its axis sees n_e, and an ordinary one n_o in every direction."""
    for material, index in (
        (f"{CALCITE} extraordinary 1 0 0", N_E),
        (f"{CALCITE} ordinary 1 2 3", N_O),
    ):
        crystal, glass = plate(material).trace(ray(0.0, 0.5)), plate(index).trace(ray(0.0, 0.5))
        torch.testing.assert_close(crystal.position, glass.position, rtol=1e-14, atol=1e-14)
        torch.testing.assert_close(crystal.path_length, glass.path_length, rtol=1e-14, atol=0.0)


def test_equal_indices_make_an_isotropic_medium():
    crystal = plate("1.6 and 1.6 extraordinary 1 2 -1").trace(ray(0.3, -0.4))
    glass = plate("1.6").trace(ray(0.3, -0.4))
    torch.testing.assert_close(crystal.position, glass.position, rtol=1e-14, atol=1e-14)


def test_fields_of_an_extraordinary_ray_obey_maxwells_equations():
    """k × (k × E) + ε·E = 0, and the ray is along E × (k × E)."""
    generator = np.random.default_rng(1)
    for _ in range(20):
        a, s = (v / np.linalg.norm(v) for v in generator.normal(size=(2, 3)))
        crystal = Crystal(N_O, N_E, tuple(a))
        k = np.array([float(c) for c in crystal.wave_vector(tuple(torch.from_numpy(s)))])
        permittivity = N_O**2 * np.eye(3) + (N_E**2 - N_O**2) * np.outer(a, a)
        cross = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
        _, sizes, rows = np.linalg.svd(cross @ cross + permittivity)
        assert sizes[-1] < 1e-14
        field = rows[-1]
        energy = np.cross(field, np.cross(k, field))
        assert np.allclose(energy / np.linalg.norm(energy), s, atol=1e-13)
        assert float(crystal.ray_index(tuple(torch.from_numpy(s)))) == pytest.approx(k @ s)


def test_the_way_through_tilted_curved_faces_is_stationary():
    """Fermat: to first order no other way between two points of the ray is shorter.

    The way is summed here with n(S)² = n_e² + (n_o² - n_e²)·(a·S)² alone.
    """
    lens = lens_of(
        (f"{CALCITE} extraordinary 0.3 -0.5 0.8", 6.0, {"radius": 31.0}),
        (f"{CALCITE} extraordinary 0.9 0.1 0.2", 5.0, {"radius": -45.0}),
        ("air", None, {"radius": -60.0}),
        elements={"second": {"surfaces": [2, 3], "tilt_x": 8.0, "tilt_y": -5.0, "tilt_z": 30.0}},
    )
    rays = ray(0.15, -0.2, y=3.0)
    path = lens.trace(rays, record=True)
    assert bool(path.valid)
    system = lens.system()
    axes = [np.array([float(c) for c in system.optic_axis(place)]) for place in (1, 2)]
    places = [system.place(number) for number in (1, 2, 3)]
    radii = (31.0, -45.0, -60.0)
    start, end = rays.position.numpy(), path.position.detach().numpy()

    def point(i, x, y):
        z = (x * x + y * y) / radii[i] / (1.0 + math.sqrt(1.0 - (x * x + y * y) / radii[i] ** 2))
        turn, origin = (v.numpy() for v in places[i])
        return origin + turn @ np.array([x, y, z])

    def length(values):
        points = [start, *(point(i, *values[2 * i : 2 * i + 2]) for i in range(3)), end]
        steps = np.diff(points, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        along = [0.0, *(a @ s / n for a, s, n in zip(axes, steps[1:3], lengths[1:3], strict=True))]
        total = lengths[0] + lengths[3]
        for k in (1, 2):
            total += lengths[k] * math.sqrt(N_E**2 + (N_O**2 - N_E**2) * along[k] ** 2)
        return total

    found = []
    for i in range(3):
        turn, origin = (v.numpy() for v in places[i])
        found += [*(turn.T @ (path.points[i].detach().numpy() - origin))[:2]]
    values = np.array(found)
    assert length(values) == pytest.approx(float(path.path_length), rel=1e-14)
    for step in 1e-4 * np.eye(6):
        slope = (length(values + step) - length(values - step)) / 2e-4
        assert abs(slope) < 1e-9


def test_light_that_goes_back_takes_the_same_way():
    lens = lens_of(
        (f"{CALCITE} extraordinary 0.3 -0.5 0.8", 6.0, {"radius": 31.0}),
        ("air", None, {"radius": -60.0}),
    )
    rays = ray(0.15, -0.2, y=3.0)
    there = lens.trace(rays, record=True)
    back = lens.sensor_to_scene(
        dolens.Rays(there.position.detach(), -there.direction.detach(), 589.3), record=True
    )
    torch.testing.assert_close(back.direction, -rays.direction, rtol=0.0, atol=1e-14)
    torch.testing.assert_close(back.points.flip(0), there.points, rtol=0.0, atol=1e-12)


def test_a_savart_plate_shears_equally_in_x_and_y():
    """Two plates of 45°, crossed: each polarisation is extraordinary in one of them."""
    for first, second, moved in (
        ("extraordinary", "ordinary", 1),
        ("ordinary", "extraordinary", 0),
    ):
        lens = lens_of(
            (f"{CALCITE} {first} 0 1 1", 10.0),
            (f"{CALCITE} {second} 1 0 1", 10.0),
            ("air", None),
        )
        landed = lens.trace(ray()).position.detach()
        shear = 10.0 * (N_O**2 - N_E**2) / (N_O**2 + N_E**2)
        assert float(landed[moved]) == pytest.approx(-shear, rel=1e-13)
        assert abs(float(landed[1 - moved])) < 1e-13


def test_a_wollaston_prism_splits_as_snells_law_says():
    """Where both axes are across the rays' plane or along the wedge, each ray sees n_o or n_e."""
    wedge = 20.0

    def angle(first, second):
        lens = lens_of(
            (f"{CALCITE} {first} 0 1 0", 10.0),
            (f"{CALCITE} {second} 1 0 0", 10.0),
            ("air", None),
            elements={"wedge": {"surfaces": [2, 2], "tilt_x": wedge}},
        )
        return math.atan2(*lens.trace(ray()).direction.detach()[1:].tolist())

    def closed(n1, n2):
        a = math.radians(wedge)
        inside = math.asin(n1 / n2 * math.sin(a)) - a
        return math.asin(n2 * math.sin(inside))

    # Along z, light polarised along x sees n_o first (axis y) and n_e then (axis x).
    up, down = angle("ordinary", "extraordinary"), angle("extraordinary", "ordinary")
    assert up == pytest.approx(closed(N_O, N_E), rel=1e-12)
    assert down == pytest.approx(closed(N_E, N_O), rel=1e-12)
    # 2·(n_o - n_e)·tan(wedge) to first order.
    assert abs(up - down) == pytest.approx(
        2.0 * (N_O - N_E) * math.tan(math.radians(wedge)), rel=0.02
    )


def test_a_rochon_prism_leaves_the_ordinary_ray_alone():
    def direction(second):
        lens = lens_of(
            (f"{CALCITE} ordinary 0 0 1", 10.0),
            (f"{CALCITE} {second} 1 0 0", 10.0),
            ("air", None),
            elements={"wedge": {"surfaces": [2, 2], "tilt_x": 20.0}},
        )
        return lens.trace(ray()).direction.detach()

    assert float(direction("ordinary")[1]) == pytest.approx(0.0, abs=1e-15)
    assert abs(float(direction("extraordinary")[1])) > 0.05


def test_a_glan_foucault_prism_reflects_the_ordinary_ray_alone():
    """At 38.5° in calcite the ordinary ray is beyond its critical angle of 37.1° (Hecht, 8.4.3)."""
    for name, ends in (("ordinary", Status.TIR), ("extraordinary", Status.OK)):
        lens = lens_of(
            (f"{CALCITE} {name} 1 0 0", 10.0),
            ("air", 0.01),
            (f"{CALCITE} {name} 1 0 0", 10.0),
            ("air", None),
            elements={"gap": {"surfaces": [2, 3], "tilt_x": 38.5}},
        )
        assert int(lens.trace(ray()).status) == ends


def test_an_extraordinary_ray_is_reflected_to_one():
    """A mirror in a crystal keeps the wave vector along it; Fermat holds on the way back, too."""
    lens = lens_of(
        (f"{CALCITE} extraordinary 0 1 1", 10.0),
        ("mirror", -10.0),
        ("air", None),
        distance=-5.0,
    )
    landed = lens.trace(ray())
    # At normal incidence the way back is the way there: walk-off undoes itself.
    assert bool(landed.valid)
    assert float(landed.position[1].detach()) == pytest.approx(0.0, abs=1e-13)
    torch.testing.assert_close(landed.direction.detach(), torch.tensor([0.0, 0.0, -1.0], dtype=F64))


def test_a_lens_is_copied_for_every_choice_of_rays():
    """All light of a Savart plate goes by two of the four ways, and none is lost."""
    lens = lens_of(
        (f"{CALCITE} ordinary 0 1 1", 10.0), (f"{CALCITE} ordinary 1 0 1", 10.0), ("air", None)
    )
    ways = lens.crystal_rays()
    shares = {
        name: float(own.trace_polarised(ray()).transmission.detach()) for name, own in ways.items()
    }
    assert shares == pytest.approx({"oo": 0.0, "oe": 0.5, "eo": 0.5, "ee": 0.0}, abs=1e-14)
    assert ways["oe"].materials[2].name == f"{N_O} and {N_E} extraordinary 1 0 1"
    with pytest.raises(InputError, match="has 0 crystals"):
        dolens.load_lens("cooke_triplet").crystal_rays()


def test_a_crystals_axis_turns_with_its_surface():
    """A coordinate break turns the axis of a plate behind it, and the plate's rays."""
    turned = lens_from_prescription(
        {
            "name": "turned",
            "stop": 2,
            "surfaces": {
                1: {"type": "coordinate_break", "tilt_z": 90.0, "thickness": 0.0},
                2: {
                    "radius": math.inf,
                    "semi_diameter": 20.0,
                    "material": f"{CALCITE} extraordinary 0 1 1",
                    "thickness": 10.0,
                },
                3: {"radius": math.inf, "semi_diameter": 20.0, "material": "air"},
            },
            "sensor": {"distance": 10.0, "diameter": 40.0},
        },
        dtype=F64,
    )
    landed = turned.trace(ray(), record=True).points[-1].detach()
    straight = plate(f"{CALCITE} extraordinary 0 1 1").trace(ray(), record=True).points[-1].detach()
    assert abs(float(landed[0])) == pytest.approx(abs(float(straight[1])), rel=1e-14)
    assert float(landed[1]) == pytest.approx(0.0, abs=1e-14)


@pytest.mark.parametrize("meridian", ["x", "y"])
@pytest.mark.parametrize(
    ("axis", "rear"), [("0 0 1", -70.0), ("0 1 0", -70.0), ("0 1 1", math.inf)]
)
def test_first_order_optics_is_that_of_rays_near_the_axis(axis, rear, meridian):
    """A crystal lens has two foci, one in each section; walk-off is no part of them."""
    lens = lens_of(
        (f"{CALCITE} extraordinary {axis}", 8.0, {"radius": 40.0}),
        ("air", None, {"radius": rear}),
    )
    small = 1e-4
    steps = torch.tensor([small, -small], dtype=F64)
    zero = torch.zeros_like(steps)
    across = (steps, zero) if meridian == "x" else (zero, steps)
    position = torch.stack([*across, zero], -1)
    direction = torch.tensor([0.0, 0.0, 1.0], dtype=F64).expand(2, 3)
    behind = lens.trace(dolens.Rays(position, direction, 589.3), last=2)
    k = "xy".index(meridian)
    height = (behind.position[0] - behind.position[1])[k].detach()
    slope = (behind.direction / behind.direction[..., 2:])[:, k].detach()
    found = -height / (slope[0] - slope[1])
    section = first_order(lens.system().section(meridian), 589.3)
    assert float(found) == pytest.approx(float(section.bfd.detach()), rel=1e-6)


def test_in_plain_numbers_first_order_optics_is_the_same():
    lens = lens_of(
        (f"{CALCITE} extraordinary 0 1 2", 8.0, {"radius": 40.0}),
        ("air", None, {"radius": -70.0}),
    )
    z, diameter = ParaxialNumbers.of(lens.system()).exit_pupil(589.3)
    pupil = exit_pupil(lens.system(), 589.3)
    assert z == pytest.approx(float(pupil.z.detach()), rel=1e-14)
    assert diameter == pytest.approx(float(pupil.diameter.detach()), rel=1e-14)


def test_derivatives_of_extraordinary_rays_are_those_of_differences():
    def landed(curvature, thickness, tilt, slope, wavelength):
        lens = lens_of(
            ("CALCITE extraordinary 0.3 -0.5 0.8", 6.0, {"radius": 31.0}),
            ("CALCITE extraordinary 0.9 0.1 0.2", 5.0, {"radius": -45.0}),
            ("air", None, {"radius": -60.0}),
            elements={"second": {"surfaces": [2, 3], "tilt_x": 8.0}},
        )
        values = {
            "surfaces.1.curvature": curvature,
            "thicknesses.1": thickness,
            "elements.second.tilt_x": tilt,
        }
        d = torch.stack([slope, torch.full_like(slope, 0.1), torch.ones_like(slope)])
        rays = dolens.Rays(torch.tensor([1.0, 2.0, -1.0], dtype=F64), d / d.norm(), wavelength)
        found = trace_rays(lens.system(values), rays)
        return torch.cat([found.position[:2], found.path_length.reshape(1)])

    given = [torch.tensor(v, dtype=F64, requires_grad=True) for v in (0.03, 6.0, 0.1, 0.2, 600.0)]
    torch.autograd.gradcheck(landed, given)


@pytest.mark.parametrize("ray_name", ["ordinary", "extraordinary"])
def test_malus_law(ray_name):
    """The ray that is followed has cos² of light polarised at an angle to its field."""
    lens = plate(f"{CALCITE} {ray_name} 0 1 1")
    found = lens.trace_polarised(ray())
    along_y = torch.eye(3, dtype=found.matrix.dtype)[1]
    for degrees in (0.0, 30.0, 75.0):
        angle = math.radians(degrees)
        field = torch.tensor([math.sin(angle), math.cos(angle), 0.0], dtype=found.matrix.dtype)
        share = float((found.matrix @ field).abs().square().sum().detach())
        expected = math.cos(angle) ** 2 if ray_name == "extraordinary" else math.sin(angle) ** 2
        assert share == pytest.approx(expected, abs=1e-14)
    passed = (found.matrix @ along_y).abs().detach()
    assert float(passed.norm()) == pytest.approx(float(ray_name == "extraordinary"), abs=1e-14)
    assert float(found.transmission.detach()) == pytest.approx(0.5, rel=1e-14)


def test_both_rays_of_a_wave_plate_differ_by_its_retardation():
    """(n_e - n_o)·t: half a wave of quartz at 589.3 nm, n_o = 1.54424, n_e = 1.55335."""
    thickness = 0.5 * 589.3e-6 / (1.55335 - 1.54424)
    lengths = [
        plate(f"1.54424 and 1.55335 {name} 0 1 0", thickness).trace(ray()).path_length
        for name in ("ordinary", "extraordinary")
    ]
    assert float((lengths[1] - lengths[0]).detach()) == pytest.approx(0.5 * 589.3e-6, rel=1e-9)


def test_in_single_precision_a_crystal_errs_as_glass_does():
    exact = plate(f"{CALCITE} extraordinary 0.3 -0.5 0.8").trace(ray(0.15, -0.2))
    lens = lens_of(
        (f"{CALCITE} extraordinary 0.3 -0.5 0.8", 10.0), ("air", None), dtype=torch.float32
    )
    found = lens.trace(ray(0.15, -0.2))
    assert found.position.dtype == torch.float32
    torch.testing.assert_close(found.position.double(), exact.position, rtol=0.0, atol=3e-6)


def test_grazing_and_missing_rays_stay_finite_with_gradients():
    lens = lens_of(
        (f"{CALCITE} extraordinary 0.3 -0.5 0.8", 6.0, {"radius": 11.0, "semi_diameter": 10.9}),
        ("air", None, {"radius": -9.0, "semi_diameter": 8.9}),
    )
    slopes = torch.linspace(-0.9, 0.9, 41, dtype=F64)
    d = torch.stack([slopes, 0.3 * slopes, torch.ones_like(slopes)], -1)
    start = torch.stack([20.0 * slopes, 5.0 * slopes, -torch.ones_like(slopes)], -1)
    found = lens.trace(dolens.Rays(start, d / d.norm(dim=-1, keepdim=True), 589.3))
    assert bool(found.valid.any()) and not bool(found.valid.all())
    assert bool(found.position.isfinite().all())
    (gradient,) = torch.autograd.grad(found.position.sum(), lens.surfaces["1"].curvature)
    assert bool(gradient.isfinite())


def test_a_lens_with_a_crystal_comes_back_from_its_prescription():
    lens = lens_of(("CALCITE extraordinary 0 1 1", 10.0), ("air", None))
    again = lens_from_prescription(prescription_of(lens), dtype=F64)
    assert [m.name for m in again.materials] == [m.name for m in lens.materials]
    assert again.materials[1] == lens.materials[1]
    assert lens.materials[1].name == "BIREFRINGENT:CALCITE extraordinary 0 1 1"


def test_a_crystal_at_another_temperature_has_other_indices():
    """Both rays' catalogue entries have dn/dT, as Al2O3's: 1.8e-5 and 2.2e-5 in D0."""
    cold = plate("AL2O3 extraordinary 0 1 0")
    hot = cold.at(100.0)
    crystal, warm = cold.materials[1], hot.materials[1]
    assert float(warm.ordinary.index(589.3)) != float(crystal.ordinary.index(589.3))
    assert float(warm.extraordinary.index(589.3)) != float(crystal.extraordinary.index(589.3))


@pytest.mark.parametrize("suffix", ["zmx", "seq", "txt"])
@pytest.mark.parametrize("medium", ["CALCITE", CALCITE])
@pytest.mark.parametrize("ray_name", ["ordinary", "extraordinary"])
def test_other_programs_files_do_not_get_a_crystal_as_glass(suffix, medium, ray_name, tmp_path):
    lens = lens_of((f"{medium} {ray_name} 0 1 1", 10.0), ("air", None))
    with pytest.raises(InputError, match=f"surface 1: a .{suffix} file cannot hold material"):
        dolens.save_lens(lens, tmp_path / f"plate.{suffix}")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("CALCITE extraordinary 0 1", "three numbers of the optic axis"),
        ("CALCITE extraordinary 0 0 0", "three numbers of the optic axis"),
        ("CALCITE ordinary a b c", "three numbers of the optic axis"),
        ("N-BK7 extraordinary 0 0 1", "N-BK7-E"),
        ("mirror and 1.5 ordinary 0 0 1", "no medium with one index"),
    ],
)
def test_a_crystal_that_cannot_be_read_is_refused(text, message):
    with pytest.raises(InputError, match=message):
        parse_material(text, index_model("dfc"))


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([("1.5", 1.0), (f"{CALCITE} ordinary 0 0 1", None)], "sensor cannot be in a crystal"),
        (
            [(f"{CALCITE} ordinary 0 0 1", 1.0, {"coating": "quarter_wave"}), ("air", None)],
            "surface 1: the face of a crystal",
        ),
        (
            [
                (f"{CALCITE} ordinary 0 0 1", 1.0),
                ("air", None, {"phase": {"type": "grating", "grooves": 100.0}}),
            ],
            "surface 2: the face of a crystal",
        ),
    ],
)
def test_what_crystals_do_not_hold_is_refused(rows, message):
    with pytest.raises(InputError, match=message):
        lens_of(*rows)


def test_analyses_of_isotropic_lenses_refuse_crystals():
    lens = plate(f"{CALCITE} extraordinary 0 1 1")
    with pytest.raises(InputError, match="Seidel sums: the medium behind surface 1 is a crystal"):
        seidel(lens.system(), 589.3, 0.1)
    with pytest.raises(InputError, match="ghosts: the medium behind surface 1 is a crystal"):
        lens.ghosts()
    with pytest.raises(InputError, match="the face of a crystal is ideal"):
        lens.coated("none")


def test_refraction_at_grazing_incidence_is_that_of_snell():
    """tan of the wave vector's tangential part is kept at 89.9°."""
    angle = math.radians(89.9)
    d = tuple(torch.tensor(v, dtype=F64) for v in (math.sin(angle), 0.0, math.cos(angle)))
    normal = tuple(torch.tensor(v, dtype=F64) for v in (0.0, 0.0, 1.0))
    crystal = Crystal(N_O, N_E, (0.36, 0.48, 0.8))
    x, y, z, margin = refract_at_crystal(d, normal, 1.0, crystal, 1.0)
    k = crystal.wave_vector((x, y, z))
    assert float(k[0]) == pytest.approx(math.sin(angle), rel=1e-14)
    assert float(k[1]) == pytest.approx(0.0, abs=1e-14)
    assert float(margin) > 0.0


@pytest.mark.parametrize(("axis", "symmetric"), [("0 0 2", True), ("0 1 1", False)])
def test_only_an_axis_along_z_leaves_a_lens_symmetric(axis, symmetric):
    """An image between two fields is found by turning one's only where nothing singles out y."""
    assert plate(f"{CALCITE} extraordinary {axis}").system().rotationally_symmetric == symmetric


def test_a_lens_with_a_crystal_has_a_summary_without_seidel_sums():
    lens = lens_of((f"{CALCITE} extraordinary 0 1 1", 10.0, {"radius": 40.0}), ("air", None))
    text = repr(lens.summary(wavelengths=589.3))
    assert "effective focal length" in text.lower() or "efl" in text.lower()
    assert "spherical" not in text
