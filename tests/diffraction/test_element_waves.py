"""Waves behind diffractive elements: Airy, orders, zone plates, rays, and brute force."""

import math

import numpy as np
import pytest
import torch
from scipy.special import j1

import dolens
from dolens.analysis.conditions import conditions
from dolens.diffraction.element_waves import element_light
from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.modulation_transfer import diffraction_modulation
from dolens.diffraction.pixel_psf import PixelWindow, propagation, wave_kernels
from dolens.diffraction.point_spread import point_spread
from dolens.diffraction.propagation import DiffractionSettings
from dolens.errors import InputError
from dolens.optics.diffractive import lens_phase, order_efficiencies
from dolens.prescriptions.build import lens_from_prescription

GLASS = "1.4585/67.8"
ON_AXIS = ObjectPoints.at_infinity([[0.0, 0.0]])


def plate(diffractive, phase=None, semi_diameter=0.5, distance=8.0, dtype=torch.float64, **data):
    """A flat plate whose back is diffractive, at a distance (mm) from the sensor."""
    front = {"type": "plane", "semi_diameter": 2 * semi_diameter, "thickness": 0.5}
    back = {"type": "plane", "semi_diameter": semi_diameter, "diffractive": diffractive}
    surfaces = {
        "1": {**front, "material": GLASS},
        "2": {**back, "material": "air", **({"phase": phase} if phase else {})},
    }
    sensor = {"distance": distance, "diameter": 1.0}
    given = {"stop": 2, "surfaces": surfaces, "sensor": sensor, "wavelengths": [550], **data}
    return lens_from_prescription(given, dtype)


def kinoform(focal=8.0, semi_diameter=0.5, order=1, **diffractive):
    phase = lens_phase(focal, 550.0, semi_diameter, order)
    return plate({"design_wavelength": 550, **diffractive}, phase, semi_diameter, focal)


def irradiance(lens, points, u, wavelength=550.0, centre=None, **settings):
    """The irradiance (U, U) about a centre, with the light of an axial point as unit."""
    half = float(u.abs().max())
    settings = DiffractionSettings(**settings)
    light = element_light(lens.system(), points, wavelength, centre, settings)
    found = light.field(0, light.plan(0, half), u, u, torch.float64)
    return found.abs().square().detach()


def steps(count, width):
    return (torch.arange(count, dtype=torch.float64) - (count - 1) / 2) * (width / (count - 1))


def test_a_kinoform_at_its_wavelength_is_a_perfect_lens():
    u = steps(61, 0.03)
    found = irradiance(kinoform(), ON_AXIS, u)
    sine = 0.5 / math.hypot(8.0, 0.5)
    v = 2 * math.pi / 550e-6 * sine * u.abs().clamp(min=1e-9).numpy()
    airy = (2 * j1(v) / v) ** 2 * math.pi * sine**2 / 550e-6**2
    assert np.abs(found[30].numpy() - airy).max() < 2e-3 * airy.max()


@pytest.mark.parametrize("levels", [None, 2, 4, 8])
@pytest.mark.parametrize("wavelength", [550.0, 480.0])
def test_orders_of_a_grating_have_their_efficiencies(levels, wavelength):
    # A grating of 12.5 µm on a strip of light; the image of order m is far from the others.
    phase = {"type": "grating", "grooves": 80, "order": 1}
    element = {"design_wavelength": 550} | ({"levels": levels} if levels else {})
    lens = plate(element, phase, 0.2, 40.0)
    material = lens.materials[1]
    step = [float(material.index(w)) - 1.0 for w in (wavelength, 550.0)]
    detuning = 550.0 / wavelength * step[0] / step[1]
    u = steps(241, 1.2)
    for order in (0, 1, 2):
        sine = order * 80 * wavelength * 1e-6
        centre = [[0.0, 40.0 * sine / math.sqrt(1.0 - sine**2)]]
        found = irradiance(
            lens, ON_AXIS, u, wavelength, centre, method="spectrum", oversampling=15.0
        )
        # An order's window holds all of its light but the far rings.
        share = float(found.sum()) * float(u[1] - u[0]) ** 2 / 0.982
        exact = np.sinc(detuning - order) ** 2
        if levels:
            n = np.arange(levels)
            series = np.exp(2j * np.pi * n / levels * (detuning - order)).mean()
            exact = abs(series * np.sinc(order / levels)) ** 2
        assert share == pytest.approx(exact, abs=0.006)


