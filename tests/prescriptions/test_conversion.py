"""A lens file in another format says the same lens, and every change is told."""

import math

import pytest
from typer.testing import CliRunner

from dolens import InputError, load_lens
from dolens.cli.app import app
from dolens.prescriptions import load_prescription
from dolens.prescriptions.conversion import converted
from dolens.prescriptions.files import decode_prescription
from tests.lenses import prescription_of_rows
from tests.prescriptions.samples import SINGLET, require_same_parameters, with_row
from tests.prescriptions.zemax.samples import HEAD, TAIL, TRIPLET, standard, surface
from tests.refused import refused


def zemax_triplet():
    rows = [standard(n, *row) for n, row in enumerate(TRIPLET, 1)]
    rows[3] = rows[3].replace("  TYPE", "  STOP\n  TYPE", 1)
    image = surface(7, "TYPE STANDARD", "CURV 0.0", "DISZ 0", "DIAM 18.173 1 0 0 1")
    return HEAD + surface(0, "TYPE STANDARD", "CURV 0.0", "DISZ INFINITY") + "".join(rows) + image


@pytest.mark.parametrize("way", [(".txt", ".yaml"), (".zmx", ".txt"), (".yaml", ".zmx")])
def test_a_design_goes_around_through_every_format_to_the_last_bit(way, root, tmp_path):
    path = root / "conf/lens/double_gauss.yaml"
    for number, suffix in enumerate(way):
        new = tmp_path / f"{number}{suffix}"
        found = converted(load_prescription(path), str(path), str(new))
        new.write_bytes(found.data)
        assert (found.changes, found.same_numbers) == ([], True)
        path = new
    require_same_parameters(load_lens(root / "conf/lens/double_gauss.yaml"), load_lens(path))


@pytest.mark.parametrize(
    ("data", "suffix", "said"),
    [
        (with_row(note="front"), ".txt", ["lost: the remark on surface 1"]),
        (SINGLET | {"name": "a\nb"}, ".txt", ["the name 'a\\nb' became 'a b'"]),
        (
            SINGLET | {"elements": {"tube": {"surfaces": [1, 2]}}},
            ".txt",
            ["lost: the names of the elements tube (none has a pose)"],
        ),
        (
            SINGLET,
            ".zmx",
            [
                "added: wavelengths [587.5618], which a .zmx file always has",
                "added: reference_wavelength 587.5618, which a .zmx file always has",
                "added: fields angles [[0.0, 0.0]], which a .zmx file always has",
            ],
        ),
    ],
    ids=["remark", "name", "elements", "Zemax's wavelength and field"],
)
def test_what_a_format_drops_or_adds_is_said_and_bends_no_ray(data, suffix, said):
    found = converted(data, "old.yaml", f"new{suffix}")
    assert found.changes == said
    assert found.same_numbers


def test_another_index_model_is_told_with_its_effect_on_the_focal_length():
    found = converted(SINGLET | {"index_model": "do"}, "old.yaml", "new.zmx")
    assert not found.same_numbers
    assert found.changes[0].startswith("the index model 'do' became 'dfc'")
    assert found.changes[-1].startswith("the focal length at 587.562 nm is 28.33")
    assert found.after.index_model == "dfc"
    asked = converted(SINGLET, "old.yaml", "new.txt", "do")
    assert "index_model 'dfc' became 'do'" in asked.changes
    with pytest.raises(InputError, match="index_model: 'mine' is unknown"):
        converted(SINGLET, "old.yaml", "new.txt", "mine")


def test_catalogue_glass_becomes_its_published_nd_and_vd():
    found = converted(with_row(material="N-BK7"), "old.yaml", "new.txt")
    nd, vd = decode_prescription(found.data, "new.txt")["surfaces"]["1"]["material"].split("/")
    # Schott's data sheet.
    assert math.isclose(float(nd), 1.51680, abs_tol=5e-6)
    assert math.isclose(float(vd), 64.17, abs_tol=5e-3)
    assert found.changes[0].startswith("the glass N-BK7 behind surface 1 became 1.516800/64.1")
    # A formula of two terms errs by 1e-4 or so at the ends of the spectrum.
    assert "differs by up to 0.0001 from" in found.changes[0]


@pytest.mark.parametrize(
    ("data", "suffix", "said"),
    [
        (
            SINGLET | {"elements": {"1": {"surfaces": [1, 2], "tilt_x": 1.0}}},
            ".zmx",
            "a .zmx file cannot hold 'elements'",
        ),
        (
            with_row(semi_diameter=None, aperture={"half_width_x": 3.0, "half_width_y": 2.0}),
            ".txt",
            "surface 1: 'semi_diameter' is missing",
        ),
        (with_row(a18=1e-20), ".zmx", "surface 1: a .zmx file cannot hold 'a18'"),
    ],
    ids=["pose", "rectangle", "power"],
)
def test_what_would_bend_light_otherwise_is_refused(data, suffix, said):
    with refused(said, f"new{suffix}: "):
        converted(data, "old.yaml", f"new{suffix}")


def test_the_command_writes_whole_files_and_overwrites_none_unasked(tmp_path):
    def run(*arguments):
        return CliRunner().invoke(app, ["convert", *map(str, arguments)])

    old, new = tmp_path / "a.zmx", tmp_path / "b.yaml"
    old.write_text(zemax_triplet() + TAIL)
    first = run(old, new)
    assert first.exit_code == 0
    assert "b.yaml: written, 6 surfaces" in first.output
    assert (
        "  - passed over in a.zmx: drawing and colours (MIRR, SLAB); the merit function"
        in first.output
    )
    assert "the same to the last bit" in first.output
    written = new.read_bytes()
    assert float(load_lens(new).first_order().efl) == float(load_lens(old).first_order().efl)
    for arguments, said in (
        ((old, new), f"{new}: exists already; --force overwrites it"),
        ((new, new), f"{new}: is A itself; --force overwrites it"),
        ((old, tmp_path / "b.pdf"), "unknown suffix; lens files are written as .yaml, .yml, .zmx"),
        ((old, tmp_path / "b.stp"), "solids are written by 'dolens export LENS --only step'"),
        ((old, tmp_path / "none" / "b.txt"), "cannot be written (No such file or directory)"),
        ((tmp_path / "none.zmx", new), "cannot be read (No such file or directory)"),
    ):
        refused = run(*arguments)
        assert isinstance(refused.exception, InputError)
        assert said in str(refused.exception)
    assert new.read_bytes() == written
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.zmx", "b.yaml"]
    assert run(old, new, "--force").exit_code == 0


def test_a_plastic_whose_data_begin_at_437_nm_is_written_in_every_format():
    """Indices are compared as far as a medium's data go."""
    front = {"type": "sphere", "radius": 20.0, "thickness": 3.0, "material": "PLASTIC:ZEONEX-E48R"}
    sensor = {"distance": 36.0, "diameter": 10.0}
    keys = {"name": "plastic", "stop": 1, "wavelengths": [587.5618], "sensor": sensor}
    lens = prescription_of_rows(front, {"type": "plane"}, **keys)
    assert converted(lens, "plastic", "plastic.yaml").same_numbers
    (said, *_) = converted(lens, "plastic", "plastic.seq").changes
    assert "from 450 to 700 nm" in said
