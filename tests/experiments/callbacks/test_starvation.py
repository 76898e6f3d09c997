"""Runs say when other work takes their processors, and what they used of them."""

import os

import pytest
import torch

from dolens.errors import InputError
from dolens.experiments.callbacks.starvation import StarvationWarning
from dolens.experiments.running import process_settings
from dolens.experiments.running.process_settings import set_threads
from dolens.threads import ThreadTimes


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
