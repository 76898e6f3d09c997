"""What runs say that end early, and of other work that takes their processors."""

import logging
import os
import shlex
from types import SimpleNamespace

import pytest
import torch
from hydra.core.override_parser.overrides_parser import OverridesParser

from dolens.errors import InputError
from dolens.experiments.callbacks.interruption import InterruptionNotice, StarvationWarning
from dolens.experiments.running import process_settings
from dolens.experiments.running.process_settings import set_threads
from dolens.threads import ThreadTimes


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


class Clock:
    """Says what it is told to."""

    def __init__(self, *laps):
        self.laps = list(laps)

    def lap(self):
        return self.laps.pop(0)


def watching(*laps, window_s=0.0):
    callback = StarvationWarning(window_s)
    callback._clock = Clock(*laps)
    return callback


def test_a_starved_run_says_so_once_with_numbers(caplog):
    callback = watching(ThreadTimes(20.0, 15.0), ThreadTimes(20.0, 15.0), ThreadTimes(1.0, 0.0))
    callback.on_train_batch_end()
    assert "had a processor for 20 s and waited for one for 15 s (43 %" in caplog.text
    assert "threads=1" in caplog.text
    callback.on_test_batch_end()
    assert caplog.text.count("starved") == 1
    numbers = callback.numbers()
    assert numbers["cost/cpu_wait_s"] == 30.0 and numbers["cost/cpu_s"] > 0.0


def test_a_run_alone_says_nothing(caplog):
    callback = watching(ThreadTimes(40.0, 0.9))
    callback.look()
    assert not caplog.text


def test_a_run_that_waits_for_data_says_nothing(caplog):
    """Its threads sleep; the little work that it has may well wait for half of its time."""
    callback = watching(ThreadTimes(0.5, 0.5))
    callback._since -= 20.0
    callback.look()
    assert not caplog.text


def test_a_short_time_is_no_reason_to_warn(caplog):
    callback = watching(ThreadTimes(1.0, 5.0), window_s=20.0)
    callback.look()
    assert not caplog.text
    assert callback.numbers()["cost/cpu_wait_s"] == 5.0


def test_where_the_system_does_not_count_nothing_is_said(caplog):
    callback = watching(None, None)
    callback.look()
    assert set(callback.numbers()) == {"cost/cpu_s"} and not caplog.text


@pytest.fixture
def of_64(monkeypatch):
    """PyTorch's own choice on a large machine, and no word of the user's."""
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    chosen = []
    monkeypatch.setattr(torch, "get_num_threads", lambda: 64)
    monkeypatch.setattr(torch, "set_num_threads", chosen.append)
    monkeypatch.setattr(process_settings, "allowed_processors", lambda: 2)
    return chosen


def test_threads_keep_to_what_the_process_may_use(of_64, caplog):
    caplog.set_level("INFO")
    set_threads(None)
    assert of_64 == [2] and "threads: 2" in caplog.text and "64" in caplog.text


def test_the_users_number_of_threads_comes_first(of_64, monkeypatch):
    set_threads(48)
    assert of_64 == [48]
    monkeypatch.setenv("OMP_NUM_THREADS", "8")
    set_threads(None)
    assert of_64 == [48]
    monkeypatch.delenv("OMP_NUM_THREADS")
    monkeypatch.setattr(process_settings, "allowed_processors", lambda: os.cpu_count() + 64)
    set_threads(None)
    assert of_64 == [48]


@pytest.mark.parametrize("number", [0, -1])
def test_no_threads_are_refused(number):
    with pytest.raises(InputError, match="threads"):
        set_threads(number)
