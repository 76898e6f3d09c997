"""Coatings in prescriptions: what they do to light, round trips, and what is refused."""

import math

import pytest
import torch

import dolens
from dolens import InputError, Rays
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.thin_films import Layer, shares
from dolens.prescriptions.build import lens_from_prescription, prescription_of
from dolens.prescriptions.coatings import coated


def plate(coating=None, **more):
    """A plane plate of index 1.5 in air."""
    rows = {
        "1": {"type": "plane", "semi_diameter": 5.0, "thickness": 2.0, "material": "1.5"},
        "2": {"type": "plane", "semi_diameter": 5.0, "material": "air"},
    }
    if coating is not None:
        rows["1"]["coating"] = coating
    return {"name": "plate", "surfaces": rows, "sensor": {"distance": 10.0}, **more}


def passed(prescription, angle=0.0, wavelength=550.0, **options):
    """The share of light that a ray at an angle (degrees) keeps."""
    lens = lens_from_prescription(prescription)
    tilt = math.radians(angle)
    direction = torch.tensor([0.0, math.sin(tilt), math.cos(tilt)], dtype=torch.float64)
    rays = Rays(torch.zeros(3, dtype=torch.float64), direction, wavelength)
    return float(lens.trace(rays, transmission=True, **options).transmission.detach())


