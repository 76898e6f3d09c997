"""Entries of mappings that an experiment takes away from what it inherits: `name: drop`."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict

from dolens.errors import InputError

DROP = "drop"
# The keys that lead to an entry; keys may contain dots, so that a text would not do.
Place = tuple[Any, ...]


def without_dropped(cfg: DictConfig) -> DictConfig:
    """Return the configuration without the entries whose value is `drop`.

    Hydra merges a mapping of an experiment into that of its parent, so that what the parent has
    can be changed and not be left out.  `variables: {surfaces.5.x2y: drop}` leaves it out.

    Args:
        cfg: the composed configuration without Hydra's own part; it stays as it is.

    Raises:
        InputError: an entry that no other file of the configuration has.
    """
    dropped = list(_dropped(OmegaConf.to_container(cfg, resolve=False), ()))
    if not dropped:
        return cfg
    files = _files()
    for place in dropped:
        if files is not None and not any(_gives(content, place) for content in files):
            raise InputError(
                f"{'.'.join(map(str, place))}: nothing to drop: no parent of experiment="
                f"{HydraConfig.get().runtime.choices.get('experiment')} has this entry"
            )
    found = cfg.copy()
    with open_dict(found):
        for place in dropped:
            node = found
            for key in place[:-1]:
                node = node[key]
            del node[place[-1]]
    return found


def _dropped(node: Any, place: Place) -> Iterator[Place]:
    if isinstance(node, dict):
        for key, value in node.items():
            yield from _dropped(value, (*place, key))
    elif node == DROP:
        yield place


def _files() -> list[Mapping[str, Any]] | None:
    """The content of all files that the configuration is composed of, each where it is put.

    None where that cannot be told: in a process that a launcher brought the job to, or where a
    file lies in a Python package.
    """
    if not GlobalHydra.instance().is_initialized():
        return None
    job = HydraConfig.get()
    overrides = OmegaConf.to_container(job.overrides.task, resolve=False)
    paths = [item for item in job.overrides.hydra if item.startswith("hydra.searchpath=")]
    loader = GlobalHydra.instance().config_loader()
    chosen = loader.compute_defaults_list(job.job.config_name, [*paths, *overrides], RunMode.RUN)
    folders = [Path(s.path) for s in job.runtime.config_sources if s.schema == "file"]
    found = []
    for entry in chosen.defaults:
        name = entry.config_path
        if name is None or name.startswith("hydra/"):
            continue
        files = [file for folder in folders if (file := folder / f"{name}.yaml").is_file()]
        if not files:
            return None
        content = OmegaConf.to_container(OmegaConf.load(files[0]), resolve=False) or {}
        for key in reversed([key for key in (entry.package or "").split(".") if key]):
            content = {key: content}
        found.append(content)
    return found


def _gives(content: Any, place: Place) -> bool:
    """Return whether a file has an entry, and does not drop it."""
    for key in place:
        if not isinstance(content, dict) or key not in content:
            return False
        content = content[key]
    return content != DROP
