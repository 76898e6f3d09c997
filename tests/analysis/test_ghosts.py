"""Ghosts of a source: plates and balls in closed form, first order beside tensors, errors."""

import cmath
import math

import pytest
import torch

from dolens import InputError, load_lens
from dolens.analysis.conditions import conditions
from dolens.analysis.ghosts import ghosts
from dolens.optics.ghost_optics import NormalIncidence, ghosts_first_order
from dolens.optics.ghost_paths import ghost_path_system, ghost_paths
from dolens.optics.paraxial import first_order
from dolens.optics.paraxial_rays import paraxial_rays
from dolens.prescriptions import lens_from_prescription, prescription_of
from tests.lenses import lens_of_rows

GLASS = 1.5
R = ((GLASS - 1.0) / (GLASS + 1.0)) ** 2


def plate(front=5.0, **keys):
    """A plane plate that passes all the light of a stop in front of it."""
    wide = {"type": "plane", "semi_diameter": 80.0}
    return lens_of_rows(
        {"type": "aperture", "semi_diameter": front, "thickness": 0.0, "material": "air"},
        {**wide, "thickness": 4.0, "material": str(GLASS)},
        {**wide, "material": "air"},
        **{"sensor": 20.0, "stop": 1, **keys},
    )


def reflected(angle):
    """Fresnel's share of unpolarised light that glass reflects, at an angle in air in degrees."""
    one = math.radians(angle)
    other = math.asin(math.sin(one) / GLASS)
    s = (math.sin(one - other) / math.sin(one + other)) ** 2
    p = (math.tan(one - other) / math.tan(one + other)) ** 2
    return 0.5 * (s + p)


def exactly(lens):
    """The lens, traced by the reference: kernels take losses as series that err by some 1e-6."""
    lens.backend = "reference"
    return lens


def found(lens, field=0.0, distance=None, wavelengths=None, **settings):
    where = conditions(lens, field, wavelengths or lens.primary_wavelength, distance)
    return ghosts(lens, where, **settings)


def test_all_orders_of_a_plate_have_the_power_of_the_incoherent_sum():
    """T = (1 - R)/(1 + R), of which reflections beyond the sixth have R⁸."""
    orders = [found(exactly(plate()), 30.0, rays=200, bounces=b) for b in (2, 4, 6)]
    total = orders[0].image + sum(float(g.measures.share.sum()) for g in orders)
    r = reflected(30.0)
    assert math.isclose(orders[0].image, (1.0 - r) ** 2, rel_tol=1e-13)
    assert math.isclose(total, (1.0 - r) / (1.0 + r) * (1.0 - r**8), rel_tol=1e-12)
    for order, one in enumerate(orders, 1):
        assert math.isclose(one.total, r ** (2 * order), rel_tol=1e-12)


def film(front, behind, n, k, thickness, wavelength):
    """R and T at normal incidence of a film, by its characteristic matrix (Macleod, ch. 2)."""
    index = complex(n, -k)
    delta = 2.0 * math.pi * index * thickness / wavelength
    cosine, sine = cmath.cos(delta), 1j * cmath.sin(delta)
    b, c = cosine + sine / index * behind, index * sine + cosine * behind
    r = (front * b - c) / (front * b + c)
    return abs(r) ** 2, 4.0 * front * behind / abs(front * b + c) ** 2


def test_an_absorbing_film_reflects_more_on_one_side_than_on_the_other():
    """A film of chromium on both faces of a plate: the path's light is reflected from within."""
    n, k, thickness, wavelength = 3.1, 3.3, 3.0, 587.5618
    layers = [{"material": [n, k], "thickness": thickness}]
    given = prescription_of(plate())
    for number in ("2", "3"):
        given["surfaces"][number]["coating"] = layers
    lens = exactly(lens_from_prescription(given))
    one = found(lens, rays=200)
    r, t = film(GLASS, 1.0, n, k, thickness, wavelength)
    outside, through = film(1.0, GLASS, n, k, thickness, wavelength)
    assert abs(outside - r) > 0.05 and math.isclose(through, t)
    assert math.isclose(one.image, t * t, rel_tol=1e-10)
    assert math.isclose(float(one.measures.share[0]), (t * r) ** 2, rel_tol=1e-10)
    normal = NormalIncidence(lens.requires_grad_(False).system(), wavelength)
    assert math.isclose(float(normal.share((3, 2))), (t * r) ** 2, rel_tol=1e-10)


def test_a_table_of_a_coating_is_read_at_the_angle_in_front_of_it():
    """In air at the first face, whichever side the light comes from, and in glass at the second."""
    rows = [[587.5618, angle, *(2 * [1e-3 * angle]), *(2 * [1.0 - 1e-3 * angle])]
            for angle in range(0, 90, 1)]  # fmt: skip
    given = prescription_of(plate())
    for number in ("2", "3"):
        given["surfaces"][number]["coating"] = {"table": rows}
    one = found(lens_from_prescription(given), 30.0, rays=200)
    second = 1e-3 * math.degrees(math.asin(0.5 / GLASS))
    wanted = (1.0 - 0.03) * second * 0.03 * (1.0 - second)
    assert math.isclose(float(one.measures.share[0]), wanted, rel_tol=1e-9)