def test_without_a_coating_all_light_passes():
    assert passed(plate()) == passed(plate("ideal")) == 1.0
    lens = lens_from_prescription(plate())
    rays = Rays(torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    assert lens.trace(rays).transmission is None


def test_bare_glass_loses_by_fresnel():
    one = 1.0 - (0.5 / 2.5) ** 2
    assert passed(plate("none")) == pytest.approx(one, rel=1e-14)
    assert passed(plate(coating="none")) == pytest.approx(one, rel=1e-14)
    both = plate()
    both["coating"] = "none"
    assert passed(both) == pytest.approx(one**2, rel=1e-14)


def test_at_an_angle_both_polarisations_count_half():
    angle, inside = math.radians(50.0), math.asin(math.sin(math.radians(50.0)) / 1.5)
    s = 1.0 - (math.sin(angle - inside) / math.sin(angle + inside)) ** 2
    p = 1.0 - (math.tan(angle - inside) / math.tan(angle + inside)) ** 2
    assert passed(plate("none"), 50.0) == pytest.approx(0.5 * (s + p), rel=1e-13)


def test_quarter_wave():
    n = 1.38
    known = 1.0 - ((1.5 - n * n) / (1.5 + n * n)) ** 2
    given = {"quarter_wave": 550, "material": 1.38}
    assert passed(plate(given)) == pytest.approx(known, rel=1e-13)
    layers = [{"material": 1.38, "thickness": 550 / 4 / n}]
    assert passed(plate(layers), 30.0) == pytest.approx(passed(plate(given), 30.0), rel=1e-13)
    # Magnesium fluoride's index is 1.3785 at 550 nm (Dodge 1984).
    assert passed(plate("quarter_wave")) == pytest.approx(known, abs=3e-4)


def test_one_coating_for_the_lens_leaves_cemented_surfaces_bare():
    rows = {
        "1": {"radius": 50, "semi_diameter": 5, "thickness": 3, "material": "N-BK7"},
        "2": {"radius": -40, "semi_diameter": 5, "thickness": 2, "material": "N-SF5"},
        "3": {"radius": -200, "semi_diameter": 5, "thickness": 1, "material": "air"},
        "4": {"type": "plane", "semi_diameter": 4, "material": "air"},
    }
    given = {"name": "x", "coating": "quarter_wave", "surfaces": rows, "sensor": {"distance": 90}}
    lens = lens_from_prescription(given)
    layers = [None if s.coating is None else len(s.coating.films) for s in lens.surfaces.values()]
    assert layers == [1, 0, 1, None]
    given["surfaces"]["1"]["coating"] = "ideal"
    lens = lens_from_prescription(given)
    assert [s.coating is None for s in lens.surfaces.values()] == [True, False, False, True]


SILVER = [0.055, 3.32]
FORMS = {
    "bare": "none",
    "layers": [{"material": "MGF2", "thickness": 99.7}, {"material": "1.9/30", "thickness": 70}],
    "constants": [{"material": [[400, 0.1, 2.0], [700, 0.2, 4.0]], "thickness": 20}],
    "metal": [{"material": SILVER, "thickness": 12.5}],
    "table": {
        "table": [
            [nm, angle, 0.01, 0.02 + 1e-4 * angle, 0.98, 0.9]
            for nm in (400, 700)
            for angle in (0, 40)
        ]
    },
}


@pytest.mark.parametrize("form", FORMS)
def test_a_coating_is_written_and_read_to_the_last_bit(form):
    lens = lens_from_prescription(plate(FORMS[form]))
    again = lens_from_prescription(prescription_of(lens))
    assert prescription_of(again) == prescription_of(lens)
    here, there = (passed(prescription_of(x), 33.0, 512.0) for x in (lens, again))
    assert here == there < 1.0


def test_layers_are_in_the_order_of_the_light_and_light_comes_back_alike():
    layers = FORMS["layers"]
    lens = lens_from_prescription(plate(layers))
    system = lens.system()
    films = [
        Layer(f.index(550.0), t)
        for f, t in zip(lens.surfaces["1"].coating.films, (99.7, 70.0), strict=True)
    ]
    one = torch.ones((), dtype=torch.float64)
    known = float(shares(1.0, films, 1.5, one, 550.0).t_s)
    assert passed(plate(layers)) == pytest.approx(known, rel=1e-14)
    back = Rays(
        torch.tensor([0.0, 0.0, 12.0]).double(), torch.tensor([0.0, 0.0, -1.0]).double(), 550.0
    )
    assert float(lens.sensor_to_scene(back).valid)
    found = trace_rays(system, back, -1.0, transmission=True).transmission
    assert float(found) == pytest.approx(known, rel=1e-13)


def test_a_mirror_reflects_as_its_layers_and_substrate_do():
    rows = {"1": {"type": "plane", "semi_diameter": 5, "material": "mirror"}}
    given = {"surfaces": rows, "sensor": {"distance": -10.0}}
    rows["1"]["coating"] = {"layers": [], "substrate": SILVER}
    n = complex(*SILVER)
    assert passed(given) == pytest.approx(abs((n - 1) / (n + 1)) ** 2, rel=1e-13)
    lens = lens_from_prescription(given)
    assert prescription_of(lens)["surfaces"]["1"]["coating"] == rows["1"]["coating"]


def test_a_table_is_linear_between_its_rows():
    table = [
        [nm, a, 0.0, 0.0, 0.9 - 0.001 * a, 0.8 + nm / 1e4] for nm in (400, 600) for a in (0, 20, 60)
    ]
    assert passed(plate({"table": table}), 30.0, 450.0) == pytest.approx(
        0.5 * (0.87 + 0.845), rel=1e-12
    )
    with pytest.raises(InputError, match="coating: 650 nm lies outside, 400 to 600"):
        passed(plate({"table": table}), 0.0, 650.0)


def test_glass_absorbs_along_the_path(tmp_path):
    (tmp_path / "own.agf").write_text(
        "NM CLOUDY 2 0 1.5 60 0\nCD 1.25 0 0 0 0 0\nLD 0.3 2.0\nIT 0.4 0.5 10\nIT 0.6 0.9 10\n"
    )
    with dolens.optics.glass_catalog.glass_folders(tmp_path):
        given = plate()
        given["surfaces"]["1"]["material"] = "OWN:CLOUDY"
        inside = math.asin(math.sin(math.radians(30.0)) / 1.5)
        known = 0.9 ** (2.0 / math.cos(inside) / 10.0)
        assert passed(given, 30.0, 600.0) == pytest.approx(known, rel=1e-13)
        waves = torch.tensor([400.0, 600.0], dtype=torch.float64)
        lens = lens_from_prescription(given)
        axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        hit = lens.trace(Rays(torch.zeros(3).double(), axis, waves), transmission=True)
        assert hit.transmission.tolist() == pytest.approx([0.5**0.2, 0.9**0.2], rel=1e-13)


def test_coated_returns_a_copy():
    lens = dolens.load_lens("cooke_triplet")
    other = coated(lens, {1: "none", "2": [{"material": 1.38, "thickness": 100}]})
    assert all(surface.coating is None for surface in lens.surfaces.values())
    assert list(other.variables(["surfaces.*.coating.*"])) == ["surfaces.2.coating.thickness_1"]
    assert [s.coating is None for s in other.surfaces.values()] == [False, False] + 4 * [True]
    with pytest.raises(InputError, match="there is no surface 9"):
        coated(lens, {9: "none"})


@pytest.mark.parametrize("suffix", [".txt", ".zmx", ".seq"])
def test_formats_without_coatings_refuse_them(suffix, tmp_path):
    lens = dolens.load_lens("cooke_triplet").coated({2: "none"})
    with pytest.raises(InputError, match=f"surface 2: a {suffix} file cannot hold 'coating'"):
        dolens.save_lens(lens, tmp_path / f"lens{suffix}")


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_derivatives_of_the_share_are_those_of_differences(dtype):
    lens = coated(dolens.load_lens("cooke_triplet", dtype=dtype), "quarter_wave")
    names = ["surfaces.1.coating.thickness_1", "surfaces.4.curvature", "thicknesses.2"]
    aimed = lens.aim((0.0, 14.0), [(0.0, 0.5), (0.4, -0.6)], 450.0)
    stored = dict(lens.named_parameters())

    def share(name, value):
        return lens.with_values({name: value}).trace(aimed, transmission=True).transmission.sum()

    for name in names:
        value = stored[name].detach().clone().requires_grad_()
        slope = float(torch.autograd.grad(share(name, value), value)[0])
        if dtype is torch.float64:
            step = 1e-5 * max(1.0, abs(float(value.detach()))) * (1e-2 if "curv" in name else 1.0)
            around = [float(share(name, value.detach() + s * step)) for s in (1.0, -1.0)]
            assert slope == pytest.approx((around[0] - around[1]) / (2.0 * step), rel=1e-5)
        else:
            double = coated(dolens.load_lens("cooke_triplet"), "quarter_wave")
            value = dict(double.named_parameters())[name].detach().clone().requires_grad_()
            hit = double.with_values({name: value}).trace(aimed, transmission=True)
            known = float(torch.autograd.grad(hit.transmission.sum(), value)[0])
            assert slope == pytest.approx(known, rel=2e-3)


@pytest.mark.parametrize(
    ("coating", "message"),
    [
        ("quarter_waves", "did you mean 'quarter_wave'"),
        ({"layer": []}, "coating: has none of the keys quarter_wave, table, layers"),
        ({"layers": [], "colour": 1}, "coating: layers: unknown key 'colour'"),
        ([{"material": 1.5}], "coating: layer 1: 'thickness' is missing"),
        (
            [{"material": 1.5, "thickness": -1}],
            "coating: layer 1: 'thickness' must be 0 or more nm",
        ),
        ([{"material": "N-BK8", "thickness": 9}], "unknown material 'N-BK8'"),
        ([{"material": "mirror", "thickness": 9}], "a mirror is no layer"),
        ([{"material": [1.5], "thickness": 9}], "a complex index is"),
        ([{"material": [1.5, -1], "thickness": 9}], "k not negative, not 1.5, -1"),
        ([{"material": [[500, 1, 1], [400, 1, 1]], "thickness": 9}], "must rise"),
        ([1], "layer 1: must have 'material' and 'thickness'"),
        ({"layers": [], "substrate": SILVER}, "'substrate' is a mirror's"),
        ({"quarter_wave": 0}, "'quarter_wave' must be"),
        ({"table": []}, "'table' must be rows"),
        ({"table": [[550, 0, 0, 0, 1, 1]], "angles": "inside"}, "'angles'.*front, behind"),
        ({"table": [[550, 0, 0.5, 0.5, 0.6, 0.5]]}, "R \\+ T at most 1"),
        ({"table": [[550, 95, 0.5, 0.5, 0.5, 0.5]]}, "95°"),
        ({"table": 2 * [[550, 0, 0.5, 0.5, 0.5, 0.5]]}, "given twice"),
        ({"table": [[550, 0, 0, 0, 1, 1], [600, 10, 0, 0, 1, 1]]}, "550 nm at 10° is missing"),
    ],
)
def test_what_cannot_be_meant_is_refused_in_one_line(coating, message):
    with pytest.raises(InputError, match=message) as caught:
        lens_from_prescription(plate(coating), where="own.yaml")
    assert str(caught.value).startswith("own.yaml: surface 1") and "\n" not in str(caught.value)


def test_a_mirror_without_a_substrate_is_refused():
    rows = {"1": {"type": "plane", "semi_diameter": 5, "material": "mirror", "coating": "none"}}
    with pytest.raises(InputError, match="surface 1: coating: a mirror's needs the 'substrate'"):
        lens_from_prescription({"surfaces": rows, "sensor": {"distance": -10.0}})
