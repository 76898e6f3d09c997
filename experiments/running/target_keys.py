"""Keys and values beside a `_target_` are checked: no class takes them, or they are missing."""

import pkgutil
import re
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import MISSING, DictConfig, OmegaConf

from dolens.errors import InputError, check_keys
from dolens.experiments.running.run_files import walk
from dolens.experiments.settings import check_count, check_not_negative, check_positive
from dolens.typed_values import check_type, parameters_of

_HYDRAS = frozenset(("_target_", "_partial_", "_convert_", "_recursive_", "_args_"))
# A value that is another part of the configuration as a whole, as `network: ${network}`.
REFERENCE = re.compile(r"\$\{([\w.@]+)\}")


class Target(NamedTuple):
    """A mapping that Hydra makes something of.

    Attributes:
        path: where it stands, as a user names it.
        name: what it makes, as `torch.optim.Adam`.
        keys: the arguments that it gives.
        values: of these, not resolved.
    """

    path: str
    name: str
    keys: tuple[str, ...]
    values: Mapping[str, Any] = MappingProxyType({})


def refuse_unknown_keys(plain: Mapping[str, Any], parts: Sequence[str]) -> None:
    """Refuse keys beside a `_target_` that are no arguments of it.

    Args:
        plain: the configuration, not resolved.
        parts: top-level keys that Hydra makes something of.

    Raises:
        InputError: the first such key, with the nearest argument that there is; or a target that
            does not exist.
    """
    for target in targets(plain, parts):
        taken = parameters_of(located(target))
        if taken.closed:
            check_keys(target.keys, list(taken.hints), target.path)


def refuse_targets_in_lenses(plain: Mapping[str, Any]) -> None:
    """Refuse a `_target_` in a prescription: lens files are data, and make nothing.

    Args:
        plain: the configuration, not resolved.

    Raises:
        InputError: the first one.
    """
    for group in HydraConfig.get().runtime.choices:
        name, _, package = str(group).partition("@")
        if name != "lens":
            continue
        lens = value_at(plain, package or name)
        for path, node, _ in walk(package or name, lens):
            for key in sorted(_HYDRAS.intersection(node)) if isinstance(node, dict) else ():
                raise InputError(
                    f"{path}: unknown key '{key}'; a prescription is data and makes nothing"
                )


def refuse_missing(plain: Mapping[str, Any], parts: Sequence[str]) -> None:
    """Refuse settings that must be given and are not: `???` in a file of the configuration.

    Args:
        plain: the configuration, not resolved.
        parts: top-level keys that Hydra makes something of.

    Raises:
        InputError: the first such setting.
    """
    for path, node in _settings(plain, parts):
        if node == MISSING:
            raise InputError(
                f"{path}: must be given; neither experiment="
                f"{HydraConfig.get().runtime.choices.get('experiment')} nor the command line does"
            )


def targets(plain: Mapping[str, Any], parts: Sequence[str]) -> Iterator[Target]:
    """Yield all targets of some parts of a configuration, each once.

    Args:
        plain: the configuration, not resolved.
        parts: top-level keys; what they refer to as a whole (`${network}`) belongs to them.
    """
    for path, node in _settings(plain, parts):
        if isinstance(node, dict) and isinstance(node.get("_target_"), str):
            given = {str(key): value for key, value in node.items() if key not in _HYDRAS}
            yield Target(path, node["_target_"], tuple(given), given)


def names_of_targets(cfg: DictConfig, parts: Sequence[str]) -> list[str]:
    """Return the names of all that Hydra makes of some parts, as `torch.optim.Adam`."""
    plain = OmegaConf.to_container(cfg, resolve=False)
    return list(dict.fromkeys(target.name for target in targets(plain, parts)))


def _settings(plain: Mapping[str, Any], parts: Sequence[str]) -> Iterator[tuple[str, Any]]:
    """All settings of some parts, and of what these refer to: path and value, each once."""
    seen: set[str] = set()

    def visit(path: str, node: Any) -> Iterator[tuple[str, Any]]:
        reference = REFERENCE.fullmatch(node) if isinstance(node, str) else None
        if reference:
            path, node = reference[1], value_at(plain, reference[1])
        if path in seen:
            return
        seen.add(path)
        yield path, node
        if isinstance(node, dict | list):
            for key, value in node.items() if isinstance(node, dict) else enumerate(node):
                yield from visit(f"{path}.{key}", value)

    for part in parts:
        yield from visit(part, plain.get(part))


