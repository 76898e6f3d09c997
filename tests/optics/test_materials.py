"""Indices against tests/reference/index.json, and what is said of unknown materials."""

import math

import pytest
import torch

from dolens import InputError
from dolens.optics.materials import abbe_number, index_d, index_model, parse_material


@pytest.mark.parametrize("name", ["dfc", "do", "paper"])
def test_indices(reference, name):
    # `paper` has the lines of `do` and air 1 (tests/reference/README.md).
    data = reference("index.json")["data"]["do" if name == "paper" else name]
    model = index_model(name)
    assert model.lines == tuple(float(line) for line in data["lines_nm"])
    assert model.air == (1.0 if name == "paper" else float(data["n_air"]))
    assert len(data["materials"]) == 17
    for glass, expected in data["materials"].items():
        material = parse_material(glass, model)
        assert material.a == pytest.approx(float(expected["A"]), rel=1e-15)
        assert material.b == pytest.approx(float(expected["B_nm2"]), rel=1e-14)
        for wavelength, index in expected["n"].items():
            assert material.index(float(wavelength)) == pytest.approx(float(index), rel=1e-15)
        nm = torch.tensor([float(w) for w in expected["n"]], dtype=torch.float64)
        exact = torch.tensor([float(n) for n in expected["n"].values()], dtype=torch.float64)
        assert ((material.index(nm) - exact).abs() / exact).max() <= 2.3e-16 * 2


def test_media_without_dispersion():
    assert parse_material("air", index_model("do")).index(500.0) == 1.000293
    assert parse_material(" AIR ", index_model("dfc")).index(500.0) == 1.0
    assert parse_material("occluder", index_model("do")).index(500.0) == 1.0


@pytest.mark.parametrize("text", ["plexiglas", "1.5168/", "/64", "1.5168/64.17/x", "nan", ""])
def test_unknown_material(text):
    with pytest.raises(InputError, match=r"unknown material .*allowed: air, occluder, .*nd/Vd"):
        parse_material(text, index_model("dfc"))


@pytest.mark.parametrize(
    ("text", "meant"), [("aire", "air"), ("Arr", "air"), ("occluded", "occluder")]
)
def test_nearest_material(text, meant):
    with pytest.raises(InputError, match=f"unknown material '{text}'; did you mean '{meant}'"):
        parse_material(text, index_model("dfc"))


@pytest.mark.parametrize("text", ["0.09/60", "1.5/0", "15/60"])
def test_impossible_glass(text):
    with pytest.raises(InputError, match=f"material '{text}': nd must be from 0.1 to 10 and Vd"):
        parse_material(text, index_model("dfc"))


@pytest.mark.parametrize("model", ["dfc", "do", "paper"])
def test_a_number_is_the_index_at_every_wavelength(model):
    medium = parse_material(1.5, index_model(model))
    assert medium.index(200.0) == medium.index(5000.0) == 1.5
    for same in ("1.5", " 1.50 ", "15e-1"):
        assert parse_material(same, index_model(model)) == medium
    assert parse_material(medium.name, index_model(model)) == medium
    assert parse_material("1.5001", index_model(model)) != medium


@pytest.mark.parametrize("text", ["0.09", "-1.5", "0", "5165", "550.0", "1e999"])
def test_impossible_index(text):
    with pytest.raises(InputError, match=f"material '{text}': a constant index must be from 0.1"):
        parse_material(text, index_model("dfc"))


@pytest.mark.parametrize("text", ["0.99972", "0.9"])
def test_indices_below_that_of_air(text):
    """Vacuum has 0.99972 relative to air."""
    assert parse_material(text, index_model("dfc")).index(550.0) == float(text)


@pytest.mark.parametrize(("nd", "vd"), [(1.5168, 64.17), (1.80518, 25.43), (1.43875, 94.93)])
def test_index_and_abbe_number_come_back(nd, vd):
    """`dfc` stands on the very lines that nd and Vd are defined on."""
    glass = parse_material(f"{nd}/{vd}", index_model("dfc"))
    assert index_d(glass) == pytest.approx(nd, rel=1e-15)
    assert abbe_number(glass) == pytest.approx(vd, rel=1e-12)
    assert abbe_number(parse_material("air", index_model("dfc"))) == math.inf


def test_unknown_index_model():
    with pytest.raises(InputError, match="index_model 'dcf' is unknown; allowed: dfc, do, paper"):
        index_model("dcf")
