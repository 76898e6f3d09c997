"""Files that a user names are read at once, or refused in one line, whatever they are.

A file is written whole, or the one before it stays.
"""

import errno
import os
import socket
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dolens import InputError, files, load_lens
from dolens.cli.app import app
from dolens.experiments.data.package_photographs import read_manifest
from dolens.experiments.lens_search.rungs import forms_of_run
from dolens.files import packaged_configuration, read_file, written_whole
from dolens.optics.elements import Element
from dolens.optics.glass_catalog import find_glass, glass_folders
from dolens.prescriptions.files import check_file, read_tolerance_file

UNREADABLE = {
    "pipe": "is a pipe, no ",
    "socket": "is a socket, no ",
    "zero": "is a device, no ",
    "folder": "is a folder, no ",
    "dangling": "cannot be read (No such file or directory)",
    "circle": "cannot be read (Too many levels of symbolic links)",
    "missing": "cannot be read (No such file or directory)",
    "within a file": "cannot be read (Not a directory)",
    "long": "cannot be read (File name too long)",
    "zero byte": "is no path of a file",
    "half a pair": "is no path of a file",
}


@pytest.fixture(params=UNREADABLE)
def unreadable(request, tmp_path, monkeypatch):
    """Return a function from a suffix to a path that is no file, and what is said of it."""

    def make(suffix):
        kind, path = request.param, tmp_path / f"lens{suffix}"
        if kind == "pipe":
            os.mkfifo(path)
        elif kind == "socket":
            monkeypatch.chdir(tmp_path)
            socket.socket(socket.AF_UNIX).bind(path.name)
        elif kind == "folder":
            path.mkdir()
        elif kind in ("zero", "dangling", "circle"):
            path.symlink_to({"zero": "/dev/zero", "circle": path}.get(kind, tmp_path / "none"))
        elif kind == "within a file":
            path.write_text("")
            path /= f"lens{suffix}"
        elif kind != "missing":
            odd = {"long": "l" * 300, "zero byte": "a\0b", "half a pair": "a\ud800b"}[kind]
            path = tmp_path / f"{odd}{suffix}"
        return path, UNREADABLE[kind]

    return make


def read_glass(path):
    with glass_folders(path):
        find_glass("LENS:N-BK7")


READERS = {
    "a lens in Zemax's format": (".zmx", load_lens),
    "a lens in YAML": (".yaml", load_lens),
    "tolerances": (".yaml", lambda path: read_tolerance_file(load_lens("asphere"), path)),
    "a manifest of photographs": (".csv", read_manifest),
    "anything": ("", lambda path: read_file(path, 100)),
}


@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_file_is_refused_in_one_line_and_at_once(reader, unreadable):
    suffix, read = READERS[reader]
    path, said = unreadable(suffix)
    with pytest.raises(InputError) as caught:
        read(path)
    assert said in str(caught.value) or "does not exist" in str(caught.value)
    assert str(caught.value).isprintable()


def test_elements_that_a_file_of_tolerances_gives_are_refused_with_its_name(tmp_path):
    file = tmp_path / "tolerances.yaml"
    file.write_text("elements: {far: {surfaces: [1, 99]}}\ntolerances: {}\n")
    with pytest.raises(InputError, match=r"tolerances\.yaml: element far: surface 99 is not in"):
        read_tolerance_file(load_lens("asphere"), file)


def test_elements_of_a_file_of_tolerances_join_those_of_the_lens_which_stay(tmp_path):
    file, lens = tmp_path / "tolerances.yaml", load_lens("cooke_triplet")
    lens.elements["front"] = Element(1, 2, {"tilt_x": 0.01})
    file.write_text("elements: {front: {surfaces: [1, 2]}, rear: {surfaces: [5, 6]}}\n")
    drawn, _, _ = read_tolerance_file(lens, file)
    assert set(drawn.elements) == {"front", "rear"} and set(lens.elements) == {"front"}
    assert float(drawn.elements["front"].tilt_x.detach()) == 0.01
    file.write_text("elements: {front: {surfaces: [1, 4]}}\n")
    with pytest.raises(InputError, match=r"yaml: element front has surfaces 1 to 2 in the lens"):
        read_tolerance_file(lens, file)


