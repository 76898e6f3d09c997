"""A configuration is composed, with overrides applied, and checked before any work is done."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from dolens.errors import InputError, one_line
from dolens.experiments.running.catalogue import configuration_folders
from dolens.experiments.running.command_line import explained
from dolens.experiments.running.recorded_run import RecordedRun
from dolens.experiments.running.refused_settings import (
    refuse_missing,
    refuse_targets_in_lenses,
    refuse_unknown_keys,
    refuse_unread,
    refuse_wrong_types,
)
from dolens.experiments.running.run_settings import RunSettings
from dolens.experiments.running.trust import needing_trust, refuse_untrusted
from dolens.experiments.settings import register_resolvers
from dolens.files import packaged_configuration
from dolens.prescriptions.cells import with_tables

# What Hydra makes; the lens is made by `dolens.prescriptions`, from data alone.
_MADE = ("module", "data", "callbacks", "logger", "trainer")


def checked(cfg: DictConfig) -> DictConfig:
    """Return the configuration that a run works with.

    It is the composed one without Hydra's own part, without the entries that an experiment drops,
    and with the tables of cells that its lens names as files.

    Args:
        cfg: as Hydra gives it to the job; it stays as it is.

    Raises:
        InputError: an old name, an entry dropped that no parent has, a table that cannot be read, a
            `_target_` in a lens, a key that a class does not take, a setting that is missing, a
            value of another type than the class takes, or a setting that nothing reads.
    """
    own = OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"])
    own = without_dropped(own)
    plain = OmegaConf.to_container(own, resolve=False)
    assert isinstance(plain, dict)  # as a composed configuration is
    if (lens := with_tables(plain.get("lens"))) is not plain.get("lens"):
        # A run folder holds all that its lens is made of.
        OmegaConf.update(own, "lens", lens, merge=False)
        plain["lens"] = lens
    refuse_targets_in_lenses(plain)
    refuse_unknown_keys(plain, _MADE)
    refuse_missing(plain, _MADE)
    refuse_wrong_types(plain, _MADE)
    refuse_unread(own, RunSettings.names())
    return own


# The keys that lead to a value; keys may contain dots, so that a text would not do.
Place = tuple[Any, ...]
_MAIN = "train"


def with_overrides(record: RecordedRun, overrides: Sequence[str]) -> dict[str, Any]:
    """Return a run's configuration with overrides applied over its own ones.

    The overrides say all that Hydra's grammar can say; a choice of a group replaces the group.  The
    configuration is composed twice, with the run's overrides alone and with these besides, and
    what differs between the two is changed in the recorded configuration.  What the files of the
    configuration have come to say since the run has no influence therefore, except where an
    override asks for it.

    Args:
        record: of the run.
        overrides: as the command line has them; none: the recorded configuration itself.

    Returns:
        Plain values without interpolations.

    Raises:
        InputError: the configuration cannot be composed, an override is refused (see `checked`), or
            the run needs trust.
    """
    if not overrides:
        return dict(record.config)
    register_resolvers()
    with _composed(record, record.overrides) as cfg:
        before = _resolved(without_dropped(OmegaConf.masked_copy(cfg, _but_hydra(cfg))))
    with _composed(record, [*record.overrides, *overrides]) as cfg:
        if not record.trusted:  # before anything looks at the classes that are named
            own = OmegaConf.masked_copy(cfg, _but_hydra(cfg))
            plain = OmegaConf.to_container(own, resolve=False)
            refuse_untrusted(needing_trust(plain), record.folder)
        after = _resolved(checked(cfg))
    return _with_differences(record.config, before, after)


def changed_places(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[Place]:
    """Return the places at which two configurations differ, those of values in order."""
    old, new = dict(_leaves(before)), dict(_leaves(after))
    return [p for p in {**old, **new} if p not in old or p not in new or old[p] != new[p]]


@contextmanager
def _composed(record: RecordedRun, overrides: Sequence[str]) -> Iterator[DictConfig]:
    """Compose as a run of train.py does; within the context HydraConfig is that of the job."""
    folders = [path for path in record.sources if path.is_dir()]
    own = [folder.resolve() for folder in configuration_folders(Path.cwd())]
    strangers = [path for path in folders if path.resolve() not in own]
    if strangers and not record.trusted:
        refuse_untrusted([f"be composed of {strangers[0]}"], record.folder)
    main = next((path for path in folders if (path / f"{_MAIN}.yaml").is_file()), None)
    main = main or packaged_configuration()
    others = [f"file://{path}" for path in folders if path != main]
    # Whatever the main file itself says of it: a package that it names would be imported.
    path = [f"hydra.searchpath=[{','.join(others)}]"]
    hydra, job = GlobalHydra.instance().hydra, HydraConfig.instance().cfg
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(main.resolve()), version_base="1.3"):
            cfg = compose(_MAIN, [*path, *overrides], return_hydra_config=True)
            with open_dict(cfg):
                cfg.hydra.runtime.output_dir = str(record.output)
            HydraConfig.instance().set_config(cfg)
            yield cfg
    except HydraException as error:
        raise InputError(one_line(explained(error))) from error
    except OmegaConfBaseException as error:
        raise InputError(one_line(error)) from error
    finally:
        GlobalHydra.instance().clear()
        if hydra is not None:
            GlobalHydra.instance().initialize(hydra)
        HydraConfig.instance().cfg = job


def _but_hydra(cfg: DictConfig) -> list[str]:
    return [str(key) for key in cfg if key != "hydra"]


def _resolved(cfg: DictConfig) -> dict[str, Any]:
    return OmegaConf.to_container(cfg, resolve=True)


def _leaves(node: Any, place: Place = ()) -> Iterator[tuple[Place, Any]]:
    """Yield the values of nested mappings; lists and empty mappings are values."""
    if isinstance(node, Mapping) and node:
        for key, value in node.items():
            yield from _leaves(value, (*place, key))
    else:
        yield place, node


def _with_differences(
    config: Mapping[str, Any], before: Mapping[str, Any], after: Mapping[str, Any]
) -> dict[str, Any]:
    found, wanted = _copied(config), dict(_leaves(after))
    changed = changed_places(before, after)
    for place in changed:
        if place not in wanted:
            _delete(found, place)
    for place in changed:
        if place in wanted:
            _set(found, place, wanted[place])
    return found


def _copied(node: Any) -> Any:
    return {k: _copied(v) for k, v in node.items()} if isinstance(node, Mapping) else node


def _delete(node: dict[str, Any], place: Place) -> None:
    """Take away the value at a place, and mappings that are empty without it."""
    key, *rest = place
    if key not in node:
        return
    if rest and isinstance(node[key], dict):
        _delete(node[key], tuple(rest))
    if not rest or node[key] == {}:
        del node[key]


def _set(node: dict[str, Any], place: Place, value: Any) -> None:
    for key in place[:-1]:
        if not isinstance(node.get(key), dict):
            node[key] = {}
        node = node[key]
    node[place[-1]] = value


DROP = "drop"


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
