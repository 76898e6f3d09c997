"""A job that hangs, fails or dies answers in one line, and the next one runs."""

import os
import subprocess
import sys
import time
from pathlib import Path

import anyio
import pytest

from dolens import InputError
from dolens.mcp.worker import Worker

JOBS = "tests.mcp.jobs_of_a_test"


@pytest.fixture
def refusal(worker, run_async):
    """What a job is refused with, as text."""

    def refusal(job, **arguments):
        with pytest.raises(InputError) as refused:
            run_async(worker.run, job, arguments)
        return str(refused.value)

    return refusal


@pytest.fixture
def worker():
    worker = Worker(0.5, JOBS)
    yield worker
    worker.stop()


def test_every_job_ends_in_time_and_the_next_one_runs(worker, refusal, run_async, capfd):
    started = time.perf_counter()
    assert refusal("sleep", seconds=60).startswith("sleep: took more than 0.5 s and was")
    assert time.perf_counter() - started < 30.0
    assert refusal("refuse") == "no such thing"
    assert refusal("fail") == "fail: an error of dolens itself: KeyError"
    assert refusal("end").startswith("end: its process ended")

    async def say():
        return await worker.run("say", {}), await worker.run("say", {})

    # One process goes on with jobs, and what they print is not on the standard output.
    first, second = run_async(say)
    assert first == second
    said = capfd.readouterr()
    assert said.out == "" and said.err.count("in the way of the protocol") == 2


def test_a_call_that_is_given_up_ends_its_job(worker, run_async):
    async def give_up():
        await worker.run("say", {})
        with anyio.move_on_after(0.1):
            await worker.run("sleep", {"seconds": 60})
        assert worker._process is None
        return await worker.run("sleep", {"seconds": 0})

    assert run_async(give_up) == "awake"


SERVER = """
import anyio, sys
from dolens.mcp.worker import Worker
if __name__ == "__main__":
    async def run():
        worker = Worker(60, "tests.mcp.jobs_of_a_test")
        print(await worker.run("say", {}), flush=True)
        await worker.run("sleep", {"seconds": 60})
    anyio.run(run)
"""


def test_the_process_ends_with_the_server_however_that_ends(tmp_path, root):
    (tmp_path / "server.py").write_text(SERVER)
    command = [sys.executable, tmp_path / "server.py"]
    kwargs = {
        "stdout": -1,
        "stderr": subprocess.DEVNULL,
        "env": {**os.environ, "PYTHONPATH": str(root)},
    }
    with subprocess.Popen(command, **kwargs) as server:
        pid = int(server.stdout.readline())
        assert Path(f"/proc/{pid}").exists()
        server.kill()
    deadline = time.monotonic() + 20.0
    while Path(f"/proc/{pid}").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not Path(f"/proc/{pid}").exists()