def test_kernels_lose_the_light_that_the_reference_loses():
    """Of bare, cemented and coated surfaces at all angles of their rays."""
    for coating in ("none", "quarter_wave"):
        fast, slow = (load_lens("double_gauss").coated(coating) for _ in range(2))
        paths = [(11, 9), (9, 8), (8, 4), (5, 1)]
        one, other = (found(lens, 10.0, rays=500, paths=paths) for lens in (fast, exactly(slow)))
        assert one.paths == other.paths and float(one.measures.share.min()) > 0.0
        ratio = one.measures.share / other.measures.share
        assert torch.allclose(ratio, torch.ones_like(ratio), rtol=0.0, atol=2e-5)


def test_a_quarter_wave_takes_ghosts_away():
    lens = load_lens("cooke_triplet")
    lenses = lens, lens.coated("quarter_wave")
    bare, better = (found(one, 14.0, rays=1000) for one in lenses)
    # The square of what MgF2 on glass of 1.62 takes of R, a factor of 9.
    assert 40.0 < bare.total / better.total < 90.0
    assert better.image > 1.2 * bare.image


def test_glass_that_absorbs_takes_more_of_a_ghost_than_of_the_image(monkeypatch):
    """A ghost of a plate goes through it three times."""
    per_mm = {str(GLASS): 0.02}
    monkeypatch.setattr(
        "dolens.optics.system.absorption", lambda medium, nm: per_mm.get(medium.name, 0.0)
    )
    one = found(exactly(plate()), rays=100)
    assert math.isclose(one.total, R * R * math.exp(-2.0 * 0.02 * 4.0), rel_tol=1e-12)


def test_a_plate_s_ghost_is_as_large_as_its_beam():
    """A disc of the front's radius: its RMS radius, and the irradiance that falls on it."""
    one = found(plate(), 20.0)
    r = reflected(20.0)
    share, error = (float(v.irradiance[0]) for v in (one.measures, one.errors))
    wanted = ((1.0 - r) * r) ** 2 * math.cos(math.radians(20.0))
    assert abs(share - wanted) < 3.0 * error < 1e-2 * wanted
    rms, error = (float(v.rms[0]) for v in (one.measures, one.errors))
    assert abs(rms - 5.0 / math.sqrt(2.0)) < 3.0 * error < 0.1
    inside = math.asin(math.sin(math.radians(20.0)) / GLASS)
    direct = 4.0 * math.tan(inside) + 20.0 * math.tan(math.radians(20.0))
    shift = 8.0 * math.tan(inside)
    assert abs(float(one.measures.y[0]) - direct - shift) < 3.0 * float(one.errors.y[0])
    assert math.isinf(float(one.first_order.focus[0]))
    assert math.isinf(float(one.first_order.efl[0]))


def test_a_near_source_lights_a_plate_as_the_square_of_its_distance():
    """Irradiance counts from that at the first vertex; the ghost is a larger disc."""
    one = found(plate(front=0.5), distance=100.0)
    # The paraxial image of the source by the ghost lies (2k + 1)·d/n behind the front.
    grown = (100.0 + 3.0 * 4.0 / GLASS + 20.0) / 100.0
    wanted = ((1.0 - R) * R / grown) ** 2
    found_there, error = (float(v.irradiance[0]) for v in (one.measures, one.errors))
    assert abs(found_there - wanted) < 3.0 * error + 1e-4 * wanted
    assert error < 1e-2 * wanted


def test_a_ghost_in_focus_is_a_disc_of_diffraction():
    """Its paraxial focus on the sensor: no smaller than Airy's disc, and finite."""
    ball = lens_of_rows(
        (5.0, 10.0, "1.5"), (-5.0, 0.0, "air"), sensor=1.0, stop=1, semi_diameter=0.02
    )
    (path,) = ghost_paths(ball.system())
    bfd = first_order(ghost_path_system(ball.system(), path), ball.primary_wavelength).bfd
    ball = ball.with_values({"sensor_distance": bfd.detach()})
    one = found(ball)
    assert abs(float(one.first_order.focus[0])) < 1e-12
    airy = 0.61 * ball.primary_wavelength * 1e-6 / abs(float(one.first_order.slope[0]))
    brightest = float(one.measures.share[0]) * math.pi * 0.02**2 / (math.pi * airy**2)
    assert float(one.measures.rms[0]) < airy
    assert math.isclose(float(one.measures.irradiance[0]), brightest, rel_tol=0.05)


