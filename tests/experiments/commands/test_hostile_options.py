"""Hostile values of options and arguments end a command in a line that names them, and soon.

Commands and options are those of the program itself: a new one is tried without being named here.
"""

import os
import shutil
from pathlib import Path
from types import SimpleNamespace, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import pytest
import typer
from PIL import Image
from typer.testing import CliRunner

from dolens.cli.app import app
from dolens.errors import InputError, one_line, readable
from dolens.experiments.commands.apply import PictureCamera
from dolens.experiments.commands.apply_lens import AppliedLens
from dolens.experiments.running.command_line import prepared
from dolens.lens_page.page import Written
from dolens.live.serve import LocalServer

# How a command is called beside the option that is tried.
BASE = {
    "show": ["asphere"],
    "convert": ["asphere", "new.yaml"],
    "check": ["lenses"],
    "doctor": [],
    "experiments": [],
    "mcp": ["lenses"],
    "new": ["my_camera"],
    "play": ["asphere"],
    "watch": ["run"],
    "evaluate": ["run"],
    "apply": ["run", "picture.png"],
    "compare": ["run"],
    "export": ["asphere", "--only", "yaml"],
    "report": ["--no-run", "--no-fail", "--folder", "report"],
}
# Options that need others.
BESIDE = {
    ("show", "tolerances"): ["asphere", "--figures", "figures"],
    ("apply", "black_level"): ["run", "picture.png", "--raw"],
    ("apply", "white_level"): ["run", "picture.png", "--raw"],
    **{
        ("apply", name): ["asphere", "picture.png"]
        for name in ("light", "read_noise", "sensor", "pitch")
    },
    ("export", "checkpoint"): ["run", "--only", "torch"],
    ("export", "image_size"): ["run", "--only", "torch"],
    ("export", "multiple_of"): ["run", "--only", "torch"],
}
ESCAPE = "\x1b[2J\x07"
TEXTS = ["n" * 300, "a\0b", "\ud800", ESCAPE]
PATHS = [*TEXTS, "pipe", "file/within"]
VALUES: dict[Any, list[str]] = {
    float: ["nan", "inf", "-inf", "-1", "word", "1,5"],
    int: ["1" * 23, "-1", "1e9", "nan"],
    str: TEXTS,
}
FOLDERS = {"figures", "out", "folder"}
# What stands for itself: a number below black, and names that a file may have.
ALLOWED = {("apply", "--black-level", "-1")}
COMMANDS = {c.name or c.callback.__name__: c.callback for c in app.registered_commands}


def leaf(hint: Any) -> Any:
    """Return the type of one value, of an option that may be left out or repeated."""
    if get_origin(hint) in (Union, UnionType, list, tuple):
        return leaf(next(one for one in get_args(hint) if one is not type(None)))
    return hint


def tried():
    """Yield every option and argument of every command with the type of its values."""
    for command, called in typer.main.get_command(app).commands.items():
        hints = get_type_hints(COMMANDS[command])
        for option in called.params if command in BASE else ():
            kind = leaf(hints[option.name])
            if kind is not bool:
                yield pytest.param(command, option, kind, id=f"{command} {option.opts[0]}")


def values(command, option, kind):
    if kind is not Path:
        return VALUES[kind]
    if option.param_type_name == "argument":
        return PATHS
    return [*PATHS, "file" if option.name in FOLDERS else "folder"]


def arguments(command, option, value):
    given = list(BESIDE.get((command, option.name), BASE[command]))
    if option.param_type_name == "option":
        name = option.opts[0]
        own = [f"{name}={value}"] if option.nargs == 1 else [name, *[value] * option.nargs]
        return [command, *given, *own]
    called = typer.main.get_command(app).commands[command]
    place = [p.name for p in called.params if p.param_type_name == "argument"].index(option.name)
    return [command, *given[:place], value, *given[place + 1 :]]


