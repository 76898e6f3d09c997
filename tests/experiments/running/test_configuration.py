"""An experiment that inherits another leaves out, or replaces, what its parent has."""

import pytest
import yaml

from dolens.errors import InputError
from dolens.experiments.running.configuration import checked
from tests.experiments.tiny_experiment import ONE_EPOCH, QUIET, UNPICTURED

HEADER = "# @package _global_\ndefaults:\n"


@pytest.fixture
def inherited(composed, tmp_path):
    """Compose an experiment that is a file in a folder of the user's own."""
    folder = tmp_path / "mine" / "experiment"
    folder.mkdir(parents=True)

    def compose(text: str, *overrides: str, name: str = "mine", make=composed):
        (folder / f"{name}.yaml").write_text(HEADER + text, encoding="utf-8")
        where = f"hydra.searchpath=[file://{folder.parent}]"
        return make(f"experiment={name}", where, *overrides)

    return compose


def test_a_variable_of_the_parent_is_dropped(inherited):
    cfg = checked(
        inherited(
            "  - wavefront_coding\n  - _self_\n"
            "variables: {surfaces.5.x2y: drop, surfaces.5.xy2: drop, surfaces.1.curvature: null}\n"
        )
    )
    names = ["sensor_distance", "surfaces.5.x3", "surfaces.5.y3", "surfaces.1.curvature"]
    assert list(cfg.variables) == names
    # Which is what the module is given.
    assert list(cfg.module.variables) == names


def test_a_grandchild_takes_up_what_its_parent_dropped(inherited):
    inherited("  - wavefront_coding\n  - _self_\nvariables: {surfaces.5.x3: drop}\n", name="parent")
    cfg = checked(
        inherited("  - parent\n  - _self_\nvariables: {surfaces.5.x3: {scale: 2.0e-5}}\n")
    )
    assert cfg.variables["surfaces.5.x3"] == {"scale": 2.0e-5}


def test_the_parent_s_variables_are_replaced_as_a_whole(inherited):
    cfg = checked(
        inherited(
            "  - nikon\n  - /without: variables\n  - _self_\n"
            "variables: {surfaces.1.curvature: null, sensor_distance: {solve: best_focus}}\n"
        )
    )
    assert list(cfg.module.variables) == ["surfaces.1.curvature", "sensor_distance"]


def test_a_run_records_the_table_of_cells_that_its_lens_names(composed, tmp_path):
    file = tmp_path / "pillars.csv"
    file.write_text("width_nm wavelength_nm phase_rad power\n80 540 0.1 0.9\n120 540 0.7 0.8\n")
    element = f"+lens.surfaces.2.diffractive.cells={file}"
    cfg = checked(composed("experiment=diffractive_achromat", element))
    file.unlink()
    rows = cfg.lens.surfaces["2"].diffractive.cells
    assert [list(row)[:3] for row in rows[1:]] == [[80.0, 540.0, 0.1], [120.0, 540.0, 0.7]]


def test_the_command_line_drops_and_replaces_too(composed):
    cfg = checked(composed("experiment=asphere", "variables={surfaces.1.conic: drop}"))
    assert list(cfg.variables) == ["surfaces.1.curvature", "surfaces.1.a4"]
    cfg = checked(
        composed("experiment=asphere", "+without=variables", "+variables={surfaces.1.conic: null}")
    )
    assert list(cfg.variables) == ["surfaces.1.conic"]


@pytest.mark.parametrize(
    ("parent", "override", "left"),
    [
        ("cooke_sensitivity", "tolerances: {'thicknesses.[135]': drop}", 4),
        ("misalignment", "fits: {'30': drop, '25': drop}", 3),
        ("wavefront_coding", "miscalibrations: {noise: drop}", 2),
        ("wavefront_coding", "callbacks: {pictures: drop}", 8),
        ("speed_vs_error", "scenes: {nikon: drop}", 3),
    ],
)
def test_every_mapping_s_entries_can_be_dropped(inherited, parent, override, left):
    cfg = checked(inherited(f"  - {parent}\n  - _self_\n{override}\n"))
    assert len(cfg[override.split(":")[0]]) == left


@pytest.mark.parametrize(
    "entry", ["variables: {surfaces.5.x4: drop}", "fits: {'3': drop}", "seed: {later: drop}"]
)
def test_dropping_what_no_parent_has_is_one_line(inherited, entry):
    with pytest.raises(InputError, match="nothing to drop: no parent of experiment=mine") as caught:
        checked(inherited(f"  - wavefront_coding\n  - _self_\n{entry}\n"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("module", "missing"), [("camera", "learning_rates.optics"), ("tolerances", "fields")]
)
def test_a_setting_that_an_experiment_must_make_is_named(inherited, module, missing):
    with pytest.raises(InputError, match=f"^{missing}: must be given; neither experiment=mine"):
        checked(inherited(f"  - override /module: {module}\n  - override /lens: nikon\n"))


def test_the_run_folder_has_what_is_left(inherited, trained):
    dropped = "  - asphere\n  - _self_\nvariables: {surfaces.1.a4: drop}\n"
    short = ("data.iterations=1", ONE_EPOCH, UNPICTURED, QUIET)
    found = inherited(dropped, *short, make=trained)
    resolved = yaml.safe_load((found.folder / ".hydra/resolved.yaml").read_text())
    left = ["surfaces.1.curvature", "surfaces.1.conic"]
    assert list(resolved["variables"]) == list(resolved["module"]["variables"]) == left
