"""Launchers of sweeps: what a failed or killed job leaves, and what is not run again."""

import copy
import json
import math
import os
import signal
import subprocess
import sys
import time
import zipfile
from functools import partial
from pathlib import Path

import pytest
from hydra.core.utils import setup_globals
from omegaconf import OmegaConf

from dolens.errors import InputError
from dolens.experiments.comparison.runs import read_unfinished, run_folders
from dolens.experiments.running.run_files import is_finished
from dolens.experiments.running.run_folder import OwnFolder
from dolens.experiments.sweeps import launchers
from dolens.experiments.sweeps.launchers import in_processes, in_ray_tasks, in_slurm_jobs, share_of
from tests.experiments.sweeps.small_sweep import ROOT, sweep


def begun(folder: Path, job: int) -> list[str]:
    return (folder / "jobs" / str(job) / "begun").read_text().splitlines()


LAUNCHERS = {
    "basic": [],
    "joblib": ["hydra.launcher.n_jobs=2"],
    "submitit_slurm": ["hydra.launcher.cluster=local", "hydra.launcher.timeout_min=5"],
    "ray": ["hydra.launcher.num_cpus=1"],
}
# What jobs do.  Hydra's own process would be gone; submitit repeats nothing by itself.
ACTS = {
    "basic": ["finish", "fail", "finish"],
    "joblib": ["finish", "fail", "kill", "kill_once"],
    "submitit_slurm": ["finish", "kill"],
    "ray": ["fail", "kill_once"],
}
PACKAGES = {"joblib": "joblib", "submitit_slurm": "submitit", "ray": "ray"}


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_a_failed_job_and_a_killed_one_leave_the_others(tmp_path, launcher, monkeypatch):
    """Both are recorded where a comparison finds them; a killed one is repeated first."""
    if launcher in PACKAGES:
        pytest.importorskip(PACKAGES[launcher])
    if launcher == "submitit_slurm":
        # It waits for results that a slow network folder may hide for some seconds.
        monkeypatch.setattr("submitit.Job._results_timeout_s", 1)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "home").mkdir()
    jobs = [f"value={number} act={act}" for number, act in enumerate(ACTS[launcher])]
    found = sweep(tmp_path, launcher, jobs, *LAUNCHERS[launcher])
    lost = {"fail", "kill"}
    expected = [math.nan if act in lost else n for n, act in enumerate(ACTS[launcher])]
    assert found == pytest.approx(expected, nan_ok=True)
    assert begun(tmp_path, 0) == ["MULTIRUN 1 None"]  # one thread, as the user said
    folders = run_folders(tmp_path / "jobs")
    assert [folder.name for folder in folders] == [str(job) for job in range(len(jobs))]
    reasons = [read_unfinished(folder).reason for folder in folders if not is_finished(folder)]
    assert len(reasons) == sum(act in lost for act in ACTS[launcher])
    assert all("ValueError: this job fails" in r or told_of_kill(r) for r in reasons), reasons
    assert list((tmp_path / "home").iterdir()) == []


@pytest.mark.parametrize(
    ("cores", "options", "threads"),
    [(3, ["hydra.launcher.array_parallelism=1"], 3), (1, [], 1)],
    ids=["as many as asked", "as many as there are cores for"],
)
def test_jobs_that_are_tried_for_slurm_share_this_machine(
    tmp_path, monkeypatch, cores, options, threads
):
    submitit = pytest.importorskip("submitit")
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(launchers, "allowed_processors", lambda: cores)
    said: list[str] = []
    monkeypatch.setattr(launchers.logger, "info", lambda text, *of: said.append(text % of))
    given, update = [], submitit.AutoExecutor.update_parameters
    monkeypatch.setattr(
        submitit.AutoExecutor,
        "update_parameters",
        lambda self, **options: given.append(options) or update(self, **options),
    )
    options = ["hydra.launcher.cluster=local", *options]
    assert sweep(tmp_path, "submitit_slurm", ["value=1", "value=2"], *options) == [1.0, 2.0]
    assert [begun(tmp_path, job) for job in (0, 1)] == [[f"MULTIRUN {threads} None"]] * 2
    # The second one began when the first had ended.
    first, second = (tmp_path / "jobs" / job for job in "01")
    assert (first / "metrics.json").stat().st_mtime_ns < (second / "begun").stat().st_mtime_ns
    assert given[0]["timeout_min"] == 24 * 60
    assert said == [f"2 jobs, 1 at once, of {threads} thread{'s' if threads > 1 else ''} each"]
    assert "OMP_NUM_THREADS" not in os.environ
    with pytest.raises(InputError, match=r"array_parallelism: 0; allowed"):
        list(in_slurm_jobs([Job()], str(tmp_path), cluster="local", array_parallelism=0))


def told_of_kill(reason: str) -> bool:
    return any(word in reason for word in ("was killed", "has not produced any output"))


def test_a_sweep_goes_on_with_what_is_not_finished(tmp_path):
    jobs = ["value=1", "value=2 act=fail", "value=3"]
    sweep(tmp_path, "basic", jobs)
    # As a job that was killed after its first checkpoint, and one killed while it wrote one.
    stopped = tmp_path / "jobs" / "1" / "checkpoints"
    stopped.mkdir()
    with zipfile.ZipFile(stopped / "last.ckpt", "w") as file:
        file.writestr("data", "")
    assert sweep(tmp_path, "basic", jobs) == pytest.approx([1.0, math.nan, 3.0], nan_ok=True)
    assert [len(begun(tmp_path, job)) for job in range(3)] == [1, 2, 1]
    assert begun(tmp_path, 1)[-1] == f"MULTIRUN None {stopped / 'last.ckpt'}".replace(
        "None", str(os.environ.get("OMP_NUM_THREADS")), 1
    )
    log = (tmp_path / "jobs" / "1" / "log.txt").read_text()
    assert "The run was stopped, and goes on from" in log
    (stopped / "last.ckpt").write_bytes(b"PK\x03\x04 half of it")
    # The job went on before, as its recorded configuration says: that is no other setting.
    sweep(tmp_path, "basic", [*jobs[:2], "value=3 threads=2"])
    assert begun(tmp_path, 1)[-1].endswith(" None") and not stopped.exists()