def test_a_binary_zone_plate_has_its_foci_at_odd_parts_of_the_focal_length():
    u = steps(21, 0.01)
    whole = float(irradiance(kinoform(24.0), ON_AXIS, u).max())
    for order, share in ((1, 4 / math.pi**2), (3, 4 / (3 * math.pi) ** 2)):
        lens = kinoform(24.0, levels=2).with_values({"sensor_distance": 24.0 / order})
        peak = float(irradiance(lens, ON_AXIS, u, method="spectrum", oversampling=3.0).max())
        # The light of order m meets at f/m, in a spot m times as small: m² times as bright.
        assert peak == pytest.approx(share * order**2 * whole, rel=0.03)
    # No light of even orders.
    lens = kinoform(24.0, levels=2).with_values({"sensor_distance": 12.0})
    assert float(irradiance(lens, ON_AXIS, u, method="spectrum").max()) < 0.01 * whole


def test_a_multi_order_lens_brings_its_harmonics_to_one_focus():
    u = steps(21, 0.01)
    lens, simple = kinoform(order=5), kinoform()
    material = lens.materials[1]

    def detuning(w):
        return 5 * 550 / w * (float(material.index(w)) - 1) / (float(material.index(550.0)) - 1)

    waves = np.linspace(440, 480, 4001)
    harmonic = float(waves[np.argmin([abs(detuning(w) - 6) for w in waves])])
    focal = 8.0 * 550 / harmonic * 5 / 6
    lens = lens.with_values({"sensor_distance": focal})
    bright = float(irradiance(lens, ON_AXIS, u, harmonic).max())
    sine = 0.5 / math.hypot(focal, 0.5)
    assert bright == pytest.approx(math.pi * sine**2 / (1e-6 * harmonic) ** 2, rel=0.03)
    assert float(irradiance(simple, ON_AXIS, u, harmonic).max()) < 0.2 * bright


def smooth_heights(count, pitch, focal, seed=0):
    """Heights (nm) of a lens and of waves on it, over 550 nm and a turn and more."""
    x = (np.arange(count) + 0.5 - 0.5 * count) * pitch
    square = x[None] ** 2 + x[:, None] ** 2
    turns = -(np.sqrt(square + focal**2) - focal) / 550e-6
    turns += 0.6 * np.sin(2 * np.pi * (3 * x[None] + 2 * x[:, None]) / (count * pitch))
    return (turns % 1.0) * 550.0 / 0.46


