"""What the configuration of a run folder may make, import and write without being trusted.

A run folder may be a stranger's.  Its configuration names what is called (`_target_`), and so could
run any code.  Names are compared with a list, and nothing is imported to find out what they are.
"""

import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from dolens.errors import InputError
from dolens.experiments.running.run_files import walk
from dolens.files import packaged_configuration, resolved_path

_TARGET = re.compile(r"_target_: *(?:([\w.]+))")
# Parts of a run that a finished run does not make.
_NOT_MADE = ("logger", "hydra")
# Settings that say where something is written.
_WRITTEN = ("folder", "dirpath", "default_root_dir", "save_dir")
# What a search for cameras may give to the commands that it starts: choices and numbers.
_PLAIN_OVERRIDE = re.compile(r"\+{0,2}(?!hydra|extensions)[\w.]+=[\w.,+\-\[\] ]*")


@cache
def allowed_targets() -> frozenset[str]:
    """Return the names of all that a run folder may have made without being trusted.

    They are what the configuration of dolens itself names, and the networks, losses, optimizers,
    schedules and callbacks of torch, Lightning and dolens.
    """
    # Slow to load, and workers load this module.
    import torch
    from lightning.pytorch import callbacks

    import dolens.optimize
    import dolens.reconstruction

    # Every class of a kind is allowed, by the name that its package gives it.
    kinds = (
        (torch.nn, torch.nn.Module),
        (torch.optim, torch.optim.Optimizer),
        (torch.optim.lr_scheduler, torch.optim.lr_scheduler.LRScheduler),
        (callbacks, callbacks.Callback),
        (dolens.reconstruction, torch.nn.Module),
        (dolens.optimize, torch.optim.Optimizer),
    )
    files = packaged_configuration().rglob("*.yaml")
    named = {name for file in files for name in _TARGET.findall(file.read_text(encoding="utf-8"))}
    own = {name for name in named if name.startswith(("dolens.", "lightning.", "datetime."))}
    of_kinds = (
        {f"{home.__name__}.{name}", f"{made.__module__}.{made.__qualname__}"}
        for home, kind in kinds
        for name, made in vars(home).items()
        if isinstance(made, type) and issubclass(made, kind)
    )
    return frozenset(own.union(*of_kinds))


def needing_trust(config: Mapping[str, Any], output: Path | None = None) -> list[str]:
    """Return what a configuration would do that only a trusted one may, in words; mostly nothing.

    Args:
        config: plain values, resolved or not.
        output: the folder that may be written to; None: settings that say where are passed over.
    """
    found: dict[str, str] = {}
    for what, place in _needs(config, output):
        found.setdefault(what, place)
    return [f"{what} ({place})" for what, place in found.items()]


def refuse_untrusted(needs: list[str], folder: Path) -> None:
    """Refuse a run folder that needs to be trusted.

    Args:
        needs: what it would do.
        folder: of the run.

    Raises:
        InputError: it would do anything; the message says what.
    """
    if needs:
        raise InputError(
            f"{folder}: this run would {', '.join(needs)}; whoever made the folder decides what "
            "that does on this machine: --trust (in Python, trust=True) allows it"
        )


def own_folder(run: str | Path, name: str) -> Path:
    """Return a folder within a run folder, for results; it need not be there.

    Raises:
        InputError: it is a link or holds one, through which a file elsewhere would be written.
    """
    folder = resolved_path(run) / name
    for path in (folder, *folder.rglob("*")):
        if path.is_symlink():
            raise InputError(f"{path} is a link, and would be written through; remove it")
    return folder


def _needs(config: Mapping[str, Any], output: Path | None) -> Iterator[tuple[str, str]]:
    """Yield what needs trust, and the setting that asks for it."""
    if config.get("extensions"):
        given = config["extensions"]
        modules = map(str, given) if isinstance(given, list) else [str(given)]
        yield f"import {', '.join(modules)}", "extensions"
    made = {key: value for key, value in config.items() if key not in _NOT_MADE}
    for path, value, _ in walk("", made):
        place, _, key = path.rpartition(".")
        if key == "_target_" and (not isinstance(value, str) or value not in allowed_targets()):
            yield f"call {value}", place
        elif key == "_args_":  # which would pass what is looked at by its name below
            yield "give a call arguments without names", place
        elif key in _WRITTEN and output is not None and isinstance(value, str):
            if not resolved_path(value).is_relative_to(output):
                yield f"write into {value}", path
        elif key == "settings" and isinstance(value, list):
            for text in map(str, value):
                if not _PLAIN_OVERRIDE.fullmatch(text) or "_target_" in text:
                    yield f"start dolens train {text}", path
