"""What could not be made of a configuration is explained in one line that names its setting."""

import re
from collections.abc import Iterator, Mapping
from typing import Any

from hydra.errors import InstantiationException
from omegaconf import DictConfig, OmegaConf

from dolens.errors import InputError, one_line
from dolens.experiments.running.target_keys import REFERENCE, targets

_TARGET = re.compile(r"call to target '(?P<name>[^']*)'")
_KEY = re.compile(r"full_key: (?P<key>\S+)")
# A part of a text, as `test/${score}`.
_WITHIN = re.compile(r"\$\{([\w.]+)\}")
_NAME = re.compile(r"[\w.]+")
# A message begins with what it is about: a part's name and a setting's.
_SUBJECT = 3


def reason_of(error: BaseException, cfg: DictConfig | None = None) -> str:
    """Return what to say of an error that ends a run, on one line.

    Hydra reports a class that could not be made; the reason is what the user can mend, and where a
    class of others gives it, the setting that makes this class is named.  A class names its own
    arguments; where the configuration gives them by another setting, that is named too.

    Args:
        error: what ended the run.
        cfg: the run's configuration.
    """
    cause = error.__cause__
    if isinstance(cause, InputError):
        return _with_setting(str(cause), cfg)
    if isinstance(error, InputError):
        return _with_setting(str(error), cfg)
    target, key = _TARGET.search(str(error)), _KEY.search(str(error))
    if cause is None or target is None or not isinstance(error, InstantiationException):
        return one_line(error)
    where = key["key"] if key else "configuration"
    name = target["name"].rpartition(".")[2]
    return str(InputError(f"{where}: {name} cannot be made with these settings ({cause})"))


def _with_setting(message: str, cfg: DictConfig | None) -> str:
    """Return a message with the names of the settings that its subject refers to."""
    if cfg is None:
        return message
    names = _NAME.findall(message)[:_SUBJECT]
    plain = OmegaConf.to_container(cfg, resolve=False)
    found = list(dict.fromkeys(_referred(plain, [name.rstrip(".") for name in names])))
    if not found or any(re.search(rf"\b{re.escape(name)}\b", message) for name in found):
        return message
    return str(InputError(f"{message} (set by {' or '.join(found)})"))


def _referred(plain: Mapping[str, Any], names: list[str]) -> Iterator[str]:
    """Yield the settings that arguments of these names are given by."""
    for name in names:
        value = plain.get(name)
        yield from _WITHIN.findall(value) if isinstance(value, str) else ()
    asked = {name.rpartition(".")[2] for name in names}
    for target in targets(plain, tuple(str(key) for key in plain)):
        for key in asked.intersection(target.keys):
            reference = REFERENCE.fullmatch(str(target.values[key]))
            if reference is not None and reference[1].rpartition(".")[2] != key:
                yield reference[1]