@pytest.mark.parametrize("name", ["cooke_triplet", "double_gauss"])
@pytest.mark.parametrize("distance", [None, 800.0])
def test_first_order_numbers_are_those_of_the_unfolded_lens(name, distance):
    lens = load_lens(name).requires_grad_(False)
    system, wave = lens.system(), lens.primary_wavelength
    paths = [*ghost_paths(system)[::9], (len(system.surfaces) + 1, 2)]
    fast = ghosts_first_order(system, paths, wave, distance)
    for number, path in enumerate(paths):
        ghost = ghost_path_system(system, path)
        exact, end = first_order(ghost, wave, distance), ghost.vertices[-1]
        wanted = (exact.image - end, exact.efl, exact.exit_pupil.z - end)
        values = (fast.focus[number], fast.efl[number], fast.pupil[number])
        for value, other in zip(values, wanted, strict=True):
            assert math.isclose(float(value), float(other), rel_tol=1e-10)
        # The marginal ray of the lens itself, which starts at the same height of the front.
        beam, own = (paraxial_rays(s, wave, 0.0, distance).marginal for s in (system, ghost))
        scale = float(beam.height[0] / own.height[0])
        height = own.height[-1] + own.slope_after[-1] * system.sensor_distance
        assert math.isclose(float(fast.marginal[number]), float(height) * scale, rel_tol=1e-10)


def test_errors_are_as_large_as_they_say():
    """Beside forty times as many rays: of all numbers of all paths none is off by five errors, and
    most by less than one and a half.
    """
    lens = load_lens("cooke_triplet").requires_grad_(False)
    few, many = found(lens, 12.0, rays=5_000), found(lens, 12.0, rays=200_000)
    places = [many.paths.index(path) for path in few.paths]
    off = []
    for values, errors, exact, rest in zip(
        few.measures, few.errors, many.measures, many.errors, strict=True
    ):
        error = torch.hypot(errors, rest[places])
        off.append(((values - exact[places]).abs() / error)[errors > 1e-12])
    every = torch.cat(off)
    assert len(every) > 60
    assert float(every.max()) < 5.0
    assert float(every.quantile(0.75)) < 1.5


def test_a_ghost_that_does_not_arrive_may_have_the_power_of_one_ray():
    lens = plate(sensor={"distance": 20.0, "diameter": 1.0})
    one = found(lens, 40.0, rays=1000)
    assert float(one.measures.share[0]) == 0.0 and one.image == 0.0
    assert math.isclose(float(one.errors.share[0]), ((1.0 - R) * R) ** 2 / one.rays)
    assert float(one.measures.irradiance[0]) == 0.0
    assert math.isnan(float(one.measures.x[0])) and math.isnan(float(one.measures.power[0]))


def test_a_source_outside_of_the_field_has_ghosts_and_no_image():
    one = found(load_lens("double_gauss"), 35.0, rays=2000)
    assert one.image == 0.0 and math.isnan(one.total)
    assert float(one.measures.irradiance[0]) > 1e-5


def test_the_sensor_s_ghosts_have_the_power_that_it_reflects():
    lens = load_lens("cooke_triplet")
    one = found(lens, rays=2000, sensor_reflectance=0.3)
    assert {path for path in one.paths if 7 in path} == {(7, i) for i in range(1, 7)}
    half = found(lens, rays=2000, sensor_reflectance=0.15, paths=[(7, 6)])
    place = one.paths.index((7, 6))
    # What the sensor takes of the image and of the ghost cancels in their quotient.
    ratio = float(one.measures.power[place] / half.measures.power[0])
    assert math.isclose(ratio, 2.0, rel_tol=1e-12)


def test_shares_of_a_path_are_those_of_bare_glass():
    normal = NormalIncidence(plate().system(), 587.5618)
    assert math.isclose(float(normal.share(())), (1.0 - R) ** 2)
    assert math.isclose(float(normal.share((3, 2))), ((1.0 - R) * R) ** 2)


def test_colours_count_by_their_weights():
    lens = load_lens("cooke_triplet")
    red, blue, both = (
        found(lens, 5.0, wavelengths=w, rays=2000, paths=[(6, 1)])
        for w in ([656.2725], [486.1327], [656.2725, 486.1327])
    )
    shares = [float(one.measures.share[0]) for one in (red, blue, both)]
    assert shares[0] != shares[1]
    assert math.isclose(shares[2], 0.5 * (shares[0] + shares[1]), rel_tol=1e-12)


def test_what_cannot_be_done_is_said_in_one_line():
    lens = load_lens("cooke_triplet")
    with pytest.raises(InputError, match="those of one field, not of 2"):
        found(lens, [0.0, 5.0])
    with pytest.raises(InputError, match=r"sensor_reflectance: 2; allowed: 0 to 1"):
        found(lens, sensor_reflectance=2)
    with pytest.raises(InputError, match="rays: 3; allowed: an integer of 8 or more"):
        found(lens, rays=3)
    with pytest.raises(InputError, match=r"surface 7 reflects no light"):
        found(lens, paths=[(7, 6)])
    lens = lens_of_rows((None, 0.0, "air"), stop=1)
    with pytest.raises(InputError, match="two surfaces that reflect light; it has 0"):
        found(lens)
