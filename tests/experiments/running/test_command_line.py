"""What a user types behind `dolens train`: an experiment by its name, a lens by its file."""

import os
import shlex
import shutil

import pytest
import yaml
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser

from dolens import InputError, load_lens
from dolens.experiments.running.command_line import prepared, read_override
from dolens.prescriptions.files import find_lens, load_prescription, save_lens


@pytest.fixture(autouse=True)
def folders(tmp_path, monkeypatch):
    """A working folder, a home and a cache of this test's own."""
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "home").mkdir()


@pytest.mark.parametrize(
    "typed",
    [
        ["asphere"],
        ["experiment=asphere"],
        ["--experiment", "asphere"],
        ["--experiment=asphere"],
    ],
)
def test_an_experiment_is_named_with_or_without_its_key(typed):
    rest = ["--cfg", "job", "-p", "lens", "seed=1", "~search"]
    assert prepared([*typed, *rest], "dolens train") == ["experiment=asphere", *rest]
    assert prepared([*rest, *typed], "dolens train") == [*rest, "experiment=asphere"]
    options = ["-m", "--info", "defaults", "-cd", "there", "--resolve"]
    assert prepared([*options, *typed], "dolens train") == [*options, "experiment=asphere"]


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        (["asfere"], "asfere: is no setting (KEY=VALUE) and no experiment; did you mean 'asphere'"),
        (["--experiment"], "--experiment: its name is missing"),
        (["--kkk=3"], "--kkk: there is no such option; a setting is written kkk=VALUE"),
        (["--multirum"], "--multirum: there is no such option; did you mean '--multirun'"),
        (["lens.zmx"], "lens.zmx: is no setting; a lens file is chosen by lens=lens.zmx"),
    ],
)
def test_what_is_no_setting_is_one_line_that_says_what_to_write(typed, said, tmp_path):
    (tmp_path / "work/lens.zmx").touch()
    with pytest.raises(InputError) as error:
        prepared(typed, "dolens train")
    assert said in str(error.value)


@pytest.mark.parametrize(
    "letters", ["a=b", "a#b", "é", "a(b", "a)b", "~b", "a,'b", 'a"b (1', "a&b="]
)
@pytest.mark.parametrize("key", ["ckpt_path", "+data.root", "++data.root"])
def test_a_value_that_needs_quotes_says_how_they_are_written(key, letters):
    text = f"{key}=/some where/{letters}/last.ckpt"
    with pytest.raises(InputError) as error:
        read_override(text)
    said, _, write = str(error.value).partition("; write ")
    assert said == f"{text}: the value needs quotes within those of the shell"
    (word,) = shlex.split(write)
    (read,) = OverridesParser.create().parse_overrides([word])
    assert (read.get_key_element(), read.value()) == (key, f"/some where/{letters}/last.ckpt")


@pytest.mark.parametrize("text", ["a=[1,2", "a={b:1", "a b=1", "a='b"])
def test_a_setting_that_no_quotes_mend_is_one_line(text):
    with pytest.raises(InputError, match="cannot be read as a setting"):
        read_override(text)


def composed(root, typed):
    found = prepared(typed, "dolens train")
    with initialize_config_dir(str(root / "conf"), version_base="1.3"):
        return compose("train", found)


NAMES = ["lens.zmx", "my lens (1).zmx", "ünï=#~'.json", "a,b.seq", "${oc.env:HOME}.yaml", "L" * 90]


@pytest.mark.parametrize("place", ["relative", "absolute", "home"])
@pytest.mark.parametrize("name", NAMES)
def test_a_lens_file_of_any_format_and_name_is_chosen_by_its_path(name, place, root, tmp_path):
    name = name if "." in name else f"{name}.txt"
    folder = tmp_path / ("home" if place == "home" else "work/of mine")
    folder.mkdir(exist_ok=True)
    lens = load_lens("cooke_triplet")
    lens.published = None
    save_lens(lens, folder / name)
    given = {"relative": "of mine", "absolute": folder, "home": "~"}[place]
    cfg = composed(root, ["experiment=cooke_sensitivity", f"lens={given}/{name}"])
    assert cfg.lens.surfaces["3"].radius == pytest.approx(-22.213)
    assert cfg.lens.name == "Cooke triplet"


def test_settings_change_a_lens_that_a_file_gives(root, tmp_path):
    shutil.copy(find_lens("asphere"), tmp_path / "work/mine.yaml")
    typed = ["asphere", "lens=mine.yaml", "lens.surfaces.1.radius=21", "lens@published=./mine.yaml"]
    cfg = composed(root, typed)
    assert cfg.lens.surfaces["1"].radius == 21
    assert (
        cfg.published.surfaces["1"].radius
        == load_prescription("asphere")["surfaces"]["1"]["radius"]
    )


def test_a_sweep_goes_through_lens_files(tmp_path):
    for name in ("a", "b"):
        shutil.copy(find_lens("asphere"), tmp_path / f"work/{name}.yaml")
    found = prepared(["-m", "asphere", "lens=a.yaml,nikon,b.yaml"], "dolens train")
    (override,) = OverridesParser.create().parse_overrides([found[-1]])
    names = list(override.sweep_string_iterator())
    assert [name.partition("-")[0] for name in names] == ["a", "nikon", "b"]


def test_a_run_keeps_the_lens_that_it_began_with(root, tmp_path):
    path = tmp_path / "work/mine.yaml"
    shutil.copy(find_lens("asphere"), path)
    before = prepared(["lens=mine.yaml"], "dolens train")
    assert prepared(["lens=mine.yaml"], "dolens train") == before
    path.write_text(path.read_text().replace("semi_diameter", "note: other, semi_diameter", 1))
    assert prepared(["lens=mine.yaml"], "dolens train") != before


def test_a_file_of_the_configuration_comes_before_one_of_its_name(tmp_path):
    (tmp_path / "work/conf/lens").mkdir(parents=True)
    shutil.copy(find_lens("asphere"), tmp_path / "work/conf/lens/mine.yaml")
    for text in ("lens=mine", "lens=mine.yaml", "lens=published/tessar_us2838978", "lens=nikon"):
        assert prepared([text], "dolens train") == [text]


def asphere(**more):
    return yaml.safe_dump({**load_prescription("asphere"), **more})


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "cannot be read (No such file or directory)"),
        ("pipe", "is a pipe, no lens file"),
        ("a: b", "unknown key 'a'"),
        (asphere(name="${oc.env:HOME}"), "'${oc.env:HOME}' would mean another text"),
        (asphere(name={"_target_": "os.getcwd"}), "does not begin with _: '_target_'"),
        (asphere(note="x"), "unknown key 'note'"),
    ],
)
def test_what_is_no_lens_file_is_refused_before_the_run(content, said, tmp_path):
    path = tmp_path / "work/mine.yaml"
    if content == "pipe":
        os.mkfifo(path)
    elif content is not None:
        path.write_text(content)
    with pytest.raises(InputError) as error:
        prepared(["lens=./mine.yaml"], "dolens train")
    assert str(error.value).startswith(str(path))
    assert said in str(error.value)
