"""A logger that fails does not end the training that it tells of."""

import functools
import logging
from collections.abc import Callable
from typing import Any, TypeVar

from lightning.pytorch.loggers.logger import Logger

from dolens.errors import one_line

_log = logging.getLogger(__name__)

_CALLED = (
    *("log_hyperparams", "log_metrics", "log_picture", "log_summary", "log_graph"),
    *("after_save_checkpoint", "save", "finalize"),
)
Kind = TypeVar("Kind", bound=type[Logger])


def ends_alone(kind: Kind) -> Kind:
    """Make a class of loggers one whose failures are logged: a run goes on without the logger.

    The first failure is an error in the run's log, with its reason.  After it the logger is asked
    for nothing more.  What cannot be made to begin with is an error of the run.
    """
    for name in _CALLED:
        method = getattr(kind, name, None)
        if method is not None:
            setattr(kind, name, _guarded(name, method))
    return kind


def _guarded(name: str, method: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(method)
    def guarded(self: Any, *arguments: Any, **options: Any) -> Any:
        if getattr(self, "has_failed", False):
            return None
        try:
            return method(self, *arguments, **options)
        except Exception as error:
            self.has_failed = True
            first = _first_of(error)
            _log.error(
                "The logger %s has failed in %s (%s: %s); the run goes on without it",
                type(self).__name__,
                name,
                type(first).__name__,
                one_line(first),
                exc_info=not isinstance(first, OSError),  # as a full disk, which needs no traceback
            )
            return None

    return guarded


def _first_of(error: BaseException) -> BaseException:
    """Return the error that others were raised for, as Lightning does for one about a value."""
    before = error.__cause__ or error.__context__
    return error if before is None else _first_of(before)
