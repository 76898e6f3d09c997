"""A wavelength that is none of light, from 50 nm to 10 mm, is refused, and its unit is named."""

import json
import re

import pytest
import torch
import yaml
from typer.testing import CliRunner

from dolens import InputError, Rays, load_lens
from dolens.alignment.chart import Chart
from dolens.alignment.chart_model import ChartRays
from dolens.cli.app import app
from dolens.experiments.poses.bench import Bench
from dolens.experiments.settings import PupilRays, Spots
from dolens.lens_search.specification import Specification
from dolens.optimize import MeritSettings
from dolens.prescriptions.lens_formats import read_lens
from dolens.scene.planar import PlanarScene
from tests.prescriptions.codev.samples import TRIPLET as CODE_V
from tests.prescriptions.samples import SINGLET
from tests.prescriptions.test_completeness import PEERS
from tests.prescriptions.test_oslo import TRIPLET as OSLO
from tests.prescriptions.zemax.samples import triplet as zemax

AXIS = torch.zeros(1, 2, dtype=torch.float64)
START, AHEAD = torch.tensor([[[0.0, 0.0, -1.0]], [[0.0, 0.0, 1.0]]]).double()


@pytest.fixture(scope="module")
def lens(root):
    return load_lens(root / "conf/lens/cooke_triplet.yaml").requires_grad_(False)


def loaded(suffix, text):
    """A lens of a file of this text."""

    def load(lens, tmp_path):
        path = tmp_path / f"lens.{suffix}"
        path.write_text(text)
        return load_lens(path)

    return load


def written(suffix, text, pattern, unit=1.0):
    """A file in which what matches the pattern is the wavelength, of a unit in nm."""
    return lambda nm: loaded(suffix, re.sub(pattern, rf"\g<1>{nm / unit!r}", text, count=1))


def prescribed(**states):
    def of(nm):
        data = SINGLET | {"wavelengths": [nm]}
        if states:
            data = SINGLET | {"states": {"other": {"wavelengths": [nm]}}}
        return loaded("yaml", yaml.safe_dump(data))

    return of


def on_command_line(nm):
    def show(lens, tmp_path):
        words = ["show", "cooke_triplet", "--wavelength", repr(nm)]
        done = CliRunner().invoke(app, words)
        if done.exception is not None:
            raise done.exception

    return show


def of_optiland(nm):
    content = json.loads((PEERS / "optiland_rich.json").read_text())
    for wave in content["wavelengths"]["wavelengths"]:
        wave["value"] = 1e-3 * nm
    return loaded("json", json.dumps(content))


def of_ray_optics(nm):
    text = (PEERS / "ray_optics_rich.roa").read_text()
    return written("roa", text, r'("wavelengths":\s*\[\s*)[\d.]+')(nm)


def called(call):
    return lambda nm: lambda lens, tmp_path: call(lens, nm)


def search(nm):
    return Specification(50.0, 5.0, (0.0, 10.0), (nm,), (1, 1, 1), ("1.5168/64.17",), (1,))


ENTRIES = {
    "YAML": prescribed(),
    "YAML, a state": prescribed(other=True),
    ".zmx": written("zmx", zemax(), r"(?m)(^WAVM 1 )\S+", 1e3),
    ".seq": written("seq", CODE_V, r"(?m)(^WL\s+)[\d.]+"),
    ".len": written("len", OSLO, r"(?m)(^WV )\S+", 1e3),
    "Optiland": of_optiland,
    "ray-optics": of_ray_optics,
    "--wavelength": on_command_line,
    "a glass": called(lambda lens, nm: lens.materials[1].index(nm)),
    "first order": called(lambda lens, nm: lens.first_order(nm)),
    "aim": called(lambda lens, nm: lens.aim(AXIS, AXIS, nm)),
    "trace": called(lambda lens, nm: lens.trace(Rays(START, AHEAD, nm))),
    "spots": called(lambda lens, nm: lens.summary(wavelengths=[nm])),
    "merit.wavelengths": called(
        lambda lens, nm: MeritSettings(fields=[[0, 0]], wavelengths=[nm]).rays(lens)
    ),
    "wavelengths of tolerances": called(
        lambda lens, nm: Spots([[0.0, 0.0]], [nm], PupilRays(2, 6)).rays(lens)
    ),
    "wavelengths of a search": called(lambda lens, nm: search(nm)),
    "scene.wavelengths": called(lambda lens, nm: PlanarScene((1000.0,), (nm,))),
    "wavelengths of a chart": called(
        lambda lens, nm: ChartRays(lens, Chart(1e3, 1, 1, 2.0, 1.0), (nm,))
    ),
    "wavelength of a bench": called(lambda lens, nm: Bench(nm, None)),
}
IN_MICROMETRES = (".zmx", ".len", "Optiland")


@pytest.mark.parametrize("entry", ENTRIES)
def test_a_wavelength_in_another_unit_is_refused(entry, lens, tmp_path):
    unit, nm = ("µm", 1e-3) if entry in IN_MICROMETRES else ("nm", 1.0)
    # What is light is taken.
    ENTRIES[entry](550.0)(lens, tmp_path)
    for given in (0.55, 2e7, 49.0):
        with pytest.raises(InputError) as refused:
            ENTRIES[entry](given)(lens, tmp_path)
        message = str(refused.value)
        assert f"wavelength {nm * given:g} {unit}: allowed: 50 nm to 10 mm" in message
        assert f"(wavelengths are in {unit}" in message and "\n" not in message


def test_a_configuration_in_another_unit_is_passed_over_and_listed(tmp_path):
    text = zemax() + "MNUM 2 1\nWAVE 1 1 0.55\nWAVE 1 2 0.00055\n"
    found = read_lens(text.encode(), tmp_path / "lens.zmx")
    assert "wavelength 0.00055 µm: allowed: 50 nm to 10 mm" in found.passed_over[-1]
