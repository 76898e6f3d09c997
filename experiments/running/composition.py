"""Overrides of the command line, applied to the recorded configuration of a run."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from dolens.errors import InputError, one_line
from dolens.experiments.running.catalogue import configuration_folders
from dolens.experiments.running.configuration import checked
from dolens.experiments.running.dropped_entries import without_dropped
from dolens.experiments.running.recorded_run import RecordedRun
from dolens.experiments.running.renaming import explained
from dolens.experiments.running.resolvers import register_resolvers
from dolens.experiments.running.trust import needing_trust, refuse_untrusted
from dolens.files import packaged_configuration

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
        raise InputError(one_line(explained(error, overrides))) from error
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