def test_a_glass_catalogue_that_is_no_file_is_refused(unreadable):
    path, said = unreadable(".agf")
    if path.is_dir() if path.name == "lens.agf" else False:
        (path / "lens.agf").symlink_to("/dev/zero")
        said = "is a device, no glass catalogue"
    with pytest.raises(InputError) as caught:
        read_glass(path)
    assert said in str(caught.value) or "is no folder and no file" in str(caught.value)


def test_a_table_of_forms_that_is_no_file_is_refused(tmp_path, root):
    (tmp_path / "forms").mkdir()
    (tmp_path / "forms/form_01.yaml").write_bytes((root / "conf/lens/asphere.yaml").read_bytes())
    os.mkfifo(tmp_path / "forms.csv")
    with pytest.raises(InputError, match="is a pipe, no table"):
        forms_of_run(tmp_path, 1)


def test_a_checked_folder_names_what_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "lens.zmx")
    assert check_file(tmp_path / "lens.zmx").reason == "is a pipe, no lens file"


def test_a_page_is_not_written_over_what_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "page.html")
    done = CliRunner().invoke(app, ["show", "asphere", "--html", str(tmp_path / "page.html")])
    assert "is no page of dolens" in str(done.exception)


@pytest.mark.parametrize("name", ["lens.yaml", "l" * 300 + ".yaml", "none/lens.yaml"])
def test_a_lens_that_cannot_be_written_ends_conversion_in_one_line(name, tmp_path):
    (tmp_path / "lens.yaml").mkdir()
    done = CliRunner().invoke(app, ["convert", "asphere", str(tmp_path / name), "--force"])
    assert isinstance(done.exception, InputError)
    assert "cannot be written" in str(done.exception)
    assert [path.name for path in Path(tmp_path).iterdir()] == ["lens.yaml"]


def test_a_file_that_is_too_large_is_not_read(tmp_path):
    path = tmp_path / "lens.zmx"
    with path.open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(InputError, match="is larger than 64 MB, and no lens file"):
        load_lens(path)


def test_a_file_is_read_whole(tmp_path):
    (tmp_path / "a").write_bytes(b"123")
    (tmp_path / "b").symlink_to("a")
    assert read_file(tmp_path / "b", 3) == b"123"


# ---------------------------------------------------------------- written


def test_what_was_written_takes_the_place_of_the_file(tmp_path):
    path = tmp_path / "lens.yaml"
    path.write_text("before")
    with written_whole(path) as aside:
        aside.write_text("after")
        assert path.read_text() == "before" and aside.parent == tmp_path
    assert [p.name for p in tmp_path.iterdir()] == ["lens.yaml"] and path.read_text() == "after"


@pytest.mark.parametrize("fault", [OSError(errno.ENOSPC, "full"), KeyboardInterrupt()])
def test_what_is_interrupted_leaves_the_file_before_it_and_nothing_else(tmp_path, fault):
    path = tmp_path / "lens.yaml"
    path.write_text("before")
    with pytest.raises(type(fault)), written_whole(path) as aside:
        aside.write_text("aft")
        raise fault
    assert [p.name for p in tmp_path.iterdir()] == ["lens.yaml"] and path.read_text() == "before"


def test_an_error_names_the_file_that_was_asked_for(tmp_path):
    path = tmp_path / "nowhere" / "lens.yaml"
    with pytest.raises(FileNotFoundError) as caught, written_whole(path) as aside:
        aside.write_text("after")
    assert caught.value.filename == str(path)


def test_a_disk_that_is_full_amid_writing_names_the_file_too(tmp_path):
    with pytest.raises(OSError) as caught, written_whole(tmp_path / "lens.yaml") as aside:
        aside.write_text("aft")
        raise OSError(errno.ENOSPC, "No space left on device")  # as `write` raises it
    assert caught.value.filename == str(tmp_path / "lens.yaml")


# ---------------------------------------------------------------- the packaged configuration


def test_a_checkout_uses_its_own_conf(root):
    assert packaged_configuration() == root / "conf"


def test_an_installed_package_uses_the_folder_within_it(tmp_path, monkeypatch):
    """A folder `conf` beside the packages of a Python installation belongs to someone else."""
    for folder in ("dolens/conf", "conf"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "train.yaml").touch()
    monkeypatch.setattr(files, "__file__", str(tmp_path / "dolens/files.py"))
    assert packaged_configuration() == tmp_path / "dolens/conf"


def test_an_incomplete_installation_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "__file__", str(tmp_path / "dolens/files.py"))
    with pytest.raises(InputError, match=r"no train.yaml in .*install dolens again"):
        packaged_configuration()
