"""Independent tasks on workers: the same bits anywhere, in order, and no failure without a line."""

import importlib
import os
import signal
import sys
import time
from functools import partial
from importlib.util import find_spec

import pytest
import torch

from dolens import InputError, load_lens
from dolens.analysis.pupil_quadrature import gaussian_quadrature
from dolens.experiments.running.configuration import checked
from dolens.experiments.workers import RayWorkers, workers_of
from dolens.tasks import OwnThreads, TaskError, listening
from dolens.tolerancing import tolerances_from, trace_perturbed

# To import it would settle its mode of authentication.
RAY = pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")


def long_sum(task):
    """A sum that other numbers of threads split elsewhere, and so round otherwise."""
    numbers = torch.rand(1 << 17, generator=torch.Generator().manual_seed(task))
    return float(numbers.sum()), torch.get_num_threads()


def first_is_slow(task):
    time.sleep(0.5 if task == 0 else 0.0)
    return task


def shot_once(folder, task):
    """The third task's process is killed in the middle of it, the first time."""
    mark = folder / "shot"
    if task == 2 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return task * task


def shot_always(task):
    os.kill(os.getpid(), signal.SIGKILL)


def refused(task):
    if task == 2:
        raise InputError("radius: must not be 0")
    return task


def broken(task):
    if task == 1:
        raise ZeroDivisionError("by\nnothing")
    return task


def perturbed(lens, spots, map_tasks=None):
    """Spots of some lenses, in chunks of three."""
    tolerances = tolerances_from(lens, {"thicknesses.[13]": 0.02})
    errors = tolerances.draw(11, torch.Generator().manual_seed(0))
    return trace_perturbed(lens, spots, tolerances.names, errors, 3, map_tasks)


@pytest.fixture
def triplet_and_spots(root):
    # By the reference: workers would read kernels from a folder of their own.
    path = root / "conf/lens/cooke_triplet.yaml"
    lens = load_lens(path, dtype=torch.float64, backend="reference")
    return lens, gaussian_quadrature(lens, [(0.0, 0.0)], [587.6], 3, 6, symmetry=False)


def same(one, other):
    return all(
        torch.equal(getattr(one, name), getattr(other, name))
        for name in ("centroids", "failed", "vignetted")
    ) and torch.equal(one.curves.at(), other.curves.at())


@RAY
def test_a_local_cluster_of_two(triplet_and_spots, tmp_path, monkeypatch):
    """One cluster for all that takes one: to start it takes most of the time."""
    importlib.import_module("ray")  # who imported it before has settled its mode of authentication
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "home").mkdir()
    with workers_of(0).open() as own:
        expected = list(own(long_sum, range(6), "sums"))
    handler = signal.getsignal(signal.SIGTERM)
    events = []
    with workers_of(2).open() as map_tasks:
        with listening(lambda event: events.append(event.names[-1])):
            assert list(map_tasks(long_sum, range(6), "sums")) == expected
        assert events[0] == "workers start" and "sums: 0 of 6 done" in events
        assert list(map_tasks(first_is_slow, range(5), "tasks")) == list(range(5))
        assert same(perturbed(*triplet_and_spots), perturbed(*triplet_and_spots, map_tasks))
        # What was found before the task that fails is kept.
        found = []
        with pytest.raises(InputError, match=r"^lenses: 3 of 3: radius: must not be 0$"):
            found.extend(map_tasks(refused, range(3), "lenses"))
        with pytest.raises(TaskError, match=r"^fits: 2 of 2: ZeroDivisionError: by nothing$"):
            found.extend(map_tasks(broken, range(2), "fits"))
        assert found == [0, 1, 0]
        assert list(map_tasks(partial(shot_once, tmp_path), range(4), "fits")) == [0, 1, 4, 9]
        assert (tmp_path / "shot").exists()
        # A second one within goes to the same cluster, and leaves it running.
        with workers_of(1).open() as within:
            assert list(within(first_is_slow, [3], "tasks")) == [3]
        with (
            RayWorkers(1, retries=0).open() as within,
            pytest.raises(
                TaskError, match=r"^fits: 1 of 1: its process died at each of 1 attempts"
            ),
        ):
            list(within(shot_always, [0], "fits"))
    assert signal.getsignal(signal.SIGTERM) is handler
    assert not list((tmp_path / "home").iterdir())
    assert not [name for name in os.environ if name.startswith("RAY_AUTH")]


def test_own_process_has_one_thread_for_each_task(triplet_and_spots):
    before = torch.get_num_threads()
    with workers_of(0).open() as map_tasks:
        assert [threads for _, threads in map_tasks(long_sum, range(2), "sums")] == [1, 1]
        assert same(perturbed(*triplet_and_spots), perturbed(*triplet_and_spots, map_tasks))
    assert torch.get_num_threads() == before


@pytest.mark.parametrize("workers", [workers_of(0), OwnThreads(2)], ids=["in turn", "threads"])
def test_a_task_that_fails_is_named_and_those_before_it_are_kept(workers):
    found = []
    with workers.open() as map_tasks:
        with pytest.raises(InputError, match=r"^lenses: 3 of 4: radius: must not be 0$"):
            found.extend(map_tasks(refused, range(4), "lenses"))
        nothing = r"^fits: 2 of 2: ZeroDivisionError: by nothing$"
        with pytest.raises(TaskError, match=nothing) as end:
            found.extend(map_tasks(broken, range(2), "fits"))
    assert isinstance(end.value.__cause__, ZeroDivisionError)
    assert found == [0, 1, 0]


@pytest.mark.parametrize("setting", [-1, 1.5, True, "two", "auto "])
def test_other_settings_are_refused(setting):
    with pytest.raises(InputError, match=r"^workers: .*; allowed: null, 0 for this process"):
        workers_of(setting)


def test_without_ray_one_line_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with (
        workers_of(2).open() as map_tasks,
        pytest.raises(InputError, match=r"^workers=2: the package .* pip install 'dolens\[ray\]'$"),
    ):
        list(map_tasks(refused, [0], "tasks"))


def test_workers_of_an_experiment_without_tasks_are_refused(composed):
    with pytest.raises(InputError, match=r"^workers: nothing in experiment=asphere reads this"):
        checked(composed("experiment=asphere", "workers=2"))
    checked(composed("experiment=pose_accuracy", "workers=2"))


def test_threads_of_this_process_give_results_in_order_and_the_bits_of_one_thread():
    before = torch.get_num_threads()
    with OwnThreads(2).open() as map_tasks:
        found = list(map_tasks(long_sum, range(6), "sums"))
        assert list(map_tasks(first_is_slow, range(4), "tasks")) == [0, 1, 2, 3]
    with workers_of(0).open() as map_tasks:
        assert found == list(map_tasks(long_sum, range(6), "sums"))
    assert {threads for _, threads in found} == {1}
    assert torch.get_num_threads() == before