@pytest.fixture(scope="module")
def work(tiny_run, root, tmp_path_factory):
    """A folder with a run, a picture, a lens, a file, a folder and a pipe."""
    folder = tmp_path_factory.mktemp("work")
    shutil.copytree(tiny_run, folder / "run")
    (folder / "lenses").mkdir()
    shutil.copy(root / "conf/lens/asphere.yaml", folder / "lenses")
    Image.new("RGB", (40, 40), (90, 120, 30)).save(folder / "picture.png")
    (folder / "folder").mkdir()
    (folder / "file").write_text("")
    os.mkfifo(folder / "pipe")
    return folder


@pytest.fixture(autouse=True)
def at_work(work, monkeypatch):
    """Nothing is drawn and no picture restored: what is refused is refused before."""
    monkeypatch.chdir(work)
    monkeypatch.setenv("COLUMNS", "400")
    monkeypatch.setattr("dolens.lens_page.page.write_page", lambda *_, **__: Written())
    nothing = SimpleNamespace(name="", summary="", sections=[])
    monkeypatch.setattr("dolens.lens_page.overview.lens_overview", lambda lens, ghosts: nothing)
    for name in ("apply", "restore"):
        monkeypatch.setattr(PictureCamera, name, lambda *_: [])
    monkeypatch.setattr(AppliedLens, "apply", lambda *_: [])
    monkeypatch.setattr(LocalServer, "run", lambda _: None)


def said(given):
    """Return what a command says to the user, as `dolens.cli.app.main` does; None: no refusal."""
    done = CliRunner().invoke(app, given)
    error = done.exception
    if isinstance(error, OSError) and error.filename is not None:
        error = InputError(f"{error.filename}: {error.strerror}")
    if isinstance(error, InputError):
        return one_line(error)
    assert error is None or isinstance(error, SystemExit), (given, error)
    assert all(line.isprintable() for line in done.output.splitlines()), (given, done.output)
    return " ".join(done.output.split()) if done.exit_code else None


def names(message, option, value):
    """Return whether a message names an option, with - or _, or a value of it, shortened."""
    words = [text.lstrip("-") for text in (*option.opts, option.name, option.metavar or "-")]
    own = [word for word in (*words, readable(value)[:100]) if word]
    return any(w.replace("-", "_") in message.replace("-", "_") for w in own)


@pytest.mark.parametrize("command, option, kind", tried())
def test_a_hostile_value_is_refused_in_one_line_that_names_the_option(command, option, kind):
    for value in values(command, option, kind):
        message = said(arguments(command, option, value))
        harmless = (command, option.opts[0], value) in ALLOWED
        if message is None:
            assert harmless or (kind is Path and value == ESCAPE), value
            continue
        assert message.isprintable() and not harmless, (value, message)
        assert names(message, option, value), (value, message)


def test_every_command_is_tried():
    assert set(COMMANDS) == {*BASE, "train"}


@pytest.mark.parametrize("value", ["1e9", "1e-9", "0", "1e300"])
def test_a_scale_beyond_all_pictures_is_refused(value):
    assert "--scale: " in said(["apply", "run", "picture.png", f"--scale={value}"])


@pytest.mark.parametrize(
    "given",
    [
        ["compare", "run", "--csv", "table.csv"],
        ["show", "asphere", "--html", "page.html"],
        ["export", "asphere", "--only", "yaml", "--out", "exported"],
        ["report", "--no-run", "--folder", "report"],
        ["apply", "run", "picture.png", "--out", "applied"],
    ],
)
def test_a_folder_without_permission_is_refused_before_work_begins(given, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode, **_: mode != os.W_OK)
    assert "cannot be written (Permission denied)" in said(given)


@pytest.mark.parametrize("key", ["", "lens=", "experiment=", "+data.root=", "--experiment="])
@pytest.mark.parametrize("value", TEXTS[1:])
def test_what_is_typed_behind_train_is_refused_likewise(key, value):
    with pytest.raises(InputError) as error:
        prepared([key + value], "dolens train")
    assert str(error.value).isprintable()