def located(target: Target) -> Any:
    """Return the class or function of a target.

    Raises:
        InputError: there is none.
    """
    try:
        return pkgutil.resolve_name(target.name)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(
            f"{target.path}._target_: '{target.name}' cannot be found ({error})"
        ) from None


def value_at(plain: Any, path: str) -> Any:
    """Return the value at a path; None where there is nothing."""
    for key in path.split("."):
        if isinstance(plain, list) and key.isdecimal():
            plain = dict(enumerate(plain)).get(int(key))
        else:
            plain = plain.get(key) if isinstance(plain, dict) else None
    return plain


def refuse_wrong_types(plain: Mapping[str, Any], parts: Sequence[str]) -> None:
    """Refuse values beside a `_target_` that the hints of its arguments do not allow.

    Args:
        plain: the configuration, not resolved; what refers to another setting as a whole
            (`${seed}`) is looked up, and named by that; other interpolations are left alone.
        parts: top-level keys that Hydra makes something of.

    Raises:
        InputError: the first such value.
    """
    for target in targets(plain, parts):
        make = located(target)
        hints = parameters_of(make).hints
        for key in target.keys:
            path, value = _followed(plain, f"{target.path}.{key}", target.values[key])
            if not _is_open(value):
                check_type(value, hints.get(key, Any), path)
        if isinstance(make, type) and issubclass(make, torch.optim.Optimizer):
            _try_optimizer(plain, target, make)
        if isinstance(make, type) and issubclass(make, torch.optim.lr_scheduler.LRScheduler):
            check_schedule(target.path, _known(plain, target))


def _try_optimizer(plain: Mapping[str, Any], target: Target, make: type) -> None:
    """Make an optimizer of torch or of dolens of a number: it checks its settings before work."""
    if not make.__module__.startswith(("torch.optim", "dolens.optimize")):
        return
    try:
        make([torch.nn.Parameter(torch.zeros(1))], **_known(plain, target))
    except (ValueError, TypeError, RuntimeError) as error:
        raise InputError(f"{target.path}: {error}") from None


def _known(plain: Mapping[str, Any], target: Target) -> dict[str, Any]:
    """Return the values of a target that are known before anything is made."""
    values = {key: _followed(plain, key, value)[1] for key, value in target.values.items()}
    return {key: value for key, value in values.items() if not _is_open(value)}


def _followed(plain: Mapping[str, Any], path: str, value: Any) -> tuple[str, Any]:
    """Return the setting that a value refers to in the end, and its name."""
    for _ in range(20):
        reference = REFERENCE.fullmatch(value) if isinstance(value, str) else None
        if reference is None:
            break
        path, value = reference[1], value_at(plain, reference[1])
    return path, value


def _is_open(value: Any) -> bool:
    """Return whether a value is not known yet, or is made by Hydra."""
    if isinstance(value, dict):
        return "_target_" in value or any(_is_open(part) for part in value.values())
    if isinstance(value, list):
        return any(_is_open(part) for part in value)
    return isinstance(value, str) and ("${" in value or value == "???")


_COUNTS = ("T_max", "T_0", "T_mult", "step_size", "total_iters", "total_steps", "step_size_up")
_RATES = ("eta_min", "min_lr", "base_lr")
_POSITIVE = ("gamma", "max_lr")


def check_schedule(path: str, settings: Mapping[str, Any]) -> None:
    """Refuse lengths and learning rates that a schedule cannot work with.

    Args:
        path: of the schedule; messages begin with it.
        settings: those that are known; null is PyTorch's own.

    Raises:
        InputError: a length that is no positive integer, or a rate that is negative or no number.
    """
    for keys, check in (
        (_COUNTS, check_count),
        (_RATES, check_not_negative),
        (_POSITIVE, check_positive),
    ):
        for key in keys:
            if settings.get(key) is not None and not isinstance(settings[key], list):
                check(f"{path}.{key}", settings[key])
