"""The files of a run folder, written and read back as plain values."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from dolens.whole_files import written_whole

INFO, METRICS = "run.json", "metrics.json"
CONFIG, RESOLVED = ".hydra/config.yaml", ".hydra/resolved.yaml"
OVERRIDES, HYDRA = ".hydra/overrides.yaml", ".hydra/hydra.yaml"
_GIVEN_UP = ("pruned", "repeated")


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a mapping as JSON, whole or not at all."""
    text = json.dumps(content, indent=2, sort_keys=True) + "\n"
    with written_whole(path) as aside:
        aside.write_text(text, encoding="utf-8")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file; an empty mapping where there is none."""
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def read_yaml(path: Path) -> Any:
    """Read a YAML file as plain values; None where there is none."""
    return yaml.safe_load(path.read_text(encoding="utf-8")) if path.is_file() else None


def info_of(folder: Path) -> dict[str, Any]:
    """Return run.json of a run: its code, versions, machine and status; or an empty mapping."""
    return read_json(folder / INFO)


def metrics_of(folder: Path) -> dict[str, float]:
    """Return the metrics of a run, name → number; none where it has not come to its end."""
    return read_json(folder / METRICS)


def overrides_of(folder: Path) -> tuple[str, ...]:
    """Return the overrides of a run as Hydra kept them; none where it kept none."""
    return tuple(str(entry) for entry in read_yaml(folder / OVERRIDES) or ())


def has_metrics(folder: Path) -> bool:
    """Return whether a run came to its end, and wrote its metrics."""
    return (folder / METRICS).is_file()


def is_given_up(folder: Path) -> bool:
    """Return whether a search stopped a run, or repeated it elsewhere: it has not failed."""
    return info_of(folder).get("status") in _GIVEN_UP


def is_finished(folder: Path) -> bool:
    """Return whether a folder has the metrics of a run that ended without an error."""
    return has_metrics(folder) and info_of(folder).get("status") == "finished"
