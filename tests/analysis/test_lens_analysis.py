"""Spots, ray fans, modulation and RMS curves, against closed forms and other routes."""

import copy
import math

import numpy as np
import pytest
import torch
from scipy.special import j1

from dolens import load_lens
from dolens.analysis.conditions import conditions
from dolens.analysis.modulation_transfer import modulation
from dolens.analysis.pupil_quadrature import gaussian_quadrature, uniform_pupil_points
from dolens.analysis.ray_intercepts import ray_fans, trace_ray_intercepts
from dolens.analysis.spot_diagram import rms_against_field, rms_against_wavelength, spot_diagram
from dolens.errors import InputError
from dolens.optics.paraxial import chief_ray_magnification
from dolens.optimize.ray_intercept_quality import RayInterceptResiduals
from dolens.prescriptions import lens_from_prescription

LINES = (656.2725, 587.5618, 486.1327)
FOCAL, RADIUS, INDEX, DEFOCUS = 100.0, 4.0, 1.5, 0.5


@pytest.fixture(scope="module")
def triplet(root):
    return load_lens(root / "conf/lens/cooke_triplet.yaml").requires_grad_(False)


@pytest.fixture(scope="module")
def defocused():
    """A plano-hyperbolic lens, k = -n², without spherical aberration; the sensor is behind focus.

    Its index does not disperse, so that every wavelength has the same spot.
    """
    return lens_from_prescription(
        {
            "stop": 1,
            "surfaces": {
                "1": {"type": "plane", "semi_diameter": RADIUS, "thickness": 3.0,
                      "material": INDEX},
                "2": {"type": "conic", "radius": -(INDEX - 1.0) * FOCAL, "conic": -(INDEX**2),
                      "semi_diameter": 2.0 * RADIUS, "material": "air"},
            },
            "sensor": {"distance": FOCAL + DEFOCUS},
        }
    ).requires_grad_(False)  # fmt: skip


def hyperbola_slopes(height):
    """tan u' of rays that leave the hyperboloid at a height for its focus."""
    c = -1.0 / ((INDEX - 1.0) * FOCAL)
    sag = c * height**2 / (1.0 + np.sqrt(1.0 - (1.0 - INDEX**2) * c**2 * height**2))
    return height / (FOCAL - sag)


def test_pupil_points_fill_the_disc_uniformly():
    points, weight = uniform_pupil_points(1000)
    assert float(weight.sum()) == pytest.approx(1.0)
    inner = points[weight > 0.0]
    assert len(inner) == 1000 and torch.all(points.norm(dim=-1) < 1.0)
    # ∫ρ² dA / π, to rounding, and mirror images in x and y.
    assert float(inner.square().sum(-1).mean()) == pytest.approx(0.5, rel=1e-14)
    assert torch.all(inner.sum(0).abs() < 1e-12)
    for x, y, radius in ((0.0, 0.0, 0.93), (0.0, 0.4, 0.5), (-0.3, 0.2, 0.4)):
        share = ((inner - torch.tensor([x, y])).norm(dim=-1) < radius).double().mean()
        assert float(share) == pytest.approx(radius**2, abs=0.01)
    for wrong in (0, 6):
        with pytest.raises(InputError, match="multiple of four"):
            uniform_pupil_points(wrong)


def test_defocus_alone_makes_a_disc(defocused):
    """The disc's radius is δ·tan u'; its RMS is that over √2, but for the change of u' with ρ."""
    spots = spot_diagram(defocused, conditions(defocused, [(0.0, 0.0)], LINES[:2]), rays=400)
    edge = DEFOCUS * hyperbola_slopes(RADIUS)
    assert spots.geo.tolist() == [pytest.approx([edge] * 2, rel=3e-4)]
    height = RADIUS * np.sqrt((np.arange(1000) + 0.5) / 1000)
    rms = DEFOCUS * math.sqrt(np.mean(hyperbola_slopes(height) ** 2))
    assert spots.rms.tolist() == [pytest.approx([rms] * 2, rel=1e-5)]
    assert float(spots.polychromatic_rms) == pytest.approx(rms, rel=1e-5)
    assert torch.all(spots.centroid.abs() < 1e-12)


