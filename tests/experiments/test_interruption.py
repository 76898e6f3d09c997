"""What a run that ends early says."""

import logging
from types import SimpleNamespace

import pytest

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
