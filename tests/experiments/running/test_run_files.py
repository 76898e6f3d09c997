"""A run folder whose files are damaged is refused in one line that names the file."""

import json
import os

import pytest
import torch

from dolens.errors import InputError
from dolens.experiments.commands.apply import apply_run
from dolens.experiments.commands.apply_options import Options
from dolens.experiments.commands.evaluate import evaluate
from dolens.experiments.commands.export import ExportSettings, export_run
from dolens.experiments.comparison.comparison import compared
from dolens.experiments.report.runs import read_result
from dolens.experiments.running.checkpoints import SETTINGS, checked_checkpoint
from dolens.experiments.running.finished_run import load_run
from dolens.experiments.running.run_files import (
    CONFIG,
    HYDRA,
    INFO,
    METRICS,
    OVERRIDES,
    RESOLVED,
)
from tests.experiments.runs import change_setting

SEED = {"seed": 0, "train": True, "objective": "test/psnr_db"}
NONE = ("callbacks", "logger", "extensions", "threads", "ckpt_path")
WHOLE = SEED | {"test": True, "lens_dtype": "float32", "matmul_precision": "high"}
WHOLE |= {"backend": "auto", "module": {}, "data": {}, "trainer": {}} | dict.fromkeys(NONE)
RUNTIME = {"choices": {"experiment": "joint"}, "output_dir": "/a", "cwd": "/"}
SOURCE = {"path": "/nowhere", "schema": "file"}
CONTENT = {
    CONFIG: SEED,
    RESOLVED: WHOLE,
    HYDRA: {"hydra": {"runtime": {**RUNTIME, "config_sources": [SOURCE]}}},
    OVERRIDES: ["experiment=joint"],
    INFO: {"status": "finished", "device": "cpu", "git": None},
    METRICS: {"test/psnr_db": 25.0},
}
LOADING = {
    "apply": lambda folder, picture: apply_run(folder, [picture], Options()),
    "evaluate": lambda folder, picture: evaluate(folder, name="again"),
    "export": lambda folder, picture: export_run(folder, settings=ExportSettings(["yaml"])),
}
READING = {
    "compare": lambda folder, picture: compared([folder]),
    "report": lambda folder, picture: read_result("a", folder),
}
# Who reads a file, and so must refuse it.
READERS = {
    CONFIG: ("compare",),
    RESOLVED: ("apply", "evaluate", "export", "compare"),
    HYDRA: ("apply", "evaluate", "export", "compare"),
    OVERRIDES: ("apply", "evaluate", "export", "report"),
    INFO: ("apply", "evaluate", "export", "compare", "report"),
    METRICS: ("compare", "report"),
}
BOMB = "a: &a [1, 1]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 30)}]\n" for a, b in zip("abcdef", "bcdefg", strict=True)
)
# What a file may hold in the place of what a run writes: text, bytes, or what makes it.
DAMAGE = {
    "empty": "",
    "a text": "word",
    "a number": "3",
    "nothing": "null",
    "a list": "[1, 2]",
    "a list of lists": "[[1], [2]]",
    "bytes": b"\xff\xfe\x00\x01\x80",
    "NUL": "a: \x00",
    "an alias of itself": "a: &a [*a]",
    "an alias of nothing": "a: *b",
    "a bomb": BOMB,
    "brackets": "[" * 300,
    "deep": '{"a":' * 60 + "1" + "}" * 60,
    "a tag": "!!python/object/apply:os.getcwd []",
    "a key twice": "a: 1\na: 2\n",
    "a key without a name": "{null: 1}",
    "a key that is a list": "? [1]\n: 2\n",
    "a control character": '{"a": "\\u001b[2J"}',
    "half a letter": '{"a": "\\ud800"}',
    "an endless number": f'{{"a": {"9" * 380}}}',
    "a longer number": f'{{"a": {"9" * 5000}}}',
    "much": '{"a": 1}' + " " * 8_000_000,
    "cut off": lambda file: file.write_text(file.read_text()[:-4]),
    "a folder": lambda file: (file.unlink(), file.mkdir()),
    "a pipe": lambda file: (file.unlink(), os.mkfifo(file)),
    "a device": lambda file: (file.unlink(), file.symlink_to("/dev/zero")),
}
WRONG = {
    RESOLVED: [{"a": "${oc.env:HOME}"}],
    HYDRA: [
        {"hydra": 3},
        {"hydra": {"runtime": [1]}},
        {"hydra": {"runtime": {**RUNTIME, "choices": ["a"]}}},
        {"hydra": {"runtime": {**RUNTIME, "config_sources": 3}}},
        {"hydra": {"runtime": {**RUNTIME, "config_sources": [3]}}},
        {"hydra": {"runtime": {**RUNTIME, "config_sources": [{"schema": "file", "path": 3}]}}},
        {"hydra": {"runtime": {**RUNTIME, "output_dir": 3}}},
        {"hydra": {"runtime": {**RUNTIME, "cwd": [1]}}},
        {"hydra": {"runtime": RUNTIME, "overrides": 3}},
        {"hydra": {"runtime": RUNTIME, "overrides": {"task": "a=1"}}},
        {"hydra": {"runtime": RUNTIME, "overrides": {"task": [1]}}},
    ],
    OVERRIDES: [[1], ["a", None], {"a": 1}, ["hydra.searchpath=[pkg://a]"]],
    INFO: [{"status": 3}, {"status": ["a"]}, {"git": "a"}, {"reason": {}}, {"device": 1}],
    METRICS: [
        {"a": value}
        for value in ("25", True, None, [1], {}, float("nan"), float("inf"), 10**330, -(10**330))
    ],
    CONFIG: [
        {**SEED, "seed": "abc"},
        {**SEED, "seed": None},
        {**SEED, "seed": 1.5},
        {**SEED, "objective": 3},
        {**SEED, "objective": []},
    ],
}


