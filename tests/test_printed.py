"""Every block of code in README and docs/ is run as printed, or checked as far as costs seconds.

Tutorials with files of a user's own run whole: tests/test_tutorials.py, tests/test_extending.py.
"""

import argparse
import logging
import math
import re
import runpy
import shlex
import sys
import tomllib
import warnings
from functools import partial

import numpy as np
import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep
from hydra.utils import instantiate
from PIL import Image
from typer.main import get_command
from typer.testing import CliRunner

from dolens import load_lens, save_lens
from dolens.cli.app import app
from dolens.experiments.running.configuration import checked
from dolens.experiments.running.user_configuration import use_working_folder
from dolens.lens_page.page import Written
from dolens.optimize import DesignVariables, MeritSettings
from dolens.prescriptions import lens_from_prescription
from tests.experiments.conftest import composing
from tests.prescriptions.test_oslo import TRIPLET as OSLO_TRIPLET
from tests.printed import BLOCKS, DOCUMENTS, ROOT, commands_of

# Pages whose files and commands are run whole by tests of their own.
TUTORIALS = ("docs/own_camera.md", "docs/extending.md")
# A command within a sentence or a table, and what stands in one for a reader's own.
INLINE = re.compile(r"`((?:dolens \w+|python scripts/[^\s`]+|experiment=\w+)[^`]*)`")
PLACEHOLDER = re.compile(r"\.\.\.|…|\b(?:NAME|LENS|FOLDER|A B)\b(?!/)|\[key=")
ALONE = ("experiments", "report")
# Pages take seconds: one is written, and of the others the arguments are tried.
FIRST_PAGE = ("dolens", "show", "cooke_triplet", "--html", "triplet.html")
# Of a page's Python: sizes of long work, and processes, which
# tests/experiments/test_workers.py starts.
SIZES = {
    "draw(100_000,": "draw(1_000,",
    "workers_of(2)": "workers_of(0)",
    "seconds=10)": "seconds=1)",
    'load_lens("double_gauss").coated("quarter_wave")\nl': 'load_lens("cooke_triplet")\nl',
}
OTHERS = (
    ".venv/bin/pip",
    ".venv/bin/python",
    "python3",
    "pip",
    "apt",
    "tensorboard",
    "ray",
    "cd",
    "ruff",
    "mypy",
    "coverage",
    ".",
)


def printed_commands():
    """All commands as their words, each once."""
    found = []
    for block in BLOCKS:
        if block.language == "sh" and block.page not in TUTORIALS:
            found += commands_of(block)
    for document in DOCUMENTS:
        if str(document.relative_to(ROOT)) in TUTORIALS:
            continue
        for text in INLINE.findall(document.read_text(encoding="utf-8")):
            words = ["dolens", "train"] * text.startswith("exp") + shlex.split(text)
            # `dolens apply` is the name of a command; `dolens report` is a whole one.
            if not PLACEHOLDER.search(text) and (len(words) > 2 or words[-1] in ALONE):
                found.append(words)
    return list(dict.fromkeys(tuple(words) for words in found))


def kind_of(words):
    """What a command starts."""
    if words[:2] == ("dolens", "train") or "train.py" in words:
        return "train"
    if "dolens" in words:
        return words[words.index("dolens") + 1]
    return words[1].partition("/")[0] if words[0] == "python" else words[0]


COMMANDS = printed_commands()


def those(*kinds):
    return pytest.mark.parametrize(
        "words", [words for words in COMMANDS if kind_of(words) in kinds], ids=" ".join
    )


def test_every_block_is_held_by_a_test():
    """Formulas and listings are `text`; the other blocks are run below, or are files."""
    for block in BLOCKS:
        assert block.language in ("sh", "python", "yaml", "text"), block.name
    own = {command.name for command in app.registered_commands}
    assert {kind_of(words) for words in COMMANDS} <= {"train", "scripts", "-m", *own, *OTHERS}


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    """A reader's folder: lenses of several formats, a prescription of his own, an experiment."""
    folder = tmp_path_factory.mktemp("here")
    for name in ("conf/lens", "conf/experiment", "lenses", "Zemax/Glasscat", "Zemax/Coatings"):
        (folder / name).mkdir(parents=True)
    triplet = load_lens("cooke_triplet")
    for name in (
        "lens.zmx",
        "lens.seq",
        "lens.json",
        "lenses/one.zmx",
        "lens.txt",
        "conf/lens/mylens.yaml",
    ):
        save_lens(triplet, folder / name)
    for block in BLOCKS:
        if block.title and block.page not in TUTORIALS:
            (folder / block.title.partition("/")[2]).write_text(block.text, encoding="utf-8")
    return folder