def test_a_folder_of_other_settings_is_refused_before_any_job(tmp_path):
    sweep(tmp_path, "basic", ["value=1", "value=2"])
    with pytest.raises(InputError, match=r"jobs/1 holds .*other settings: value is 3, was 2;"):
        sweep(tmp_path, "basic", ["value=1", "value=3", "value=4"])
    assert len(begun(tmp_path, 1)) == 1 and not (tmp_path / "jobs" / "2").exists()
    with pytest.raises(InputError, match=r"hydra\.launcher: .*'n_threads'"):
        sweep(tmp_path, "basic", ["value=1"], "+hydra.launcher.n_threads=2")


def test_processes_end_with_a_sweep_that_is_killed(tmp_path):
    """And what they did not finish is run by the same sweep once more."""
    pytest.importorskip("joblib")
    code = f"""
import sys
sys.path.insert(0, {str(ROOT)!r})
from pathlib import Path
from tests.experiments.sweeps.small_sweep import sweep
sweep(Path({str(tmp_path)!r}), "joblib", ["value=1", "value=2 act=wait"], "hydra.launcher.n_jobs=2")
"""
    process = subprocess.Popen([sys.executable, "-c", code])
    waiting = tmp_path / "jobs" / "1" / "run.json"
    done = tmp_path / "jobs" / "0" / "metrics.json"
    until(lambda: waiting.exists() and done.exists() and is_finished(done.parent), process)
    process.send_signal(signal.SIGKILL)
    process.wait()
    jobs = ["value=1", "value=2 act=wait"]
    assert sweep(tmp_path, "basic", jobs) == [1.0, 2.0]  # waits until the folder is free
    assert [len(begun(tmp_path, job)) for job in (0, 1)] == [1, 2]


def until(condition, process, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.05)


class Job:
    """What `share_of` reads of a job."""

    def __init__(self, threads=None):
        self.given = threads

    def threads(self):
        return self.given


@pytest.mark.parametrize(
    ("jobs", "n_jobs", "threads", "expected"),
    [
        (10, -1, None, (8, 1)),
        (10, -2, None, (7, 1)),
        (3, -1, None, (3, 2)),
        (10, 2, None, (2, 4)),
        (10, -1, 2, (4, 2)),
        (10, -1, 16, (1, 16)),
        (10, 4, 2, (4, 2)),
    ],
)
def test_jobs_at_once_times_threads_are_the_cores(monkeypatch, jobs, n_jobs, threads, expected):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    share = share_of([Job(threads)] * jobs, n_jobs, 8)
    assert (share.jobs, share.threads) == expected
    monkeypatch.setenv("OMP_NUM_THREADS", str(threads or ""))
    assert share_of([Job()] * jobs, n_jobs, 8) == share


def test_too_many_threads_are_told_and_no_jobs_refused(monkeypatch, caplog):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    assert share_of([Job(4)] * 9, 8, 8) == launchers.Share(8, 4)
    assert "8 jobs at once of 4 threads are more than the 8 cores" in caplog.text
    with pytest.raises(InputError, match=r"hydra\.launcher\.n_jobs: 0; allowed"):
        share_of([Job()], 0, 8)


def test_runs_of_one_second_have_folders_of_their_own(tmp_path):
    setup_globals()
    names = "${oc.select:hydra.runtime.choices.experiment,several}"
    place = f"{tmp_path}/{names}/${{now:%Y-%m-%d_%H-%M-%S}}"
    config = OmegaConf.create({"hydra": {"run": {"dir": place}, "sweep": {"dir": place}}})
    first = Path(config.hydra.run.dir)  # which keeps the second, as within one command
    again = [copy.deepcopy(config) for _ in range(3)]
    for one in again[:2]:
        OwnFolder().on_run_start(one)
    OwnFolder().on_multirun_start(again[2])
    found = [again[0].hydra.run.dir, again[1].hydra.run.dir, again[2].hydra.sweep.dir]
    assert [Path(path).name for path in found] == [first.name, f"{first.name}_2", f"{first.name}_3"]
    assert names in OmegaConf.to_container(again[2], resolve=False)["hydra"]["sweep"]["dir"]
    chosen = OmegaConf.create({"hydra": {"run": {"dir": str(tmp_path)}}})
    OwnFolder().on_run_start(chosen)
    assert chosen.hydra.run.dir == str(tmp_path)
    assert json.dumps(sorted(path.name for path in first.parent.iterdir()))


@pytest.mark.parametrize(
    ("package", "runner", "extra"),
    [
        ("joblib", in_processes, "sweep"),
        ("ray", in_ray_tasks, "ray"),
        ("submitit", partial(in_slurm_jobs, folder="jobs"), "slurm"),
    ],
)
def test_a_missing_package_is_named_with_its_extra(monkeypatch, package, runner, extra):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=rf"'{package}' is not installed; .*dolens\[{extra}\]"):
        list(runner([Job()]))