def recorded(folder):
    for name, content in CONTENT.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(json.dumps(content))  # which is YAML as well
    return folder


def refused_by_all(folder, name, root):
    for reader in READERS[name]:
        with pytest.raises(InputError) as caught:
            (LOADING | READING)[reader](folder, root / "docs/lenses.png")
        message = str(caught.value)
        assert str(folder / name) in message and "\n" not in message, (reader, message)


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("name", CONTENT)
def test_a_damaged_record_is_refused_in_one_line_that_names_the_file(name, damage, tmp_path, root):
    file = recorded(tmp_path / "run") / name
    change = DAMAGE[damage]
    if callable(change):
        change(file)
    elif isinstance(change, bytes):
        file.write_bytes(change)
    else:
        file.write_text(change)
    if name == INFO and damage == "a key twice":
        return  # JSON's last one counts
    refused_by_all(tmp_path / "run", name, root)


@pytest.mark.parametrize(
    "name, content", [(n, c) for n, contents in WRONG.items() for c in contents]
)
def test_a_record_with_values_of_other_types_is_refused_likewise(name, content, tmp_path, root):
    file = recorded(tmp_path / "run") / name
    file.write_text(json.dumps(content))
    if name == CONFIG:
        (tmp_path / "run" / RESOLVED).unlink()  # which compare would look into first
    if name == RESOLVED:
        with pytest.raises(InputError, match="not resolved"):
            load_run(tmp_path / "run")
        return
    refused_by_all(tmp_path / "run", name, root)


@pytest.mark.parametrize("name", [RESOLVED, METRICS])
def test_brackets_without_an_end_are_refused(name, tmp_path, root):
    (recorded(tmp_path / "run") / name).write_text("[" * 100_000)
    with pytest.raises(InputError, match=f"{name}.* (nested too deeply|recursion)"):
        compared([tmp_path])


@pytest.mark.parametrize("name", [CONFIG, RESOLVED, HYDRA, INFO, METRICS])
def test_a_damaged_run_is_listed_beside_those_that_are_compared(name, tmp_path):
    recorded(tmp_path / "whole")
    (recorded(tmp_path / "damaged") / name).write_text("[")
    found = compared([tmp_path])
    assert [list(row.runs) for row in found.rows.rows] == [[0]]
    (note,) = found.notes()
    assert note.startswith(f"{tmp_path / 'damaged'}: unreadable: {tmp_path / 'damaged' / name}")


