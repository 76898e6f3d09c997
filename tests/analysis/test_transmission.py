"""What a lens passes: closed forms, the parts of it, and its derivative."""

import math

import pytest
import torch

import dolens
from dolens import InputError
from dolens.analysis.conditions import conditions
from dolens.analysis.pupil_quadrature import uniform_pupil_points
from dolens.analysis.transmission import transmission
from dolens.optics.glass_catalog import glass_folders
from dolens.prescriptions.build import lens_from_prescription
from dolens.prescriptions.coatings import coated


@pytest.fixture(scope="module")
def bare():
    return dolens.load_lens("cooke_triplet").coated("none")


def test_on_the_axis_of_a_slow_lens_fresnel_s_losses_multiply(bare):
    slow = bare.transmission(0.0, 587.5618, f_number=200.0)
    one = [(n - 1) ** 2 / (n + 1) ** 2 for n in (1.6204, 1.62, 1.6204)]
    known = math.prod((1.0 - r) ** 2 for r in one)
    assert float(slow.share) == pytest.approx(known, rel=1e-5)
    assert float(slow.surfaces.prod()) == pytest.approx(known, rel=1e-5)


def test_the_shares_of_surfaces_multiply_to_that_of_the_lens(bare):
    found = bare.transmission()
    assert found.share.shape == (3, 3) and found.surfaces.shape == (3, 3, 6)
    product = found.surfaces.prod(-1) * found.media.prod(-1)
    # Means of products are not products of means: by 1 % at the edge of the field.
    assert float((product - found.share).abs().max()) < 0.01
    assert bool((found.error < 1e-4).all())
    assert found.ideal == () and len(found.unknown) == 2


def test_an_uncoated_lens_is_ideal_and_says_so():
    found = dolens.load_lens("cooke_triplet").transmission(0.0, 550.0)
    assert float(found.share) == 1.0 and found.ideal == (1, 2, 3, 4, 5, 6)
    assert "6 of the surfaces are ideal" in repr(found)


def test_tables_name_fields_wavelengths_and_surfaces(bare):
    text = repr(bare.transmission([0.0, 14.0], [486.0, 588.0]))
    lines = text.splitlines()
    assert lines[1].split() == [
        "field",
        "(°)",
        "486",
        "nm",
        "(%)",
        "588",
        "nm",
        "(%)",
        "all",
        "(%)",
    ]
    assert [line.split()[0] for line in lines[5:11]] == list("123456")
    assert "<table" in bare.transmission(0.0, 588.0)._repr_html_()


def test_absorbing_glass_is_told_from_surfaces(tmp_path):
    (tmp_path / "own.agf").write_text(
        "NM GREY 2 0 1.5 60 0\nCD 1.25 0 0 0 0 0\nLD 0.3 2.0\nIT 0.4 0.8 10\nIT 0.7 0.8 10\n"
    )
    with glass_folders(tmp_path):
        rows = {
            "1": {"type": "plane", "semi_diameter": 1, "thickness": 5, "material": "OWN:GREY"},
            "2": {"type": "plane", "semi_diameter": 9, "material": "air"},
        }
        lens = lens_from_prescription({"surfaces": rows, "sensor": {"distance": 5}})
        found = transmission(lens, conditions(lens, [0.0], [550.0, 1000.0]))
    assert found.media[0, 0].tolist() == pytest.approx([1.0, 0.8**0.5, 1.0], rel=1e-12)
    assert found.share[0].tolist() == pytest.approx([0.8**0.5, 1.0], rel=1e-12)
    assert found.unknown == ("OWN:GREY",)  # at 1000 nm


def test_the_mean_is_over_the_beam_and_not_over_what_is_left_of_it(bare):
    """Of a coating that passes all at 0° and nothing at 60°, in collimated light on a sphere."""
    steep = {"table": [[nm, a, 0, 0, 1 - a / 60, 1 - a / 60] for nm in (400, 700) for a in (0, 60)]}
    lens = bare.coated("ideal").coated({1: steep})
    pupil, weight = uniform_pupil_points(4000)
    height = lens.aim((0.0, 0.0), pupil, 587.5618).position[:, :2].norm(dim=-1)
    share = 1.0 - torch.rad2deg(torch.asin(height / 22.01359)) / 60.0
    known = float((weight * share).sum())
    assert float(lens.transmission(0.0, 587.5618).share) == pytest.approx(known, abs=1e-4)


def test_what_passes_is_differentiable(bare):
    lens = coated(bare, "quarter_wave")
    name = "surfaces.3.coating.thickness_1"
    value = lens.variables([name])[name].detach().clone().requires_grad_()

    def share(thickness):
        given = lens.with_values({name: thickness})
        return transmission(given, conditions(given, [14.0], [450.0])).share.sum()

    slope = float(torch.autograd.grad(share(value), value)[0])
    step = 1e-3
    around = [float(share(value.detach() + s * step)) for s in (1.0, -1.0)]
    assert slope == pytest.approx((around[0] - around[1]) / (2 * step), rel=1e-6)


def test_the_figure_shows_fields_and_losses(bare):
    figure = bare.transmission([0.0, 14.0], [486.0, 588.0]).figure()
    left, right = figure.axes
    assert len(left.lines) == 2 and len(right.patches) == 6


def test_a_wavelength_beyond_a_coating_s_table_is_refused(bare):
    table = {"table": [[500, 0, 0, 0, 1, 1], [600, 0, 0, 0, 1, 1]]}
    with pytest.raises(InputError, match="700 nm lies outside, 500 to 600"):
        bare.coated({1: table}).transmission(0.0, 700.0)
