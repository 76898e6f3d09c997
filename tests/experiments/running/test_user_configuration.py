"""Modules of a user's own: the command line names them, and their surfaces are then known."""

import sys

import pytest
import yaml

from dolens import InputError
from dolens.experiments.running.finished_run import load_run
from dolens.experiments.running.user_configuration import import_extensions
from dolens.optics.surfaces import SURFACES, unregister_surface
from tests.experiments.conftest import finished_run

CYLINDER = """
import dolens
from dolens.optics.surfaces import Surface

@dolens.register_surface
class Cylinder(Surface):
    kind = "cylinder"

    @classmethod
    def parameter_names(cls, keys):
        return ["curvature_x"]

    @classmethod
    def sag_and_gradient(cls, p, x, y):
        c = p["curvature_x"]
        return 0.5 * c * x * x, c * x, 0.0 * y, None
"""
OWN = "surfaces_of_a_user"
WITH_CYLINDER = (
    "experiment=asphere",
    "lens.surfaces.2.type=cylinder",
    "~lens.surfaces.2.radius",
    "+lens.surfaces.2.curvature_x=1e-4",
    "data.iterations=1",
    "callbacks.pictures=null",
    "+trainer.enable_progress_bar=false",
)


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A module that registers a surface, importable while the test runs."""
    (tmp_path / f"{OWN}.py").write_text(CYLINDER)
    monkeypatch.syspath_prepend(tmp_path)
    yield OWN
    sys.modules.pop(OWN, None)
    if "cylinder" in SURFACES:
        unregister_surface("cylinder")


def test_a_lens_with_a_user_s_own_surface_is_designed(trained, module):
    folder = trained(*WITH_CYLINDER, f"extensions=[{module}]").folder
    final = yaml.safe_load((folder / "lens" / "final.yaml").read_text())
    assert final["surfaces"]["2"]["type"] == "cylinder"
    assert final["surfaces"]["2"]["curvature_x"] == pytest.approx(1e-4)


def test_a_finished_run_with_a_module_of_one_s_own_needs_trust(root, module, tmp_path):
    """Who loads it is told what it would import."""
    folder = finished_run(root, tmp_path, *WITH_CYLINDER, f"extensions=[{module}]")
    sys.modules.pop(module)
    unregister_surface("cylinder")
    with pytest.raises(InputError, match=rf"would import {module} \(extensions\); .* --trust"):
        load_run(folder)
    assert module not in sys.modules
    assert load_run(folder, trust=True).lens.surfaces["2"].kind == "cylinder"


def test_without_its_module_the_type_is_unknown(module, refused):
    refused("type 'cylinder' is unknown", *WITH_CYLINDER)


def test_a_prescription_names_no_module(composed, module, refused):
    """Where a lens's file has the key, it is one that no lens has."""
    refused("unknown key 'extensions'", "experiment=asphere", f"+lens.extensions=[{module}]")
    assert module not in sys.modules


@pytest.mark.parametrize(
    "written, wrong",
    [
        ("surfaces_of_nobody", "must be a list"),
        (["surfaces_of_nobody"], "no module named 'surfaces_of_nobody'"),
        (["surfaces_of_nobody.cylinders"], "no module named 'surfaces_of_nobody.cylinders'"),
        (["my_surfaces.py/.."], "is no module's name"),
    ],
)
def test_a_module_that_is_not_there_is_one_line(written, wrong):
    with pytest.raises(InputError, match=wrong):
        import_extensions(written)


def test_what_a_module_itself_fails_to_import_keeps_its_traceback(module, tmp_path):
    (tmp_path / f"{OWN}.py").write_text("import a_module_that_nobody_has\n")
    with pytest.raises(ModuleNotFoundError, match="a_module_that_nobody_has"):
        import_extensions([module])