@pytest.fixture
def in_it(here, monkeypatch):
    monkeypatch.chdir(here)
    monkeypatch.setenv("HOME", str(here))
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(sys, "argv", [*sys.argv])


def alternatives(overrides):
    """The overrides of each run of a sweep, with every value of a list in one of them."""
    parsed = OverridesParser.create().parse_overrides(overrides)
    found = {0: []}
    for override in parsed:
        if not override.is_sweep_override():
            choices = [override.input_line]
        elif isinstance(override.value(), IntervalSweep):
            choices = [f"{override.get_key_element()}={override.value().start}"]
        else:
            key = override.get_key_element()
            choices = [f"{key}={value}" for value in override.sweep_string_iterator()]
        for number in range(max(len(found), len(choices))):
            before = found.get(number, found[0][: parsed.index(override)])
            found[number] = [*before, choices[number % len(choices)]]
    return list(found.values())


@those("train")
def test_a_training_is_composed_and_every_key_of_it_is_read(words, in_it, tmp_path):
    given = [word for word in words if not word.startswith("-")]
    overrides = [word for word in given if "=" in word or word.startswith("~")]
    use_working_folder()
    for run in alternatives(overrides):
        with composing(ROOT, tmp_path) as compose:
            target = checked(compose(*run)).module._target_
        assert target.startswith("dolens.experiments.")


class Parsed(Exception):
    """The arguments are understood."""


@those("scripts")
def test_a_script_takes_the_arguments(words, monkeypatch):
    """And does nothing with them: some take hours."""

    def understood(parse):
        def parsed(*given):
            parse(*given)
            raise Parsed

        return parsed

    # Square brackets are around what may be left out.
    script, *arguments = (word.strip("[]") for word in words[1:])
    text = (ROOT / script).read_text(encoding="utf-8")
    if "argparse" not in text:
        assert '__name__ == "__main__"' in text and (not arguments or "sys.argv[1:]" in text)
        return
    for name in ("parse_args", "parse_intermixed_args"):
        parse = getattr(argparse.ArgumentParser, name)
        monkeypatch.setattr(argparse.ArgumentParser, name, understood(parse))
    monkeypatch.setattr(sys, "argv", [script, *arguments])
    # As Python starts it: the checkout itself is on the path where the script puts it there.
    others = (entry for entry in sys.path if entry not in ("", str(ROOT)))
    monkeypatch.setattr(sys, "path", [str((ROOT / script).parent), *others])
    # What a script switches off for its own process.
    monkeypatch.setattr(logging, "disable", lambda *_: None)
    with warnings.catch_warnings(), np.errstate(), pytest.raises(Parsed):
        runpy.run_path(str(ROOT / script), run_name="__main__")


def nothing_drawn(lens, path, **settings):
    if path is not None:
        path.touch()
    return Written()


@those("show", "convert", "check", "export", "experiments")
def test_a_command_about_a_lens_runs(words, in_it, here, monkeypatch):
    if "outputs" in " ".join(words) or "RUN" in words:
        assert kind_of(words) in ("show", "export")  # of a run: tests/test_tutorials.py
        return
    if {"--html", "--figures"} & {*words} and words != FIRST_PAGE:
        (here / "lens.html").unlink(missing_ok=True)
        monkeypatch.setattr("dolens.lens_page.page.write_page", nothing_drawn)
    variables = [word.split("=") for word in words[: words.index("dolens")]]
    for name, value in variables:
        monkeypatch.setenv(name, value.replace("~", str(here)))
    for word in words:
        if word == "lens.len":
            (here / word).write_text(OSLO_TRIPLET)
        elif word == words[-1] and kind_of(words) == "convert":
            (here / word).unlink(missing_ok=True)
    done = CliRunner().invoke(app, list(words[words.index("dolens") + 1 :]))
    assert done.exit_code == 0, (done.output, done.exception)


