"""Lenses are loaded by name or path; a folder of files is checked, whatever they hold."""

import json

import pytest
from typer.testing import CliRunner

from dolens import InputError, load_lens
from dolens.cli.app import app
from dolens.prescriptions import lens_names
from dolens.prescriptions.files import check_file, lens_files, summary
from tests.prescriptions.zemax.samples import GLASS, singlet, triplet

GOOD = ("CURV 0.02", "DISZ 4", GLASS, "DIAM 5")


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "sub").mkdir()
    files = {
        "triplet.zmx": triplet().encode(),
        "sub/coated.ZMX": singlet(*GOOD, "COAT AR").encode(),
        "grin.zmx": singlet("TYPE GRINSUR7", *GOOD).encode(),
        "grin2.zmx": singlet(*GOOD).replace("CURV -0.02", "TYPE GRINSUR8\n  CURV -0.02").encode(),
        "noise.zmx": bytes(range(256)) * 3,
        "empty.yaml": b"",
        "readme.md": b"no lens",
    }
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    return tmp_path


def test_every_file_gets_a_line_and_every_reason_a_count(folder):
    done = CliRunner().invoke(app, ["check", str(folder)])
    assert done.exit_code == 1
    lines = done.output.splitlines()
    assert "2 of 6 files load" in lines
    assert any(line.startswith("refused grin.zmx: surface 1: a gradient-index") for line in lines)
    assert any("coated.ZMX: passed over: " in line and "coatings (COAT)" in line for line in lines)
    assert any(line.split()[:2] == ["2", ".zmx"] and "gradient-index" in line for line in lines)
    assert "Traceback" not in done.output


def test_the_exit_status_is_zero_where_all_load(folder):
    done = CliRunner().invoke(app, ["check", str(folder / "triplet.zmx"), "--json"])
    assert done.exit_code == 0
    found = json.loads(done.output)
    assert found["files"][0]["loads"] is True
    assert found["files"][0]["surfaces"] == 6
    assert found["summary"] == [{"format": ".zmx", "loads": True, "reason": "", "count": 1}]


def test_formats_are_chosen(folder):
    assert [path.name for path in lens_files(folder, ["yaml"])] == ["empty.yaml"]
    with pytest.raises(InputError, match=r"no lens file ends in \.pdf"):
        lens_files(folder, [".pdf"])
    with pytest.raises(InputError, match="no such file or folder"):
        lens_files(folder / "none")


def test_a_reason_is_counted_without_places_and_numbers(folder):
    (folder / "grin.zmx").write_text(singlet(*GOOD, head="OBNA 0.1 0\n"))
    (folder / "grin2.zmx").write_text(singlet(*GOOD, head="\nOBNA 0.2 0\n"))
    checks = [check_file(folder / name) for name in ("grin.zmx", "grin2.zmx")]
    reason = "a numerical aperture in object space needs a finite object"
    assert summary(checks) == [(".zmx", reason, 2)]


def test_a_bare_name_means_a_lens_of_the_package(root, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    lens = load_lens("cooke_triplet")
    assert lens.name == "Cooke triplet" and len(lens.surfaces) == 6
    names = lens_names()
    assert names == sorted(path.stem for path in (root / "conf/lens").glob("*.yaml"))


def test_an_unknown_name_is_answered_with_near_ones(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"did you mean 'cooke_triplet'.*nikon"):
        load_lens("cook_triplet")


def test_a_path_is_never_taken_for_a_name(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for path in ("conf/nikon", "nikon.yaml"):
        with pytest.raises(InputError, match=r"end in|cannot be read"):
            load_lens(path)
    (tmp_path / "nikon").write_text("no lens")
    with pytest.raises(InputError, match="end in"):
        load_lens("nikon")