@pytest.mark.parametrize(
    ("field", "fill"), [((0.0, 0.0), 1.0), ((6.0, -9.0), 1.0), ((0.0, 5.0), 0.75)]
)
def test_pixels_make_what_brute_force_makes_of_them(field, fill):
    count, pitch, focal = 96, 0.004, 4.0
    heights = smooth_heights(count, pitch, focal)
    element = {"pixels": heights.tolist(), "pitch": pitch, "fill": fill}
    lens = plate(element, None, 0.19, focal)
    tangents = [math.tan(math.radians(angle)) for angle in field]
    sines = [t / math.sqrt(1 + tangents[0] ** 2 + tangents[1] ** 2) for t in tangents]
    centre = [focal * s / math.sqrt(1 - sines[0] ** 2 - sines[1] ** 2) for s in sines]
    u = steps(7, 0.03)
    points = ObjectPoints.at_infinity([list(field)])
    # Gaps interfere by the light at the very rim, which a cell a pixel does not resolve.
    samples = None if fill == 1.0 else 760
    given = {"method": "spectrum", "samples": samples}
    found = irradiance(lens, points, u, 550.0, [centre], **given).numpy()
    # Rayleigh and Sommerfeld's integral over parts of pixels, in NumPy.
    parts = 8
    x = (np.arange(count * parts) + 0.5 - 0.5 * count * parts) * (pitch / parts)
    fine = np.kron(heights, np.ones((parts, parts)))
    index = float(lens.materials[1].index(550.0))
    square = sines[0] ** 2 + sines[1] ** 2
    path = (math.sqrt(index**2 - square) - math.sqrt(1.0 - square)) / 550.0
    if fill < 1.0:  # of eight parts along a side, six stand at the height
        gap = np.isin(np.arange(count * parts) % parts, (0, 7))
        fine[gap], fine[:, gap] = 0.0, 0.0
    lit = x[None] ** 2 + x[:, None] ** 2 < 0.19**2
    tilt = np.exp(2j * np.pi / 550e-6 * (sines[0] * x[None] + sines[1] * x[:, None]))
    values = (np.exp(2j * np.pi * fine * path) * tilt)[lit]
    columns, rows = np.meshgrid(x, x)
    columns, rows = columns[lit], rows[lit]
    exact = np.zeros((len(u), len(u)))
    for j, v in enumerate(u.numpy()):
        for i, w in enumerate(u.numpy()):
            r = np.sqrt((centre[0] + w - columns) ** 2 + (centre[1] + v - rows) ** 2 + focal**2)
            kernel = focal / r**2 * (1 / r - 2j * np.pi / 550e-6) * np.exp(2j * np.pi * r / 550e-6)
            exact[j, i] = abs((values * kernel).sum() * (pitch / parts) ** 2 / (2 * np.pi)) ** 2
    # Irradiance of one: the flux of an axial point through the stop, less its cosine off the axis.
    cosine = 1.0 / math.sqrt(1 + tangents[0] ** 2 + tangents[1] ** 2)
    exact *= cosine**3 / (math.pi * 0.19**2)
    assert np.abs(found - exact).max() < 0.01 * exact.max()


def test_light_lands_where_rays_of_the_first_order_do():
    phase = {"type": "xy", "norm_radius": 0.3, **{"y": 90.0, "x2": -90.0, "y2": -90.0}}
    lens = plate({"design_wavelength": 550}, phase, 0.3, 5.0, wavelengths=[550])
    points = ObjectPoints.at_infinity([[2.0, 1.0]])
    window = PixelWindow(0.002, 401)
    centre = [[0.17, 0.3]]
    kernel = wave_kernels(lens.system(), points, 550.0, centre, window)[0].detach()
    place = torch.arange(401, dtype=torch.float64) - 200
    x = float(-(kernel.sum(0) * place).sum() / kernel.sum() * 0.002 + centre[0][0])
    y = float((kernel.sum(1) * place).sum() / kernel.sum() * 0.002 + centre[0][1])
    grid = torch.stack(torch.meshgrid(*2 * (steps(41, 0.6),), indexing="ij"), -1).flatten(0, 1)
    grid = grid[grid.norm(dim=-1) < 0.3]
    tangents = torch.tensor([math.tan(math.radians(2.0)), math.tan(math.radians(1.0))]).double()
    direction = torch.cat([tangents, torch.ones(1).double()])
    direction = direction / direction.norm()
    position = torch.cat([grid - tangents * 0.34, torch.zeros_like(grid[:, :1])], -1)
    hit = lens.trace(dolens.Rays(position, direction.expand_as(position), 550.0))
    rays = hit.position[hit.valid].mean(0).detach()
    assert (x, y) == pytest.approx((float(rays[0]), float(rays[1])), abs=3e-3)


