"""Jobs run in a process of their own, which is ended where one takes too long.

Nothing that a job does can then keep the server from answering.  The process keeps no lens: each
job is given what it needs, so that a new process goes on where the old one ended.
"""

import importlib
import logging
import os
import signal
import threading
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection
from typing import Any

import anyio

from dolens.errors import InputError

_JOBS = "dolens.mcp.jobs"
# Until the process has imported what it needs.
_START_SECONDS = 120.0
logger = logging.getLogger(__name__)


class Worker:
    """Runs one job at a time in a process of its own.

    Args:
        seconds: that a job may take.

    Rarely needed:
        jobs: a module whose `JOBS` has functions by their names.
    """

    def __init__(self, seconds: float, jobs: str = _JOBS) -> None:
        self.seconds, self._jobs = seconds, jobs
        self._process: Any = None
        self._pipe: Connection | None = None
        self._ready = False
        self._one = anyio.Lock()

    def start(self) -> Connection:
        """Start the process unless it runs, and return the pipe to it."""
        if self._process is None or not self._process.is_alive() or self._pipe is None:
            self.stop()
            context = get_context("spawn")
            self._pipe, other = context.Pipe()
            self._process = context.Process(target=serve, args=(other, self._jobs), daemon=True)
            self._process.start()
            other.close()
        return self._pipe

    def stop(self) -> None:
        """End the process, whatever it does."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
        if self._pipe is not None:
            self._pipe.close()
        self._process, self._pipe, self._ready = None, None, False

    async def run(self, job: str, arguments: dict[str, Any]) -> Any:
        """Run a job and return what it gives; where the caller gives up, the job ends.

        Args:
            job: name of a function in `JOBS`.
            arguments: plain values and bytes.

        Raises:
            InputError: the job raised one, failed, or took too long; one line.
        """
        async with self._one:
            pipe, answer = self.start(), None
            try:
                if not self._ready:
                    self._ready = await _received(pipe, _START_SECONDS) is not None
                pipe.send((job, arguments))
                answer = await _received(pipe, self.seconds)
            except (EOFError, OSError):
                raise InputError(
                    f"{job}: its process ended, perhaps for want of memory; ask for less"
                ) from None
            finally:
                if answer is None:
                    self.stop()
        if answer is None:
            raise InputError(
                f"{job}: took more than {self.seconds:g} s and was stopped; ask for less: fewer "
                "seconds, rays, lenses, starts or iterations"
            )
        kind, found = answer
        if kind == "refused":
            raise InputError(found)
        return found


async def _received(pipe: Connection, seconds: float) -> Any:
    """Return what comes through a pipe; None where nothing does in time."""
    with anyio.move_on_after(seconds):
        await anyio.wait_readable(pipe)
        return pipe.recv()
    return None


def serve(pipe: Connection, jobs_of: str) -> None:
    """Run jobs as they come: the worker's process.

    Args:
        pipe: gives (job, arguments), and takes ("found", result) or ("refused", line); at first
            "ready".
        jobs_of: the module that has them.
    """
    # The terminal's Ctrl-C is for the server, which ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_the_server, daemon=True).start()
    # Whatever a library prints: the standard output belongs to the protocol.
    os.dup2(2, 1)
    jobs = importlib.import_module(jobs_of).JOBS
    pipe.send("ready")
    while True:
        try:
            name, arguments = pipe.recv()
        except EOFError:
            return
        try:
            answer = ("found", jobs[name](**arguments))
        except InputError as error:
            answer = ("refused", str(error))
        except Exception as error:
            logger.exception("%s failed", name)
            answer = ("refused", f"{name}: an error of dolens itself: {type(error).__name__}")
        pipe.send(answer)


def _end_with_the_server() -> None:
    """End this process, whatever it does, when the server's has ended, however that went."""
    server = parent_process()
    if server is not None:
        server.join()
        os._exit(1)