def test_airy_radius_is_that_of_the_f_number(defocused):
    spots = spot_diagram(defocused, conditions(defocused, [(0.0, 0.0)], LINES), rays=4)
    expected = [1.22 * line * 1e-6 * FOCAL / (2.0 * RADIUS) for line in LINES]
    assert spots.airy_radius.tolist() == pytest.approx(expected, rel=5e-4)


def test_defocus_makes_straight_fans(defocused):
    fans = ray_fans(defocused, conditions(defocused, [(0.0, 0.0)], LINES[1:2]), count=9)
    # Behind the focus, rays from above land below: -δ·tan u', nearly -δ·a/f·p.
    expected = -1e3 * DEFOCUS * hyperbola_slopes(RADIUS * fans.coordinate.numpy())
    for fan in (fans.tangential_um, fans.sagittal_um):
        np.testing.assert_allclose(fan[0, 0], expected, atol=1e-6)
    slope = np.polyfit(fans.coordinate, fans.tangential_um[0, 0], 1)[0]
    assert slope == pytest.approx(-1e3 * DEFOCUS * RADIUS / FOCAL, rel=2e-3)


def test_modulation_of_defocus_is_that_of_a_disc(defocused):
    """Goodman: 2·J₁(x)/x with x = 2πν·(radius of the disc)."""
    frequency = torch.linspace(1.0, 60.0, 20)
    mtf = modulation(defocused, conditions(defocused, [(0.0, 0.0)], LINES[1:2]), frequency)
    x = 2.0 * math.pi * frequency.numpy() * DEFOCUS * RADIUS / FOCAL
    for curve in (mtf.tangential, mtf.sagittal):
        np.testing.assert_allclose(curve[0], np.abs(2.0 * j1(x) / x), atol=5e-3)


@pytest.mark.parametrize("name", ["cooke_triplet", "double_gauss", "nikon", "asphere"])
def test_fitted_rays_land_where_aimed_ones_do(root, name):
    lens = load_lens(root / f"conf/lens/{name}.yaml").requires_grad_(False)
    edge = lens.fields.points[-1] if lens.fields else (0.0, 10.0)
    pupil = uniform_pupil_points(40)[0][:40]
    where = conditions(lens, [edge, (3.0, 0.0)], LINES[1:2])
    fitted = trace_ray_intercepts(lens, where, pupil)
    aimed = trace_ray_intercepts(lens, where, pupil, exact=True)
    valid = aimed.valid & fitted.valid
    assert (aimed.valid == fitted.valid).double().mean() > 0.95 and valid.sum() > 10
    spread = (aimed.points - aimed.chief[:, None, None])[valid].norm(dim=-1).max()
    assert (aimed.points - fitted.points)[valid].norm(dim=-1).max() < 1e-3 * spread
    assert torch.equal(aimed.chief, fitted.chief) or torch.allclose(aimed.chief, fitted.chief)


def test_a_fitted_ray_is_exactly_one_of_its_object_point():
    """A lens without power images nothing: rays of an object point go straight on through it."""
    window = lens_from_prescription(
        {
            "stop": 1,
            "surfaces": {"1": {"type": "plane", "semi_diameter": 5.0, "material": "air"}},
            "sensor": {"distance": 20.0},
        }
    )
    pupil, _ = uniform_pupil_points(8)
    found = trace_ray_intercepts(window, conditions(window, [(1.0, -3.0)], LINES[:1], 50.0), pupil)
    point = torch.tensor([1.0, -3.0]).double()
    # From (x, y, -50) through 5p in z = 0 to z = 20.
    expected = point + (5.0 * pupil - point) * 70.0 / 50.0
    assert torch.allclose(found.points[0, 0], expected, atol=1e-9)


