"""Keys that no class takes, and settings that are missing, are errors."""

import inspect
import pkgutil
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

from hydra.core.hydra_config import HydraConfig
from omegaconf import MISSING, DictConfig, OmegaConf

from dolens.errors import InputError, check_keys
from dolens.experiments.running.plain_values import walk

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
        allowed = arguments_of(located(target))
        if allowed is not None:
            check_keys(target.keys, allowed, target.path)


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


def arguments_of(make: Callable[..., Any]) -> list[str] | None:
    """Return the names of the arguments that something takes; None where it takes any.

    What a class takes as `**options` is taken to be for the classes that it derives from.
    """
    try:
        call = make.__init__ if isinstance(make, type) else make
        parameters = list(inspect.signature(call).parameters.values())
    except (TypeError, ValueError):  # of some classes that are written in C
        return None
    named = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    found = [p.name for p in parameters if p.kind in named and p.name != "self"]
    if any(p.kind is p.VAR_KEYWORD for p in parameters):
        bases = [base for base in getattr(make, "__bases__", ()) if base is not object]
        inherited = [arguments_of(base) for base in bases]
        if not inherited or None in inherited:
            return None
        found += [name for names in inherited for name in names]
    return list(dict.fromkeys(found))


def value_at(plain: Any, path: str) -> Any:
    """Return the value at a path; None where there is nothing."""
    for key in path.split("."):
        if isinstance(plain, list) and key.isdecimal():
            plain = dict(enumerate(plain)).get(int(key))
        else:
            plain = plain.get(key) if isinstance(plain, dict) else None
    return plain