@pytest.mark.parametrize("method", ["fourier", "spectrum"])
def test_gradients_are_those_of_differences(method):
    heights = smooth_heights(40, 0.01, 5.0)
    element = {"pixels": heights.tolist(), "pitch": 0.01}
    front = {"type": "sphere", "radius": 40.0, "semi_diameter": 0.25, "thickness": 0.5}
    back = {"type": "plane", "semi_diameter": 0.19, "diffractive": element, "material": "air"}
    lens = lens_from_prescription(
        {"stop": 2, "surfaces": {"1": {**front, "material": GLASS}, "2": back},
         "sensor": {"distance": 4.8}}
    )  # fmt: skip
    points, window = ObjectPoints.at_infinity([[0.5, 1.0]]), PixelWindow(0.003, 9)
    settings = DiffractionSettings(method=method)
    weights = torch.linspace(0.3, 1.0, 81, dtype=torch.float64).reshape(9, 9)
    names = ("surfaces.2.diffractive.heights", "surfaces.1.curvature", "sensor_distance")

    def loss(values):
        system = lens.with_values(values).system()
        centre = [[0.04, 0.085]]
        found = wave_kernels(system, points, 520.0, centre, window, settings)
        return (weights * found).sum()

    start = {n: p.detach().clone().requires_grad_() for n, p in lens.variables(names).items()}
    found = torch.autograd.grad(loss(start), list(start.values()))
    rng = np.random.default_rng(1)
    for (name, value), gradient in zip(start.items(), found, strict=True):
        way = torch.tensor(rng.normal(size=tuple(value.shape))) if value.ndim else 1.0
        step = {"heights": 0.1, "curvature": 1e-6}.get(name.rpartition(".")[2], 2e-3)
        with torch.no_grad():
            ends = [loss({**start, name: value + s * step * way}) for s in (1, -1)]
        difference = float(ends[0] - ends[1]) / (2 * step)
        along = float((gradient * way).sum())
        assert along == pytest.approx(difference, rel=0.01), name


@pytest.mark.parametrize(("distance", "strength"), [(95.86, 0.5), (95.0, 0.0), (95.6, -0.8)])
def test_a_wide_beam_that_meets_far_away_goes_by_one_fourier_transform(distance, strength):
    """The doublet with a cubic relief, in a window of 41 pixels of its camera, to a corner."""
    lens = dolens.load_lens("diffractive_doublet")
    relief = {f"surfaces.5.phase.{name}": strength for name in ("x3", "y3")}
    small = {"sensor_distance": distance, "surfaces.5.semi_diameter": 2.0}
    system = lens.with_values({**relief, **small}).system()
    point, u = ObjectPoints.at([[20.0, 10.0, -6000.0]]), steps(5, 0.4)
    found = {}
    for method in ("auto", "direct"):
        light = element_light(system, point, 486.0, None, DiffractionSettings(method=method))
        plan = light.plan(0, 0.3)
        assert plan.method == ("fourier" if method == "auto" else method)
        found[method] = light.irradiance(0, plan, u, u, torch.float64).detach()
    middle = element_light(system, point, 486.0, None, DiffractionSettings(method="spectrum"))
    fine = steps(81, 0.2)
    peak = middle.irradiance(0, middle.plan(0, 0.3), fine, fine, torch.float32).max()
    assert float((found["auto"] - found["direct"]).abs().max()) < 0.01 * float(peak)


def test_single_precision_is_enough():
    single, double = (
        wave_kernels(lens.system(), ON_AXIS, 520.0, None, PixelWindow(0.002, 25)).detach()
        for lens in (kinoform().float(), kinoform())
    )
    assert single.dtype == torch.float32
    assert float((single - double).abs().max()) < 1e-4 * float(double.max())


