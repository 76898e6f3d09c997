"""Threads and processes: the same numbers, however the work is spread."""

import multiprocessing
import subprocess
import sys
import threading
import time

import pytest
import torch
from torch.utils.data import DataLoader, Dataset

from dolens import Rays, load_lens
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


def test_torchs_number_of_threads_is_obeyed(threads):
    threads(3)
    assert thread_count(10**6) == 3
    assert thread_count(100) == 1
    prepared, pieces = [], []
    together = threading.Barrier(3, timeout=60.0)

    def prepare():
        prepared.append(threading.get_ident())
        together.wait()  # so that no thread finds all shares taken
        return lambda first, last: pieces.extend(range(first, last))

    spread(prepare, 1000, 3)
    assert len(set(prepared)) == len(prepared) == 3
    assert sorted(pieces) == list(range(1000))
    assert torch.get_num_threads() == 3


def test_a_slow_core_gets_less_to_do():
    """One thread sleeps through its first share; the other does all the rest meanwhile."""
    done = {}
    first_share = threading.Event()

    def prepare():
        mine = done.setdefault(threading.get_ident(), [])

        def run(first, last):
            mine.append(last - first)
            if not first_share.is_set():
                first_share.set()
                time.sleep(0.5)

        return run

    spread(prepare, 1000, 2)
    shares = sorted(done.values(), key=sum)
    assert len(shares[0]) == 1 and sum(shares[0]) <= 250
    assert sum(shares[0]) + sum(shares[1]) == 1000


def test_an_error_in_a_worker_reaches_the_caller():
    caller = threading.get_ident()
    together = threading.Barrier(2, timeout=60.0)

    def prepare():
        together.wait()
        if threading.get_ident() != caller:
            raise ValueError("of a worker")
        return lambda first, last: None

    with pytest.raises(ValueError, match="of a worker"):
        spread(prepare, 2, 2)


def test_nobody_writes_after_an_interruption():
    """Ctrl-C in the calling thread: the arrays may go as soon as the error is out."""
    caller = threading.get_ident()
    working, finished = threading.Event(), threading.Event()

    def prepare():
        def run(first, last):
            if threading.get_ident() == caller:
                working.wait(60.0)
                raise KeyboardInterrupt
            working.set()
            time.sleep(0.3)
            finished.set()

        return run

    with pytest.raises(KeyboardInterrupt):
        spread(prepare, 100, 2)
    assert finished.is_set()


class _Traces(Dataset):
    def __init__(self, root):
        self.root = root

    def __len__(self):
        return 4

    def __getitem__(self, i):
        return _path(self.root)


def test_workers_of_a_data_loader(root, threads):
    """Forked after this process has used its own pool of threads."""
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