@those("apply", "evaluate", "compare", "report", "mcp", "watch", "play", "new", "doctor")
def test_a_command_that_runs_elsewhere_takes_the_arguments(words, in_it, here):
    """It runs in the tests of tutorials, experiments, pages and servers; that of a lens here."""
    if kind_of(words) == "apply" and "lens.zmx" in words:
        Image.effect_noise((60, 40), 50).convert("RGB").save(here / "picture.jpg")
        done = CliRunner().invoke(app, list(words[1:]))
        assert done.exit_code == 0 and (here / "lens_applied/picture.json").is_file(), done.output
        return
    command = get_command(app).commands[words[1]]
    command.make_context(words[1], list(words[2:]))


@those("pip", ".venv/bin/pip")
def test_an_extra_that_is_installed_exists(words):
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    for extra in re.findall(r"(?:dolens|\.)\[(\w+)\]", " ".join(words)):
        assert extra in extras


PYTHON = {}
for block in BLOCKS:
    if block.language == "python" and not block.title and block.page not in TUTORIALS:
        PYTHON.setdefault(block.page, []).append(block.text)


@pytest.mark.parametrize("page", PYTHON)
def test_the_python_of_a_page_runs(page, tmp_path, monkeypatch):
    """One block after another, in a folder with the lens and the pictures that pages speak of."""
    monkeypatch.chdir(tmp_path)
    save_lens(load_lens("double_gauss"), tmp_path / "lens.yaml")
    Image.effect_noise((60, 40), 50).convert("RGB").save(tmp_path / "picture.jpg")
    night = np.full((40, 60, 4), [90, 100, 120, 126], np.uint8)
    night[10, 45] = [250, 200, 150, 144]
    (tmp_path / "street.hdr").write_bytes(b"#?RADIANCE\n\n-Y 40 +X 60\n" + night.tobytes())
    names = {"__name__": "__main__"}
    for text in PYTHON[page]:
        for size, smaller in SIZES.items():
            text = text.replace(size, smaller)
        exec(compile(text, page, "exec"), names)


def a_lens(keys, name="cooke_triplet"):
    """A packaged lens with some of its keys and rows in another way."""
    lens = yaml.safe_load((ROOT / f"conf/lens/{name}.yaml").read_text(encoding="utf-8"))
    rows = keys.pop("surfaces", {number: keys.pop(number) for number in "13" if number in keys})
    return lens_from_prescription(lens | keys | {"surfaces": lens["surfaces"] | rows})


def a_plain_lens(keys):
    lens = {"wavelengths": [587.56], "stop": 1, "sensor": {"distance": 100.0, "diameter": 10.0}}
    return lens_from_prescription(lens | {"surfaces": keys.get("surfaces", keys)})


def a_zoom(keys):
    lens = a_lens(keys, "published/zoom_us9784950_ex1")
    return [lens.in_state(name) for name in lens.state_names]


def a_design(keys, name="cooke_triplet"):
    """What an experiment makes of its merit function and variables."""
    lens = load_lens(name)
    variables = DesignVariables(lens, keys["variables"])
    merit = MeritSettings(**keys["merit"]).build(lens, variables)
    assert math.isfinite(merit().sum_of_squares())


def lights(keys):
    """Lights in the pictures of a camera."""
    return instantiate(keys["views"]["lights"])


# The first line of a fragment of YAML, and what takes it.
FRAGMENTS = {
    "docs/coatings.md: coating: quarter_wave": a_lens,
    "docs/conventions.md: '3': {type: coordinate_break": a_lens,
    "docs/ghosts.md: views:": lights,
    "docs/diffractive.md: surfaces:": a_plain_lens,
    "docs/ghosts.md: variables:": partial(a_design, name="double_gauss"),
    "docs/glass.md: temperature: 60": a_lens,
    "docs/glass.md: surfaces:": a_lens,
    "docs/glass.md: stop: 1": a_plain_lens,
    "docs/least_squares.md: variables:": a_design,
    "docs/states.md: f_number: 2.9": a_zoom,
    "docs/states.md: merit:": partial(a_design, name="published/zoom_us9784950_ex1"),
    "docs/surfaces.md: surfaces:": a_plain_lens,
    "docs/surfaces.md: '1': {type: conic": a_plain_lens,
}
UNTITLED = [block for block in BLOCKS if block.language == "yaml" and not block.title]


@pytest.mark.parametrize("block", UNTITLED, ids=[block.name[:60] for block in UNTITLED])
def test_a_fragment_is_taken(block):
    (take,) = (take for start, take in FRAGMENTS.items() if block.name.startswith(start))
    assert take(yaml.safe_load(block.text)) is not False