def test_plates_behind_an_element_move_its_focus():
    cover = {"type": "plane", "semi_diameter": 1, "thickness": 0.0}
    lens = kinoform()
    given = lens_from_prescription(
        {
            "stop": 1,
            "surfaces": {
                "1": {"type": "plane", "semi_diameter": 0.5, "thickness": 5.0, "material": "air",
                      "phase": lens_phase(8.0, 550.0, 0.5),
                      "diffractive": {"design_wavelength": 550, "material": GLASS}},
                "2": {**cover, "thickness": 1.5, "material": "1.5"},
                "3": {"type": "plane", "semi_diameter": 1, "material": "air"},
            },
            "sensor": {"distance": 2.0},
        }
    )  # fmt: skip
    u = steps(11, 0.01)
    whole = float(irradiance(lens, ON_AXIS, u).max())
    # 5 + 1.5/1.5 + 2 mm reduced; a plate's spherical aberration at F/8 is nothing.
    assert float(irradiance(given, ON_AXIS, u).max()) == pytest.approx(whole, rel=0.01)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"stop": 3}, "the stop, surface 3, stands behind surface 1"),
        ({"3": {"type": "sphere", "radius": 30}}, "surface 3 behind surface 1 is no plane"),
        ({"3": {"diffractive": {"rings": [1], "pitch": 1, "material": "1.6"}}}, "there are 2"),
        ({"sensor": {"distance": 5, "radius": 40}}, "the sensor is curved"),
        ({"elements": {"a": {"surfaces": [1, 2], "tilt_x": 1}}}, "belongs to a moved element"),
        ({"2": {"type": "coordinate_break", "thickness": 0}}, "surface 2 is a coordinate break"),
    ],
)
def test_lenses_that_waves_cannot_pass_are_refused_in_one_line(change, said):
    plane = {"type": "plane", "semi_diameter": 1, "thickness": 1, "material": "air"}
    rows = {"1": {**plane, "diffractive": {"rings": [1], "pitch": 1, "material": "1.5"}}}
    rows |= {"2": plane, "3": {k: v for k, v in plane.items() if k != "thickness"}}
    for number, row in change.items():
        if number in rows:
            rows[number] = row if row.get("type") == "coordinate_break" else {**rows[number], **row}
    others = {key: value for key, value in change.items() if key not in rows}
    lens = lens_from_prescription({"surfaces": rows, "sensor": {"distance": 5}, **others})
    with pytest.raises(InputError) as error:
        wave_kernels(lens.system(), ON_AXIS, 550.0, [[0, 0]], PixelWindow(0.01, 9))
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_views_show_all_orders():
    lens = kinoform()
    where = conditions(lens, [[0.0, 0.0]], [480.0, 550.0])
    found = point_spread(lens, where)
    assert found.reasons[0].startswith("spectrum: ")
    assert found.diffraction == (True,)
    assert float(found.sampling_error) < 0.01
    only = point_spread(lens, conditions(lens, [[0.0, 0.0]], [550.0]))
    assert float(only.strehl_ratio) == pytest.approx(1.0, abs=0.01)
    assert float(found.strehl_ratio) < 0.6
    curves = diffraction_modulation(
        lens, conditions(lens, [[0.0, 0.0]], [550.0]), [20.0, 60.0, 110.0]
    )
    cutoff = 2 * 0.5 / math.hypot(8, 0.5) / 550e-6
    s = np.array([20.0, 60.0, 110.0]) / cutoff
    perfect = 2 / math.pi * (np.arccos(s) - s * np.sqrt(1 - s**2))
    np.testing.assert_allclose(curves.tangential[0].numpy(), perfect, atol=0.02)


def test_the_way_of_propagation_is_said():
    lens = kinoform()
    found = propagation(lens.system(), ON_AXIS, 550.0, None, PixelWindow(0.02, 65))
    assert found.reasons[0].startswith("spectrum: ")


def test_rays_refuse_what_they_do_not_see():
    lens = plate({"rings": [1.0], "pitch": 0.1})
    with pytest.raises(InputError, match="surface 2 is diffractive by its heights alone"):
        lens.strehl()
    assert element_light(lens.system(), ON_AXIS, 550.0, [[0.0, 0.0]]).law is None


