"""Lenses of catalogue glass: Snell's law, the lensmaker's equation, to a file and back."""

import math

import pytest
import torch
import yaml

from dolens import InputError, Rays, load_lens
from dolens.optics.glass_catalog import find_glass
from dolens.prescriptions import lens_from_prescription
from tests.lenses import lens_of_rows, prescription_of_rows

R1, R2, THICKNESS = 50.0, -80.0, 6.0


def singlet(material, **keys):
    rows = (R1, THICKNESS, material), (R2, 0.0, "air")
    return prescription_of_rows(*rows, semi_diameter=10.0, name="Singlet", **keys)


@pytest.mark.parametrize("name", ["N-BK7", "ohara:S-LAH79", "PMMA"])
@pytest.mark.parametrize("wavelength", [486.1327, 587.5618, 656.2725])
def test_the_lensmaker_s_equation(name, wavelength):
    lens = lens_from_prescription(singlet(name))
    n = find_glass(name).index(wavelength)
    power = (n - 1) * (1 / R1 - 1 / R2 + (n - 1) * THICKNESS / (n * R1 * R2))
    assert lens.first_order(wavelength).efl.item() == pytest.approx(1 / power, rel=1e-14)


def test_a_plate_shifts_each_colour_by_snell_s_law():
    """Shift along y of a slanted ray behind a plate: t (tan θ - tan θ'), sin θ = n sin θ'."""
    plate = {"type": "plane", "thickness": 10.0, "material": "N-SF11"}, {"type": "plane"}
    lens = lens_of_rows(*plate, semi_diameter=50.0, sensor=1.0)
    angle, wavelengths = math.radians(40.0), [450.0, 550.0, 650.0]
    rays = Rays(
        torch.zeros(3, 3, dtype=torch.float64),
        torch.tensor([0.0, math.sin(angle), math.cos(angle)], dtype=torch.float64).expand(3, 3),
        torch.tensor(wavelengths, dtype=torch.float64),
    )
    y = lens.trace(rays).position[:, 1].tolist()
    for height, wavelength in zip(y, wavelengths, strict=True):
        inside = math.asin(math.sin(angle) / find_glass("N-SF11").index(wavelength))
        assert height == pytest.approx(10.0 * math.tan(inside) + math.tan(angle), rel=1e-13)


def test_catalogue_glass_in_air_focuses_alike_under_every_index_model():
    """`do`'s air is 1.000293, and the catalogue's index is relative to air."""
    back = {
        model: lens_from_prescription(singlet("N-BK7", index_model=model)).first_order().bfd.item()
        for model in ("dfc", "do", "paper")
    }
    assert back["do"] == pytest.approx(back["dfc"], rel=1e-13)
    assert back["paper"] == back["dfc"]


@pytest.mark.parametrize(
    ("written", "name"),
    [("N-BK7", "SCHOTT:N-BK7"), ("SCHOTT:N-BK7", "SCHOTT:N-BK7"), ("1.50", "1.5"), ("2", "2.0")],
)
def test_a_file_may_write_glasses_and_numbers_bare(written, name, tmp_path):
    text = yaml.safe_dump(singlet("MATERIAL"), default_flow_style=None)
    (tmp_path / "lens.yaml").write_text(text.replace("MATERIAL", written))
    assert load_lens(tmp_path / "lens.yaml").materials[1].name == name


def test_a_wavelength_outside_the_glass_s_range():
    lens = lens_from_prescription(singlet("HIKARI:SF6"))
    with pytest.raises(InputError, match=r"HIKARI:SF6.* 850 nm lies outside its range, 400 to 700"):
        lens.first_order(850.0)
    ray = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    with pytest.raises(InputError, match="HIKARI:SF6"):
        lens.trace(Rays(-ray, ray, torch.tensor([550.0, 850.0])))
