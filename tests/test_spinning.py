"""Threads spin while their processors are their own, and sleep while other work needs them."""

import itertools
import os
import subprocess
import sys

import pytest

from dolens import threads
from dolens.threads import POLICY, SpinControl, ThreadClock, ThreadTimes

ALONE, BESIDE, BETWEEN, IDLE = (
    ThreadTimes(1.0, 0.01),
    ThreadTimes(0.7, 0.3),
    ThreadTimes(1.0, 0.08),
    ThreadTimes(0.001, 0.02),
)


class Clock:
    """Says what it is told to."""

    def __init__(self, laps=()):
        self.laps = list(laps)

    def lap(self):
        return self.laps.pop(0)


class Team:
    """Counts how many there are."""

    running = 0

    def __init__(self):
        Team.running += 1

    def end(self):
        Team.running -= 1


def states(*laps):
    """Return after each lap whether threads may spin."""
    Team.running = 0
    control = SpinControl(Clock(laps), Team)
    found = []
    for _ in laps:
        control.look()
        assert Team.running == (0 if control.spins else 1)
        found.append(control.spins)
    return found


def test_threads_spin_alone_and_sleep_beside_other_work():
    assert all(states(*[ALONE] * 50))
    assert states(ALONE, BESIDE, BESIDE, BESIDE) == [True, False, False, False]


def test_threads_spin_again_when_the_other_work_is_over():
    assert states(BESIDE, BESIDE, *[ALONE] * 9) == [False, False] + [True] * 9
    # Where they have tried in vain many times too; but a calm moment of the other work is no end.
    assert states(*[BESIDE] * 900, *[ALONE] * 17)[-1]
    assert sum(states(*([BESIDE] * 7 + [ALONE]) * 200)) < 50


def test_the_wait_of_sleeping_threads_does_not_keep_them_from_trying():
    """It may be their own waking up."""
    assert states(BESIDE, *[BETWEEN] * 40) == [False] + [True] * 40


def test_tries_become_rare_while_the_other_work_lasts():
    found = states(*[BESIDE] * 2000)
    tries = [lap for lap, spins in enumerate(found) if spins]
    gaps = [b - a for a, b in itertools.pairwise(tries)]
    assert gaps == sorted(gaps) and gaps[-1] >= 100 and 5 < len(tries) < 30


def test_tries_are_frequent_again_beside_new_work():
    found = states(*[BESIDE] * 2000, *[ALONE] * 300, *[BESIDE] * 20)
    assert any(found[-20:][1:])


@pytest.mark.parametrize("lap", [IDLE, None])
def test_a_lap_that_says_nothing_changes_nothing(lap):
    assert states(lap, lap, BESIDE, *[lap] * 500) == [True, True, *[False] * 501]


@pytest.fixture
def clean(monkeypatch):
    """A process before PyTorch is imported, without a word about threads."""
    for name in ("OMP_NUM_THREADS", *POLICY, "KMP_BLOCKTIME", "KMP_LIBRARY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    # Whatever a test sets goes with it.
    monkeypatch.setattr(os, "environ", dict(os.environ))
    monkeypatch.setattr(threads, "ThreadClock", lambda: Clock([ALONE]))
    started = []
    monkeypatch.setattr(threads.threading.Thread, "start", lambda thread: started.append(thread))
    monkeypatch.started = started
    return monkeypatch


def test_the_program_follows_other_work(clean):
    threads.choose_waiting()
    assert {name: os.environ[name] for name in POLICY} == POLICY
    assert len(clean.started) == 1 and clean.started[0].daemon


def test_a_process_that_has_the_policy_from_its_parent_follows_other_work(clean):
    threads.follow_other_work()
    assert not clean.started  # a program of a user's that uses this library
    os.environ |= POLICY
    threads.follow_other_work()
    assert len(clean.started) == 1


def test_one_thread_is_not_watched(clean):
    os.environ["OMP_NUM_THREADS"] = "1"
    threads.choose_waiting()
    assert not clean.started


def test_where_the_system_does_not_count_threads_sleep_soon(clean):
    clean.setattr(threads, "ThreadClock", lambda: Clock([None]))
    threads.choose_waiting()
    assert os.environ["OMP_WAIT_POLICY"] == "passive" and int(os.environ["GOMP_SPINCOUNT"]) < 10_000
    assert not clean.started


@pytest.mark.parametrize("name", [*POLICY, "KMP_BLOCKTIME", "KMP_LIBRARY"])
def test_a_users_own_waiting_stays(clean, name):
    os.environ[name] = "7"
    before = dict(os.environ)
    threads.choose_waiting()
    assert os.environ == before and not clean.started


def test_a_library_import_changes_nothing(root):
    program = "import os; a = dict(os.environ); import dolens; assert a == dict(os.environ)"
    subprocess.run([sys.executable, "-c", program], cwd=root, check=True, timeout=120)


FOLLOWED = """
import os, time
from dolens import spinning
from dolens.threads import ThreadTimes
spinning.choose_waiting()
spinning.follow_other_work()  # one thread watches, however often it is asked for
spinning._LAP_S = 0.01
laps = [ThreadTimes(0.0, 1.0), *[ThreadTimes(1.0, 0.0)] * 3]
pressed = []
class Clock:
    def lap(self):
        return pressed.pop(0) if pressed else None
spinning.ThreadClock = Clock
import torch
torch.set_num_threads(2)
ones = torch.ones(1 << 20)
def threads():
    return len(os.listdir("/proc/self/task"))
def until(wanted):
    end = time.monotonic() + 60.0
    while threads() != wanted:
        assert time.monotonic() < end, (threads(), wanted)
        time.sleep(0.01)
before = float(ones.sum())
alone = threads()
more = 1 + 1 + max(0, len(os.sched_getaffinity(0)) - 2)  # who holds the team, and the team
pressed.append(laps[0])
until(alone + more)
assert float(ones.sum()) == before and torch.get_num_threads() == 2
pressed.extend(laps[1:])
until(alone)
assert float(ones.sum()) == before
pressed.append(laps[0])
until(alone + more)  # and so the process ends
"""


@pytest.mark.skipif(ThreadClock().lap() is None, reason="the system does not count waiting")
def test_sleeping_threads_come_and_go(root):
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("OMP_", "GOMP_"))}
    subprocess.run([sys.executable, "-c", FOLLOWED], cwd=root, env=environment, check=True,
                   timeout=120)  # fmt: skip
