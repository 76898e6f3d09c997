"""A fault of the machine that ends a thread is one line, as one that ends a run is."""

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from dolens.experiments.running.machine_faults import machine_fault

logger = logging.getLogger(__name__)


@contextmanager
def thread_faults_in_one_line() -> Iterator[None]:
    """Log one line where a full disk, or the like, ends a thread, such as TensorBoard's writer.

    Its owner hears of the error itself.  Other errors of threads keep their traceback.
    """
    before = threading.excepthook

    def told(arguments: threading.ExceptHookArgs) -> None:
        fault = machine_fault(arguments.exc_value) if arguments.exc_value else None
        if fault is None:
            before(arguments)
        else:
            name = arguments.thread.name if arguments.thread else "a thread"
            logger.warning("%s has ended: %s", name, fault)

    threading.excepthook = told
    try:
        yield
    finally:
        threading.excepthook = before
