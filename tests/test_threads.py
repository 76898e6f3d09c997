"""The processors that a process may use, by masks and quotas, and how long it waits for them."""

import os
import subprocess
import sys
import time

import pytest

from dolens import threads
from dolens.threads import ThreadClock, allowed_processors, processors

PLENTY = 64


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """Files of a machine with 64 processors, as Linux would show them."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(PLENTY)), raising=False)

    def build(groups, **files):
        (tmp_path / "proc/self").mkdir(parents=True, exist_ok=True)
        (tmp_path / "proc/self/cgroup").write_text(groups)
        for name, text in files.items():
            path = tmp_path / "sys/fs/cgroup" / name.replace("__", "/").replace("cpu_", "cpu.")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return tmp_path

    return build


@pytest.mark.parametrize(
    ("quota", "expected"),
    [
        ("200000 100000", 2),
        ("150000 100000", 1),  # a second thread would be waited for by the first
        ("50000 100000", 1),
        ("2000 1000\n", 2),
        ("max 100000", PLENTY),
        ("9900000 100000", PLENTY),
        ("", PLENTY),
    ],
)
def test_quotas_of_version_2(machine, quota, expected):
    assert allowed_processors(machine("0::/\n", cpu_max=quota)) == expected


def test_the_groups_around_a_group_bind_it_too(machine):
    root = machine("0::/user/job\n", user__job__cpu_max="800000 100000",
                   user__cpu_max="300000 100000")  # fmt: skip
    assert allowed_processors(root) == 3
    # A container that sees its own group as the root, by whatever name the host knows it.
    assert allowed_processors(machine("0::/docker/1f3c\n", cpu_max="400000 100000")) == 4


def test_quotas_of_version_1(machine):
    groups = "9:memory:/\n4:cpuset:/\n1:cpu,cpuacct:/job\n"
    root = machine(groups, cpu__job__cpu_cfs_quota_us="-1\n", cpu__job__cpu_cfs_period_us="100000")
    assert allowed_processors(root) == PLENTY
    root = machine(groups, cpu__job__cpu_cfs_quota_us="250000\n")
    assert allowed_processors(root) == 2


def test_the_affinity_mask_counts_and_files_may_be_missing(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3, 5, 9}, raising=False)
    assert allowed_processors(tmp_path) == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    assert processors() == os.cpu_count()


BESIDE = """
import os, subprocess, sys, time
from dolens.threads import ThreadClock
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
busy = "while True: pass"
other = subprocess.Popen([sys.executable, "-c", busy])
try:
    clock, end = ThreadClock(), time.process_time() + 0.3
    while time.process_time() < end: pass
    print(clock.lap().share_waited)
finally:
    other.kill()
"""


@pytest.mark.skipif(ThreadClock().lap() is None, reason="the system does not count waiting")
def test_a_process_that_shares_its_only_processor_waits_for_it(root):
    done = subprocess.run([sys.executable, "-c", BESIDE], cwd=root, capture_output=True, text=True,
                          check=True, timeout=120)  # fmt: skip
    assert float(done.stdout) > 0.2


@pytest.mark.skipif(ThreadClock().lap() is None, reason="the system does not count waiting")
def test_sleep_is_not_waiting():
    clock, waited = ThreadClock(), []
    for _ in range(5):
        time.sleep(0.1)
        waited.append(clock.lap().waited)
    # A loaded machine may let it wait after a sleep, but hardly after each.
    assert min(waited) < 0.09


@pytest.fixture
def clean(monkeypatch):
    """A process before PyTorch is imported, without a word about threads."""
    for name in threads.COUNTS:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    # Whatever a test sets goes with it.
    monkeypatch.setattr(os, "environ", dict(os.environ))
    return monkeypatch


def test_threads_keep_to_a_quota_unless_the_user_says_otherwise(clean):
    clean.setattr(threads, "allowed_processors", lambda: 2)
    clean.setattr(threads, "processors", lambda: 2)
    threads.limit_threads()
    assert "OMP_NUM_THREADS" not in os.environ  # there is no quota, and PyTorch knows the mask
    clean.setattr(threads, "processors", lambda: 64)
    os.environ["MKL_NUM_THREADS"] = "5"
    threads.limit_threads()
    assert "OMP_NUM_THREADS" not in os.environ
    del os.environ["MKL_NUM_THREADS"]
    threads.limit_threads()
    assert os.environ["OMP_NUM_THREADS"] == "2"


def test_a_library_import_changes_no_setting_of_the_process(root):
    program = "import os; a = dict(os.environ); import dolens; assert a == dict(os.environ)"
    subprocess.run([sys.executable, "-c", program], cwd=root, check=True, timeout=120)
