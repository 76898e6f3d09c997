"""What could not be made of a configuration is explained in one line that names its setting."""

import re

from hydra.errors import InstantiationException

from dolens.errors import InputError, one_line

_TARGET = re.compile(r"call to target '(?P<name>[^']*)'")
_KEY = re.compile(r"full_key: (?P<key>\S+)")


def reason_of(error: BaseException) -> str:
    """Return what to say of an error that ends a run, on one line.

    Hydra reports a class that could not be made; the reason is what the user can mend, and where a
    class of others gives it, the setting that makes this class is named.
    """
    cause = error.__cause__
    if isinstance(cause, InputError):
        return str(cause)
    target, key = _TARGET.search(str(error)), _KEY.search(str(error))
    if cause is None or target is None or not isinstance(error, InstantiationException):
        return one_line(error)
    where = key["key"] if key else "configuration"
    name = target["name"].rpartition(".")[2]
    return str(InputError(f"{where}: {name} cannot be made with these settings ({cause})"))