def test_orders_of_a_lens_are_told():
    found = order_efficiencies(kinoform(levels=4), [1, 5], [550.0])
    np.testing.assert_allclose(found.numpy(), [np.sinc([1 / 4, 5 / 4]) ** 2], atol=1e-12)
    with pytest.raises(InputError, match="has no 'phase', and so no orders"):
        order_efficiencies(plate({"rings": [1.0], "pitch": 0.1}), [1])


def test_square_light_is_even_in_single_precision():
    square = {"half_width_x": 0.2, "half_width_y": 0.2}
    back = {
        "type": "plane",
        "aperture": square,
        "material": "air",
        "phase": lens_phase(8, 550, 0.3),
    }
    rows = {"1": {**back, "diffractive": {"design_wavelength": 550, "material": GLASS}}}
    lens = lens_from_prescription({"surfaces": rows, "sensor": {"distance": 8}}, torch.float32)
    found = wave_kernels(lens.system(), ON_AXIS, 550.0, None, PixelWindow(0.004, 129))[0].detach()
    line = found[64] / found[64].max()
    # A pixel's box and a texel's tent blur sinc² of 11 µm.
    x = (torch.arange(129 * 64, dtype=torch.float64) - 64 * 64.5 + 0.5) / 64
    spline = torch.where(x.abs() < 0.5, 0.75 - x * x, 0.5 * (1.5 - x.abs()).clamp(min=0).square())
    sinc = torch.sinc(0.4 * 0.004 * x / (8 * 550e-6)).square()
    blurred = np.convolve(sinc.numpy(), spline[64 * 62 : 64 * 67].numpy(), mode="same")[31::64]
    assert np.abs(line.numpy() - blurred / blurred.max()).max() < 0.02


def pixels(lens, wavelength, position=(0.0, 0.0, -1e5), **settings):
    window = PixelWindow(0.005, 21)
    at, settings = torch.tensor([position], dtype=torch.float64), DiffractionSettings(**settings)
    return wave_kernels(lens.system(), at, wavelength, [[0.0, 0.0]], window, settings)[0]


@pytest.mark.parametrize("wavelength", [550.0, 500.0])
def test_one_radius_says_all_of_a_round_element_on_the_axis(wavelength):
    # A lens of second order and rings on it, against plane waves of the whole plane.
    heights = [300.0 * math.sin(0.7 * k) for k in range(40)]
    lens = kinoform(4.0, 0.3, 2, rings=heights, pitch=0.0075)
    with torch.no_grad():
        whole = pixels(lens, wavelength, method="spectrum", samples=900)
        one = pixels(lens, wavelength, samples=900)
    assert 0.0 < float((one - whole).abs().max()) < 0.01 * float(whole.max())


def test_derivatives_along_one_radius_are_those_of_differences():
    lens = kinoform(4.0, 0.3, rings=[50.0 * (k % 3) for k in range(20)], pitch=0.015)
    weight = torch.exp(-0.1 * torch.linspace(-10.0, 10.0, 21, dtype=torch.float64).square())

    def value():
        return weight @ pixels(lens, 520.0, samples=700) @ weight

    named = {k: p for k, p in lens.named_parameters() if "heights" in k or "sensor_dis" in k}
    assert len(named) == 2
    gradients = torch.autograd.grad(value(), list(named.values()))
    for parameter, gradient in zip(named.values(), gradients, strict=True):
        along = torch.linspace(0.3, 1.0, parameter.numel(), dtype=torch.float64)
        along = (0.5 if parameter.numel() > 1 else 1e-4) * along.reshape(parameter.shape)
        ends = []
        for sign in (1.0, -1.0):
            with torch.no_grad():
                parameter += sign * along
                ends.append(float(value()))
                parameter -= sign * along
        expected = 0.5 * (ends[0] - ends[1])
        assert float((gradient * along).sum()) == pytest.approx(expected, rel=0.01)
