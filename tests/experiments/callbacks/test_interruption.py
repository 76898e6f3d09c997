"""What a run that ends early says."""

import logging
import shlex
from types import SimpleNamespace

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from dolens.experiments.callbacks.interruption import InterruptionNotice


@pytest.mark.parametrize(
    ("written", "said"),
    [
        (["last", "best"], "Resume with: train ckpt_path={folder}/last.ckpt"),
        (["best"], "Resume with: train ckpt_path={folder}/best.ckpt"),
        ([], "before the first checkpoint"),
    ],
)
def test_the_checkpoint_to_go_on_from_is_named(tmp_path, caplog, written, said):
    for name in written:
        (tmp_path / f"{name}.ckpt").touch()
    notice = InterruptionNotice(tmp_path, "train")
    with caplog.at_level(logging.WARNING, "dolens.experiments.callbacks.interruption"):
        notice.on_exception(SimpleNamespace(global_step=97), None, KeyboardInterrupt())
    assert "Stopped at step 97 (KeyboardInterrupt)" in caplog.text
    assert said.format(folder=tmp_path) in caplog.text


def test_a_folder_with_odd_names_is_quoted_for_the_shell_and_for_hydra(tmp_path, caplog):
    folder = tmp_path / "a b, c=1's"
    folder.mkdir()
    (folder / "last.ckpt").touch()
    notice = InterruptionNotice(folder, "train")
    notice.on_exception(SimpleNamespace(global_step=1), None, KeyboardInterrupt())
    (words,) = (m.split("Resume with: ")[1] for m in caplog.messages)
    (override,) = OverridesParser.create().parse_overrides(shlex.split(words)[1:])
    assert override.value() == str(folder / "last.ckpt")
