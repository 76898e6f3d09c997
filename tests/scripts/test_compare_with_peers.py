"""scripts/compare_with_peers.py: rays that other programs trace too, and how far theirs are off."""

import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.prescriptions.zemax.samples import lens_of, triplet

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


@pytest.fixture
def script(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(SCRIPTS), *sys.path])
    return importlib.import_module("compare_with_peers")


class Shifted:
    """A program whose rays land 1 µm beside ours, along paths 2 µm longer, in its own unit."""

    def __init__(self, bundles, unit, surfaces=6):
        self.bundles, self.unit, self.surfaces = iter(bundles), unit, surfaces

    def indices(self, wavelength):
        return [1.0] * (self.surfaces + 1)

    def trace(self, rays, indices):
        ours = next(self.bundles)
        assert np.allclose(rays.position * self.unit, ours.position)
        return np.add(ours.landed, [1e-3, 0.0, 0.0]) / self.unit, (ours.path + 2e-3) / self.unit


@pytest.mark.parametrize("unit", [1.0, 25.4], ids=["mm", "inches"])
def test_differences_are_those_of_the_program(script, unit, tmp_path):
    lens = lens_of(triplet(), tmp_path)
    bundles = list(script.traced(lens))
    assert [b.wavelength for b in bundles] == [486.1327, 587.5618, 656.2725]
    found = script.compared(lens, bundles, Shifted(bundles, unit), unit)
    assert found["point"] == pytest.approx(1e-3, rel=1e-9)
    assert found["path"] == pytest.approx(2e-3, rel=1e-9)
    assert (found["rays"], found["lost"]) == (sum(len(b.path) for b in bundles), 0)
    with pytest.raises(script.UnlikeError, match="5 surfaces for 6"):
        script.compared(lens, bundles, Shifted(bundles, unit, surfaces=5), unit)


def test_a_folder_is_compared_with_what_is_installed(script, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "lenses"
    folder.mkdir()
    (folder / "triplet.zmx").write_text(triplet())
    (folder / "none.zmx").write_text("MODE NSC\n")
    monkeypatch.setattr(script, "installed", list)
    out = tmp_path / "rows.json"
    monkeypatch.setattr(sys, "argv", ["compare", str(folder), "--out", str(out)])
    script.main()
    assert "neither Optiland nor ray-optics is installed" in capsys.readouterr().out
    rows = json.loads(out.read_text())
    assert list(rows["none.zmx"]) == ["refused"]
    assert rows["triplet.zmx"] == {}