@pytest.mark.parametrize("name", [CONFIG, HYDRA])
def test_a_run_without_one_of_its_records_is_listed_too(name, tmp_path):
    recorded(tmp_path / "whole")
    (recorded(tmp_path / "damaged") / name).unlink()
    (note,) = compared([tmp_path]).notes()
    assert f"unreadable: {tmp_path / 'damaged'} is no finished run folder: {name}" in note


@pytest.mark.parametrize(
    "key, value, said",
    [
        ("module", 3, "module: 3; allowed: a mapping"),
        ("module", None, "module: null; allowed"),
        ("module", {"a": 1}, "module: makes no experiment of a lens"),
        ("data", [1], "data: [1]; allowed"),
        ("trainer", "a", "trainer: 'a'; allowed"),
        ("callbacks", 3, "callbacks: 3; allowed"),
        ("lens", "a", "lens: 'a'; allowed"),
        ("lens", {}, "lens"),
        ("lens_dtype", ["a"], "lens_dtype"),
        ("seed", "abc", "seed: 'abc'; allowed"),
        ("seed", "???", "seed"),
        ("threads", "two", "threads"),
        ("objective", {"a": 1}, "objective"),
        ("module.reconstruction.network.width", "wide", "width"),
        ("module.views", 3, "views"),
    ],
)
def test_a_setting_of_another_type_is_named_with_its_file(run_copy, key, value, said):
    change_setting(run_copy, key, value)
    with pytest.raises(InputError) as caught:
        load_run(run_copy)
    assert str(caught.value).startswith(f"{run_copy / RESOLVED}: ") and "\n" not in str(
        caught.value
    )
    assert said in str(caught.value)


@pytest.fixture(scope="module")
def module(tiny_run):
    return load_run(tiny_run).module


BIAS = "network.network.output.bias"


@pytest.mark.parametrize(
    "key, value, said",
    [
        ("state_dict", 3, "its state_dict is int 3"),
        ("state_dict", {BIAS: "a"}, f"its {BIAS} is str 'a'"),
        ("state_dict", {}, "is missing in the checkpoint"),
        (BIAS, torch.zeros(3, dtype=torch.complex64), "is torch.complex64 in the checkpoint"),
        (BIAS, torch.zeros(4), "has shape (4,) in the checkpoint and (3,) here"),
        (BIAS, torch.zeros(3).to_sparse(), f"its {BIAS} is Tensor"),
        (BIAS, 3.0, f"its {BIAS} is float 3.0"),
        ("more", torch.zeros(3), "there is no more here"),
        ("global_step", "abc", "its global_step is str 'abc'"),
        ("global_step", True, "its global_step is bool True"),
        ("global_step", -1, "its global_step is int -1"),
        ("epoch", None, "its epoch is NoneType None"),
        ("optimizer_states", "a", "its optimizer_states is str 'a'"),
        ("lr_schedulers", 1, "its lr_schedulers is int 1"),
        ("loops", [], "its loops is list []"),
        ("dolens", 3, "is no checkpoint of a dolens experiment"),
    ],
)
def test_a_checkpoint_with_other_contents_is_refused(run_copy, module, key, value, said):
    """Whether the run is applied, or resumed by ckpt_path."""
    file = run_copy / "checkpoints/last.ckpt"
    checkpoint = torch.load(file, weights_only=True)
    written = checkpoint[SETTINGS]
    of = checkpoint if key in checkpoint else checkpoint["state_dict"]
    of[key] = value
    torch.save(checkpoint, file)
    resumes = lambda: checked_checkpoint(str(file), module, written, training=True)  # noqa: E731
    for use in (lambda: load_run(run_copy), resumes):
        with pytest.raises(InputError) as caught:
            use()
        assert said in str(caught.value) and "\n" not in str(caught.value)
