"""A program reads and writes within one folder: no other path leads anywhere."""

import os

import pytest

from dolens import InputError
from dolens.mcp.folder import Folder


@pytest.fixture
def folder(tmp_path):
    """A folder with a file and a folder, and beside it what must not be reached."""
    (tmp_path / "secret.yaml").write_text("secret")
    inside = tmp_path / "inside"
    (inside / "deep").mkdir(parents=True)
    (inside / "lens.yaml").write_text("a lens")
    (inside / "deep" / "lens.zmx").write_text("deep")
    (inside / "link.yaml").symlink_to(tmp_path / "secret.yaml")
    (inside / "away").symlink_to(tmp_path)
    os.mkfifo(inside / "pipe.yaml")
    return Folder(inside)


def test_files_of_the_folder_are_read_and_listed(folder):
    assert folder.read("lens.yaml", 100) == b"a lens"
    assert folder.read("deep/lens.zmx", 100) == b"deep"
    assert folder.files((".yaml", ".zmx")) == ["lens.yaml", "pipe.yaml", "deep/lens.zmx"]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("../secret.yaml", "leads out of the folder"),
        ("deep/../../secret.yaml", "leads out of the folder"),
        ("/etc/passwd", "leads out of the folder"),
        ("~/secret.yaml", "leads out of the folder"),
        ("", "leads out of the folder"),
        ("a\0b.yaml", "leads out of the folder"),
        ("link.yaml", "is a link"),
        ("away/secret.yaml", "is a link"),
        ("none.yaml", "No such file"),
        ("deep", "is no file"),
        ("pipe.yaml", "is no file"),
        ("\udcff.yaml", "No such file"),
        ("x" * 300 + ".yaml", "File name too long"),
        ("a/" * 20 + "lens.yaml", "more than 8 folders deep"),
    ],
)
def test_no_other_path_is_read_or_written(folder, name, message):
    outside = folder.path.parent / "secret.yaml"
    with pytest.raises(InputError, match=message) as refused:
        folder.read(name, 100)
    assert "\n" not in str(refused.value)
    if name not in ("none.yaml", "\udcff.yaml"):
        with pytest.raises(InputError):
            folder.write(name, b"mine", overwrite=True)
    assert outside.read_text() == "secret"


def test_a_file_that_is_too_large_is_not_read(folder):
    with pytest.raises(InputError, match=r"lens\.yaml: is larger than 0 MB"):
        folder.read("lens.yaml", 5)


def test_only_what_was_written_in_this_session_is_written_over_unasked(folder):
    folder.write("new.yaml", b"one")
    folder.write("new.yaml", b"two")
    assert folder.read("new.yaml", 10) == b"two"
    with pytest.raises(InputError, match=r"lens\.yaml: exists already.*overwrite=true"):
        folder.write("lens.yaml", b"mine")
    assert folder.read("lens.yaml", 10) == b"a lens"
    folder.write("lens.yaml", b"mine", overwrite=True)
    assert folder.read("lens.yaml", 10) == b"mine"
    assert sorted(p.name for p in folder.path.iterdir() if "part" in p.name) == []


def test_a_folder_that_is_none_is_refused(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        Folder(tmp_path / "none")
