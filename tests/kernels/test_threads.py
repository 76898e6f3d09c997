"""Threads and processes: the same numbers, however the work is spread."""

import ctypes
import multiprocessing
import os
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, Dataset

from dolens import Rays, load_lens
from dolens.kernels.cpu import threads as threads_module
from dolens.kernels.cpu.threads import spread, thread_count


def traced(root, count=50_000, dtype=torch.float32):
    lens = load_lens(root / "conf" / "lens" / "cooke_triplet.yaml", dtype, backend="cpu")
    generator = torch.Generator().manual_seed(1)
    xy = (torch.rand((count, 2), generator=generator, dtype=dtype) - 0.5) * 12.0
    position = torch.cat((xy, torch.full((count, 1), -5.0, dtype=dtype)), 1).requires_grad_()
    direction = torch.tensor([0.0, 0.0, 1.0], dtype=dtype).expand(count, 3)
    hit = lens.trace(Rays(position, direction, 550.0))
    total = hit.position.square().sum() + hit.path_length.sum()
    wanted = [lens.surfaces["1"].curvature, lens.thicknesses["2"], position]
    return [hit.position, hit.status, *torch.autograd.grad(total, wanted)]


@pytest.fixture
def threads():
    """Set torch's threads, and put them back."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def test_any_number_of_threads_gives_the_same_bits(root, threads):
    """Sums are kept for chunks of rays that do not depend on it."""
    found = []
    for count in (1, 2, 3, 7):
        threads(count)
        found.append(traced(root))
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


DRIVER = ctypes.CFUNCTYPE(None, ctypes.POINTER(ctypes.c_int64), ctypes.c_int64, ctypes.c_int64)


@pytest.fixture(params=["openmp", "pool"])
def team(request, monkeypatch):
    """Torch's own threads, and the pool of those who cannot have them."""
    if request.param == "openmp":
        assert threads_module.torchs_openmp() is not None and not threads_module.is_forked()
    else:
        monkeypatch.setattr(threads_module, "torchs_openmp", lambda: None)
    return request.param


def run(work, pieces, threads):
    """Spread a function of (job, first, end) in Python, which any thread may call."""
    driver = DRIVER(lambda job, first, end: work(job[0], first, end))
    jobs = [np.array([number], dtype=np.int64) for number in range(threads)]
    addresses = [job.ctypes.data for job in jobs]
    spread(ctypes.cast(driver, ctypes.c_void_p).value, addresses, pieces)


def test_torchs_number_of_threads_is_obeyed(threads, team):
    """Each with a job of its own, and every piece done once."""
    threads(3)
    assert thread_count(10**6) == 3
    assert thread_count(100) == 1
    pieces, by_job = [], {}
    together = threading.Barrier(3, timeout=60.0)

    def work(job, first, end):
        if job not in by_job:
            by_job[job] = threading.get_native_id()
            together.wait()  # so that no thread finds all shares taken
        assert by_job[job] == threading.get_native_id()
        pieces.extend(range(first, end))

    run(work, 1000, 3)
    assert sorted(by_job) == [0, 1, 2] and len(set(by_job.values())) == 3
    assert threading.get_native_id() in by_job.values()
    assert sorted(pieces) == list(range(1000))
    assert torch.get_num_threads() == 3


def test_kernels_run_on_torchs_own_threads(root, threads, monkeypatch):
    """Where torch waits for its next operation, threads of ours would share the cores with it."""
    monkeypatch.setattr(threads_module, "run_in_pool", lambda *_: pytest.fail("a pool"))
    threads(2)
    torch.ones(1_000_000).exp()
    known = set(os.listdir("/proc/self/task"))
    traced(root)
    assert set(os.listdir("/proc/self/task")) <= known


def test_a_slow_core_gets_less_to_do(team):
    """One thread sleeps through its first share; the other does all the rest meanwhile."""
    done = {}
    first_share = threading.Event()

    def work(job, first, end):
        done.setdefault(job, []).append(end - first)
        if not first_share.is_set():
            first_share.set()
            time.sleep(0.5)

    run(work, 1000, 2)
    shares = sorted(done.values(), key=sum)
    assert len(shares[0]) == 1 and sum(shares[0]) <= 250
    assert sum(shares[0]) + sum(shares[1]) == 1000


def test_nobody_writes_after_an_interruption(threads, monkeypatch):
    """Ctrl-C in the calling thread of a pool: the arrays may go as soon as the error is out."""
    monkeypatch.setattr(threads_module, "torchs_openmp", lambda: None)
    caller = threading.get_ident()
    working, finished = threading.Event(), threading.Event()
    alone = threads_module.run_alone

    def interrupted(task):
        if threading.get_ident() == caller:
            working.wait(60.0)
            raise KeyboardInterrupt
        alone(task)

    def work(job, first, end):
        working.set()
        time.sleep(0.3)
        finished.set()

    monkeypatch.setattr(threads_module, "run_alone", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(work, 100, 2)
    assert finished.is_set()


class _Traces(Dataset):
    def __init__(self, root):
        self.root = root

    def __len__(self):
        return 4

    def __getitem__(self, i):
        return _path(self.root)


def test_workers_of_a_data_loader(root, threads):
    """Forked after this process has used its threads, which do not survive that."""
    threads(2)
    here = _path(root)
    loader = DataLoader(_Traces(root), num_workers=2, multiprocessing_context="fork", timeout=120)
    assert [float(batch) for batch in loader] == [here] * 4


def _path(root):
    """Of 20 000 rays: torch would not spread so few, and its own threads do not survive a fork."""
    lens = load_lens(root / "conf" / "lens" / "cooke_triplet.yaml", torch.float32, backend="cpu")
    position = torch.tensor([0.0, 1.0, -5.0]).expand(20_000, 3)
    with torch.no_grad():
        hit = lens.trace(Rays(position, torch.tensor([0.0, 0.0, 1.0]).expand(20_000, 3), 550.0))
    return float(hit.path_length[-1])


def _in_child(root, queue):
    torch.set_num_threads(2)
    assert thread_count(20_000) == 2
    queue.put(_path(root))


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_a_child_process_makes_its_own_pool(root, threads, method):
    threads(2)
    here = _path(root)
    context = multiprocessing.get_context(method)
    queue = context.Queue()
    child = context.Process(target=_in_child, args=(root, queue))
    child.start()
    assert queue.get(timeout=120) == here
    child.join(60)
    assert child.exitcode == 0


def test_import_compiles_nothing_and_loads_no_compiler(root):
    """The compiler comes with the first trace that wants it."""
    program = (
        "import sys, dolens; assert 'numba' not in sys.modules and 'triton' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], cwd=root, check=True, timeout=120)
