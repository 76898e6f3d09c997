"""A run starts the server of its page, as a process of its own that the run does not wait for."""

import logging
import subprocess
import sys
from pathlib import Path
from threading import Thread

logger = logging.getLogger(__name__)

IDLE_MINUTES = 10
"""Minutes without a look, after which the server ends when the run has ended."""


def start_page(run: Path) -> "subprocess.Popen[str]":
    """Start `dolens watch` for a run; the log says its address.

    The process outlives the run, and what stops the run: Ctrl-C does not reach it.

    Args:
        run: the run folder.
    """
    words = [sys.executable, "-m", "dolens", "watch", str(run), "--idle", str(IDLE_MINUTES)]
    process = subprocess.Popen(
        words,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    Thread(target=_repeat, args=(process,), name="dolens page", daemon=True).start()
    return process


def _repeat(process: "subprocess.Popen[str]") -> None:
    """Log what the server says: its address, or why there is none."""
    assert process.stdout is not None
    for line in process.stdout:
        logger.info("Live page: %s", line.strip())
