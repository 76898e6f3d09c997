"""Old names of the configuration: refused in one line that has the new name, or translated."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dolens.errors import InputError, did_you_mean
from dolens.experiments.running.command_line import override_text
from dolens.experiments.running.renamed_keys import RENAMED, Key, Renamed
from dolens.experiments.running.run_files import walk
from dolens.experiments.running.target_keys import Target, arguments_of, located


class Change(NamedTuple):
    """A setting as it was written, and as it is written now.

    Attributes:
        old: the dotted path that was written.
        new: the path now; None: there is no such setting any more.
        before: the value that was written.
        after: the value now.
        instead: what to do where there is no such setting.
    """

    old: str
    new: str | None
    before: Any
    after: Any
    instead: str = ""

    def message(self) -> str:
        """Return one line that names what to write."""
        if self.new is None:
            return f"{self.old}: there is no such setting any more: {self.instead}"
        if self.new == self.old:
            return f"{self.old}: '{self.before}' is called '{self.after}' now"
        value = f", and '{self.before}' is '{self.after}'" if self.before != self.after else ""
        return f"{self.old}: this setting is called {self.new} now{value}"


def refuse_renamed(cfg: DictConfig, renamed: Renamed = RENAMED) -> None:
    """Refuse old names in a composed configuration.

    A key that the class beside it takes is that class's own, and not the old name of another one.

    Raises:
        InputError: the first old name; the message has the new one.
    """
    plain = OmegaConf.to_container(cfg, resolve=False)
    for path, value, holder in walk("", plain):
        change = _change(path, value, renamed)
        if change is None:
            continue
        if change.new in (None, path) or not _is_taken(path, holder):
            raise InputError(change.message())


def explained(error: HydraException, overrides: Sequence[str], renamed: Renamed = RENAMED) -> str:
    """Return what to say of a configuration that could not be composed.

    Args:
        error: Hydra's.
        overrides: as they were typed; others of the command line's arguments may be among them.
        renamed: the table.

    Returns:
        The new name, where an old one is the reason; the nearest setting, where there is none of
        that name; the error's own text elsewhere.
    """
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, option = error.missing_cfg_file.rpartition("/")
        new = renamed.options.get(group, {}).get(option)
        if new is not None:
            return f"{group}={option} is called {group}={new} now"
        if group and error.options:
            return (
                f"{group}={option}: there is no such file{did_you_mean(option, error.options)} "
                f"(there are: {', '.join(error.options)})"
            )
    if "You must specify 'experiment'" in str(error):
        return "no experiment is named: give experiment=NAME; `dolens experiments` lists them"
    for override in overrides:
        try:
            notes = translated([override], renamed)[1]
        except HydraException:
            continue  # no override, or none that can be read
        if notes:
            return notes[0]
    cause = error.__cause__
    node = getattr(cause, "parent_node", None)
    if isinstance(cause, OmegaConfBaseException) and isinstance(node, DictConfig):
        keys = [str(key) for key in node if not str(key).startswith("_")]
        return (
            f"{cause.full_key}: there is no such setting{did_you_mean(str(cause.key), keys)} "
            f"(there are: {', '.join(keys) or 'none'}); one that has no value yet is set by "
            f"+{cause.full_key}=..."
        )
    return str(error)


def translated(overrides: Sequence[str], renamed: Renamed = RENAMED) -> tuple[list[str], list[str]]:
    """Translate overrides of before into those of now.

    Args:
        overrides: as they were typed, as `merit.sampling=square_grid`.
        renamed: the table.

    Returns:
        The overrides of now, without those of settings that are gone; and a line for each change.
    """
    found: list[str] = []
    notes: list[str] = []
    for text in overrides:
        (override,) = OverridesParser.create().parse_overrides([text])
        new, changes = _translated(override, renamed)
        found += new
        notes += changes
    return found, notes


def with_targets_of_now(node: Any, renamed: Renamed = RENAMED) -> Any:
    """Return plain values in which every `_target_` has its name of now."""
    if isinstance(node, list):
        return [with_targets_of_now(value, renamed) for value in node]
    if not isinstance(node, dict):
        return node
    found = {key: with_targets_of_now(value, renamed) for key, value in node.items()}
    target = found.get("_target_")
    change = _change("_target_", target, renamed) if isinstance(target, str) else None
    return found if change is None else {**found, "_target_": change.after}


def _translated(override: Override, renamed: Renamed) -> tuple[list[str], list[str]]:
    group, path = override.key_or_group, override.package or override.key_or_group
    value = None if override.is_sweep_override() else override.value()
    option = renamed.options.get(group, {}).get(str(value))
    if option is not None:
        note = f"{group}={value} is called {group}={option} now"
        return [f"{override.get_key_element()}={option}"], [note]
    own = _change(path, value, renamed) or _moved_with(path, value, renamed)
    inner = [
        change
        for where, part, _ in walk(path, value)
        if where != path and (change := _change(where, part, renamed)) is not None
    ]
    changes = [change for change in (own, *inner) if change is not None]
    if not changes:
        return [override.input_line], []
    outside = [c for c in inner if c.new is not None and not c.new.startswith(f"{path}.")]
    found = [f"++{change.new}={override_text(change.after)}" for change in outside]
    if own is None or own.new is not None:
        # A key that was added may be there by itself now.
        kind = OverrideType.FORCE_ADD if override.is_add() else override.type
        place = {"key_or_group": own.new, "package": None} if own else {}
        key = replace(override, type=kind, **place).get_key_element()
        if override.is_delete():
            found.insert(0, key)
        elif override.is_sweep_override():
            found.insert(0, f"{key}={override.get_value_string()}")
        else:
            now = _rewritten(path, own.after if own else value, {c.old: c for c in inner})
            found.insert(0, f"{key}={override_text(now)}")
    return found, [change.message() for change in changes]


def _rewritten(path: str, node: Any, changes: Mapping[str, Change]) -> Any:
    """A value with the changes within it; what belongs elsewhere now, or nowhere, is left out."""
    if isinstance(node, list):
        return [_rewritten(f"{path}.{i}", part, changes) for i, part in enumerate(node)]
    if not isinstance(node, dict):
        return node
    found = {}
    for key, value in node.items():
        change = changes.get(f"{path}.{key}", Change("", f"{path}.{key}", value, value))
        if change.new is not None and change.new.startswith(f"{path}."):
            name = change.new.removeprefix(f"{path}.")
            found[name] = _rewritten(f"{path}.{key}", change.after, changes)
    return found


def _change(path: str, value: Any, renamed: Renamed) -> Change | None:
    """Return what has become of a setting; None where it is as it was."""
    if path.rpartition(".")[2] == "_target_" and isinstance(value, str):
        now = renamed.targets.get(value) or _within_the_package(value)
        if now is not None:
            return Change(path, path, value, now)
    for key in renamed.keys:
        new = _new_path(key, path)
        if new is not None:
            plain = value if isinstance(value, str) else None
            after = key.values.get(plain, value) if plain is not None else value
            return Change(path, new or None, value, after, key.instead)
    if isinstance(value, str) and value in renamed.values.get(path, {}):
        return Change(path, path, value, renamed.values[path][value])
    return None


def _within_the_package(name: str) -> str | None:
    """The name now of a class of the former top-level package `experiments`; None: it is another's.

    A package `experiments` of the user's own keeps its names.
    """
    if not name.startswith("experiments."):
        return None
    try:
        located(Target("", f"dolens.{name}", ()))
    except InputError:
        return None
    return f"dolens.{name}"


def _moved_with(path: str, value: Any, renamed: Renamed) -> Change | None:
    """Return what has become of a setting whose mapping has another name."""
    parent, dot, name = path.rpartition(".")
    if not dot:
        return None
    change = _change(parent, None, renamed) or _moved_with(parent, None, renamed)
    if change is None:
        return None
    return Change(path, change.new and f"{change.new}.{name}", value, value, change.instead)


def _new_path(key: Key, path: str) -> str | None:
    """The path now: empty where the setting is gone, None where the key is another one."""
    found = _pattern(key.old).fullmatch(path)
    if found is None:
        return None
    return (key.new or "").replace("*", found[1] if "*" in key.old else "*")


@cache
def _pattern(old: str) -> re.Pattern[str]:
    before, star, after = old.partition("*")
    return re.compile(re.escape(before) + "(.*)" * bool(star) + re.escape(after))


def _is_taken(path: str, holder: Mapping[str, Any]) -> bool:
    """Return whether a class that stands beside a key takes it."""
    name, target = path.rpartition(".")[2], holder.get("_target_")
    if name == "_target_" or not isinstance(target, str):
        return False
    try:
        allowed = arguments_of(located(Target(path, target, ())))
    except InputError:
        return False  # a class that is not there takes nothing
    return allowed is None or name in allowed
