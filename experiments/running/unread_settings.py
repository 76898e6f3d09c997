"""Settings that a user or an experiment makes and that nothing reads are errors.

Whether a setting is read is tried out: the parts of the configuration that a run reads (the fields
of `RunSettings`) are resolved with it and without it.  A setting whose absence changes nothing is
not read, whichever way an interpolation might have led to it.
"""

import copy
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from hydra import compose
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dolens.errors import InputError
from dolens.experiments.running.run_files import walk

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
                    node = _at(plain, path)
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


def _at(plain: Any, path: str) -> Any:
    """Return the plain value at a path; None where another interpolation lies on the way."""
    for key in path.split("."):
        if not isinstance(plain, Mapping) or key not in plain:
            return None
        plain = plain[key]
    return plain