def test_spots_of_the_triplet_are_those_of_gauss_s_quadrature(root):
    """Whose rays fill the stop at the reference wavelength, while ours do at each."""
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml").requires_grad_(False)
    lens.reference_wavelength = LINES[2]
    fields = [(0.0, 0.0), (0.0, 10.0), (0.0, 20.0)]
    spots = spot_diagram(lens, conditions(lens, fields, LINES[2:]), rays=6000)
    rays = gaussian_quadrature(lens, fields, LINES[2:], rings=6, arms=24)
    expected = RayInterceptResiduals(rays, torch.ones(rays.count)).values(lens).rms
    assert float(spots.rms[0]) == pytest.approx(float(expected[0]), rel=1e-4)
    assert spots.rms[:, 0].tolist() == pytest.approx(expected.tolist(), rel=1e-2)
    assert torch.all(spots.geo > spots.rms)


def test_spots_of_the_triplet_are_near_those_of_the_reference_grid(triplet, reference):
    """Its 31×31 rays fill the entrance pupil, and some 193 of them pass."""
    entries = reference("rms_triplet__dfc.json")["entries"]
    fields = [(0.0, angle) for angle in (0.0, 10.0, 20.0)]
    rms = dict(
        zip(fields, spot_diagram(triplet, conditions(triplet, fields, LINES)).rms, strict=True)
    )
    assert len(entries) == 9
    for entry in entries:
        found = rms[0.0, float(entry["view_deg"])][LINES.index(float(entry["wavelength"]))]
        assert 1e3 * float(found) == pytest.approx(float(entry["rms_um"]), rel=0.05)


def test_a_finite_object_is_imaged_at_its_magnification(triplet):
    spots = spot_diagram(triplet, conditions(triplet, [(0.0, 0.1)], LINES[1:2], 800.0), rays=100)
    expected = 0.1 * float(chief_ray_magnification(triplet.system(), LINES[1], 800.0))
    assert float(spots.chief[0, 1]) == pytest.approx(expected, rel=1e-3)
    assert spots.field_unit == "mm"


def test_a_lens_in_single_precision_is_analysed_in_double(root, triplet):
    single = load_lens(root / "conf/lens/cooke_triplet.yaml", dtype=torch.float32)
    spots = spot_diagram(single, conditions(single, [(0.0, 14.0)], LINES[:1]), rays=200)
    assert spots.intercepts.dtype == torch.float64 and single.dtype == torch.float32
    expected = spot_diagram(triplet, conditions(triplet, [(0.0, 14.0)], LINES[:1]), rays=200).rms
    assert torch.allclose(spots.rms, expected, rtol=1e-3)


def test_fans_of_a_meridional_field_are_symmetric_about_its_plane(triplet):
    fans = ray_fans(triplet, conditions(triplet, [(0.0, 0.0), (0.0, 14.0)], LINES), count=21)
    assert torch.allclose(fans.sagittal_um, -fans.sagittal_um.flip(-1), atol=1e-8)
    # On the axis both are the same.
    assert torch.allclose(fans.sagittal_um[0], fans.tangential_um[0], atol=1e-8)
    # Vignetted from below.
    assert torch.isnan(fans.tangential_um[1, :, 0]).all()
    assert not torch.isnan(fans.tangential_um[1, :, 10]).any()


def test_fans_cross_at_the_lateral_colour(triplet):
    field = (0.0, 20.0)
    fans = ray_fans(triplet, conditions(triplet, [field], LINES), count=3)
    height = {w: float(triplet.trace(triplet.chief_ray(field, w)).position[1]) for w in LINES}
    for number, line in enumerate(LINES):
        expected = 1e3 * (height[line] - height[587.5618])
        assert float(fans.tangential_um[0, number, 1]) == pytest.approx(expected, abs=1e-7)


def test_modulation_turns_with_the_field(triplet):
    frequency = [0.0, 10.0, 25.0, 50.0]
    fields = [(0.0, 14.0), (14.0, 0.0)]
    mtf = modulation(triplet, conditions(triplet, fields, LINES), frequency)
    for curves in (mtf.tangential, mtf.sagittal):
        assert torch.allclose(curves[0], curves[1], atol=5e-3)
        assert curves[:, 0].tolist() == pytest.approx([1.0, 1.0])
    assert (mtf.tangential - mtf.sagittal).abs().max() > 0.1


