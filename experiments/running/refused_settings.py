"""Settings are refused before any work: those that are missing, those beside a `_target_` that its
class does not take or that have a wrong type, and those that nothing reads.

Whether a setting is read is tried out: the parts of the configuration that a run reads (the fields
of `RunSettings`) are resolved with it and without it.  A setting whose absence changes nothing is
not read, whichever way an interpolation might have led to it.
"""

import copy
import pkgutil
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from hydra import compose
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import MISSING, DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dolens.errors import InputError, check_count, check_keys
from dolens.experiments.running.run_files import walk
from dolens.experiments.settings import check_not_negative, check_positive
from dolens.typed_values import check_type, parameters_of

_HYDRAS = frozenset(("_target_", "_partial_", "_convert_", "_recursive_", "_args_"))
# A value that is another part of the configuration, as `network: ${network}`.
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


# Resolved to this where a part cannot be resolved at all.
_BROKEN = object()


def refuse_unread(cfg: DictConfig, taken: Sequence[str]) -> None:
    """Refuse settings that nothing reads, before any work is done.

    What the command line sets must be read, and so must every top-level key that differs from the
    configuration without an experiment.  Defaults that an experiment does not use are allowed, and
    so are settings without content: null, [] and {}.

    Args:
        cfg: the composed configuration without Hydra's own part.
        taken: top-level keys that the run itself reads.

    Raises:
        InputError: the first such setting.
    """
    own = cfg.copy()
    OmegaConf.set_struct(own, False)
    before = _resolved(own, taken)
    if any(part is _BROKEN for part in before):
        return  # what is wrong with it is said where it is used
    references = References.of(OmegaConf.to_container(own, resolve=False), taken)
    choices = HydraConfig.get().runtime.choices
    unnamed = [
        path
        for path in (*_set_by_command_line(), *_set_by_experiment(own))
        if path.split(".")[0] not in taken and not references.need(path) and _has_content(own, path)
    ]
    text_of_hydra = _text_of_hydra() if unnamed else ""
    for path in unnamed:
        if f"${{{path}" in text_of_hydra:
            continue
        top = path.split(".")[0]
        without = copy.deepcopy(own)
        _delete(without, path)
        if _resolved(without, taken) == before:
            choice = choices.get(top)
            setting = f"{path}={choice}" if path == top and choice else path
            raise InputError(
                f"{setting}: nothing in experiment={choices.get('experiment')} reads this setting; "
                "leave it out, or give it to what should read it in the experiment's file"
            )


def _resolved(cfg: DictConfig, taken: Sequence[str]) -> list[Any]:
    """The parts that a run takes, as plain containers with no interpolation left."""
    found = []
    for key in taken:
        try:
            node = cfg.get(key)
            is_node = isinstance(node, DictConfig | ListConfig)
            found.append(OmegaConf.to_container(node, resolve=True) if is_node else node)
        except OmegaConfBaseException:
            found.append(_BROKEN)
    return found


def _text_of_hydra() -> str:
    """Return Hydra's own settings as they are written."""
    return str(OmegaConf.to_container(HydraConfig.instance().cfg.hydra, resolve=False))


def _set_by_command_line() -> Iterator[str]:
    """Paths of what the job's overrides set."""
    # As they were typed: an interpolation in one of them is not for here.
    task = OmegaConf.to_container(HydraConfig.get().overrides.task, resolve=False)
    for override in OverridesParser.create().parse_overrides(task):
        path = _path_of(override)
        if path is not None and path != "experiment":
            yield path


def _path_of(override: Override) -> str | None:
    """Return the path of an override's value; None where it deletes."""
    if override.is_delete():
        return None
    path = override.package if override.package is not None else override.key_or_group
    return path.replace("/", ".")


def _set_by_experiment(cfg: DictConfig) -> Iterator[str]:
    """Top-level keys that differ from the configuration without an experiment."""
    if not GlobalHydra.instance().is_initialized():
        return  # a launcher that brings its jobs to other processes: they cannot compose
    sources = tuple(source.path for source in HydraConfig.get().runtime.config_sources)
    plain = _without_experiment(HydraConfig.get().job.config_name or "train", sources)
    for key, value in OmegaConf.to_container(cfg, resolve=False).items():
        if key not in plain or value != plain[key]:
            yield str(key)


@cache
def _without_experiment(name: str, sources: tuple[str, ...]) -> dict[str, Any]:
    """The defaults; composed once for all jobs of a sweep."""
    return OmegaConf.to_container(compose(name, overrides=["~experiment"]), resolve=False)


def _has_content(cfg: DictConfig, path: str) -> bool:
    """Return whether there is something at a path that could be read."""
    try:
        node = OmegaConf.select(cfg, path, throw_on_missing=False)
    except OmegaConfBaseException:
        return True
    return node is not None and not (isinstance(node, DictConfig | ListConfig) and not len(node))


def _delete(cfg: DictConfig, path: str) -> None:
    """Take away what lies at a path."""
    parent, _, last = path.rpartition(".")
    node = OmegaConf.select(cfg, parent) if parent else cfg
    del node[int(last) if isinstance(node, ListConfig) else last]


# `${network}`, `${data.batch_size}`: from the top, and not as the argument of a resolver's name.
_PLAIN = re.compile(r"\$\{([A-Za-z_]\w*(?:\.\w+)*)\}")


@dataclass(frozen=True)
class References:
    """The settings that some parts of a configuration cannot be resolved without.

    Attributes:
        wholes: dotted paths that are a value, with all that lies below them.
        within: dotted paths within a longer text, or in the arguments of a resolver.
    """

    wholes: frozenset[str]
    within: frozenset[str]

    @classmethod
    def of(cls, plain: Mapping[str, Any], parts: Sequence[str]) -> "References":
        """Return the references that begin in some parts, and go on in what they lead to.

        Those that are relative, nested, indexed or optional are not among them.

        Args:
            plain: the configuration as plain values, with its interpolations.
            parts: top-level keys.
        """
        wholes: set[str] = set()
        within: set[str] = set()
        waiting = [plain.get(key) for key in parts]
        while waiting:
            for text in _texts(waiting.pop()):
                whole = _PLAIN.fullmatch(text)
                for path in {*_PLAIN.findall(text)} - (wholes if whole else within):
                    (wholes if whole else within).add(path)
                    node = value_at(plain, path)
                    # A resolver may take some of a mapping's entries only.
                    if whole or isinstance(node, str):
                        waiting.append(node)
        return cls(frozenset(wholes), frozenset(within))

    def need(self, path: str) -> bool:
        """Return whether a setting is surely needed; others may be needed by ways unseen here.

        Args:
            path: dotted, of a setting that is there.
        """
        return any(_lies_in(path, one) or _lies_in(one, path) for one in self.wholes) or any(
            _lies_in(one, path) for one in self.within
        )


def _lies_in(inner: str, outer: str) -> bool:
    return inner == outer or inner.startswith(f"{outer}.")


def _texts(node: Any) -> Iterator[str]:
    """Yield the texts in a node that may hold an interpolation; one behind a backslash is none."""
    for _, value, _ in walk(".", node):
        if isinstance(value, str) and "${" in value and "\\" not in value:
            yield value