def test_weights_choose_among_wavelengths(triplet):
    field, frequency = [(0.0, 14.0)], [20.0]
    alone = modulation(triplet, conditions(triplet, field, LINES[:1]), frequency)
    chosen = modulation(
        triplet, conditions(triplet, field, LINES, wavelength_weights=(2.0, 0.0, 0.0)), frequency
    )
    assert chosen.tangential.tolist() == [pytest.approx(alone.tangential[0].tolist())]
    assert chosen.diffraction_limit.tolist() == pytest.approx(alone.diffraction_limit.tolist())
    spots = spot_diagram(
        triplet, conditions(triplet, field, LINES, wavelength_weights=(0.0, 0.0, 1.0)), rays=200
    )
    assert float(spots.polychromatic_rms) == pytest.approx(float(spots.rms[0, 2]))
    for wrong in ((1.0, 1.0), (1.0, -1.0, 1.0), (0.0, 0.0, 0.0)):
        with pytest.raises(InputError, match="wavelength_weights"):
            spot_diagram(triplet, conditions(triplet, field, LINES, wavelength_weights=wrong))


def test_curves_are_the_spots_of_their_fields_and_wavelengths(triplet):
    curves = rms_against_field(
        triplet, conditions(triplet, wavelengths=LINES), (0.0, 20.0), count=3, rays=400
    )
    assert curves.fields.tolist() == [[0.0, 0.0], [0.0, 10.0], [0.0, 20.0]]
    spots = spot_diagram(triplet, conditions(triplet, [(0.0, 10.0)], LINES), rays=400)
    assert torch.allclose(curves.rms[1], spots.rms[0])
    assert torch.allclose(curves.polychromatic[1], spots.polychromatic_rms[0])
    curves = rms_against_wavelength(
        triplet, conditions(triplet, [(0.0, 10.0)]), (486.1327, 656.2725), 2, rays=400
    )
    assert torch.allclose(curves.rms[0], spots.rms[0, [2, 0]])


def test_fields_that_do_not_pass_are_nan(triplet):
    """Beyond some 31° the triplet's apertures overlap no more."""
    curves = rms_against_field(
        triplet, conditions(triplet, wavelengths=LINES[:1]), (0.0, 45.0), count=4, rays=100
    )
    assert torch.isnan(curves.rms[:, 0]).tolist() == [False, False, False, True]
    assert torch.isnan(curves.polychromatic).tolist() == [False, False, False, True]
    mtf = modulation(triplet, conditions(triplet, [(0.0, 35.0)], LINES[:1]), [0.0, 1.0])
    assert torch.isnan(mtf.tangential).all() and not torch.isnan(mtf.diffraction_limit).any()


def test_the_lens_s_own_field_and_spectrum_are_the_defaults(root, triplet):
    lens = load_lens(root / "conf/lens/double_gauss.yaml")
    curves = rms_against_field(lens, conditions(lens, wavelengths=LINES[:1]), count=2, rays=8)
    assert curves.fields[-1].tolist() == [0.0, 22.0]
    curves = rms_against_wavelength(lens, conditions(lens, [(0.0, 0.0)]), count=3, rays=8)
    assert curves.wavelengths[[0, -1]].tolist() == [486.1327, 656.2725]
    bare = copy.copy(triplet)
    bare.fields = bare.wavelengths = None
    where = conditions(bare, wavelengths=LINES[:1])
    curves = rms_against_field(bare, where, count=2, rays=8)
    assert curves.fields[-1].tolist() == where.fields[-1].tolist()
    with pytest.raises(InputError, match="interval"):
        rms_against_wavelength(bare, conditions(bare, [(0.0, 0.0)]))


@pytest.mark.parametrize(
    ("fields", "lines"), [([], LINES), ([(0.0, 1.0, 2.0)], LINES), ([(0.0, 0.0)], [])]
)
def test_what_is_no_field_or_wavelength_is_refused(triplet, fields, lines):
    with pytest.raises(InputError, match="at least one"):
        conditions(triplet, fields, lines)


def test_parameters_keep_no_graph(root):
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml")
    assert not spot_diagram(
        lens, conditions(lens, [(0.0, 0.0)], LINES[:1]), rays=8
    ).rms.requires_grad
