"""Run folders side by side: which are the same but for the seed, and what tells others apart."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from dolens.errors import InputError
from dolens.experiments.camera.photograph_scores import PhotographScores, read_scores
from dolens.experiments.running.plain_values import flat

# How fast a run is, and where it was interrupted, changes nothing in what it finds.
_PASSED_OVER = ("seed", "threads")
_MOST_DIFFERENCES = 5
_LONGEST_VALUE = 40


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes:
        folder: of the run.
        experiment: its name.
        seed: of its random numbers.
        choices: Hydra's choices, group → option.
        config: the composed configuration less the seed, `a.b.c` → value as JSON.
        metrics: those of metrics.json.
        scores: of each test photograph, or None where the run kept none.
    """

    folder: Path
    experiment: str
    seed: int
    choices: Mapping[str, str]
    config: Mapping[str, str]
    metrics: Mapping[str, float]
    scores: PhotographScores | None


def read_run(folder: Path, judge: str | None = None) -> Run:
    """Read a run folder.

    With a judge of the views, as `wave`, its metrics `test_wave/…` stand for `test/…`.

    The configuration is the composed one before interpolation, so that values which follow the seed
    or the folder are the same in all runs.  `threads` is left out, and `ckpt_path` too where the
    run trained: a resumed run equals an uninterrupted one.

    Raises:
        InputError: the run is not finished, or the folder is none of a run.
    """
    for name in ("metrics.json", ".hydra/hydra.yaml", ".hydra/config.yaml"):
        if not (folder / name).is_file():
            raise InputError(f"{folder} is no finished run folder: {name} is missing")
    hydra = yaml.safe_load((folder / ".hydra" / "hydra.yaml").read_text(encoding="utf-8"))
    config = yaml.safe_load((folder / ".hydra" / "config.yaml").read_text(encoding="utf-8"))
    choices = hydra["hydra"]["runtime"]["choices"]
    left_out = (*_PASSED_OVER, "ckpt_path") if config.get("train", True) else _PASSED_OVER
    return Run(
        folder,
        choices["experiment"],
        int(config["seed"]),
        {k: str(v) for k, v in choices.items() if k != "experiment" and not k.startswith("hydra/")},
        _leaves({key: value for key, value in config.items() if key not in left_out}),
        _judged(json.loads((folder / "metrics.json").read_text(encoding="utf-8")), judge),
        read_scores(folder, f"test_{judge}" if judge else "test"),
    )


def _judged(metrics: Mapping[str, float], judge: str | None) -> dict[str, float]:
    """The metrics with those of a judge in place of the test's own."""
    if judge is None:
        return dict(metrics)
    kept = {name: value for name, value in metrics.items() if not name.startswith("test/")}
    own = f"test_{judge}/"
    found = {name: value for name, value in metrics.items() if name.startswith(own)}
    return kept | {name.replace(own, "test/", 1): value for name, value in found.items()}


def grouped(runs: Sequence[Run]) -> dict[str, dict[int, Run]]:
    """Name → seed → run, where the runs of a name differ in nothing but the seed.

    A name is that of the experiment; where runs of one experiment differ besides, what differs
    follows in parentheses.

    Raises:
        InputError: two runs are the same in all, the seed included.
    """
    groups: dict[tuple[str, frozenset], dict[int, Run]] = {}
    for run in runs:
        key = run.experiment, frozenset({**run.choices, **_prefixed(run.config)}.items())
        of_seed = groups.setdefault(key, {})
        if run.seed in of_seed:
            raise InputError(
                f"{of_seed[run.seed].folder} and {run.folder} have the same configuration and "
                f"seed {run.seed}; give one of them"
            )
        of_seed[run.seed] = run
    named: dict[str, dict[int, Run]] = {}
    for experiment in dict.fromkeys(run.experiment for run in runs):
        of_experiment = [group for key, group in groups.items() if key[0] == experiment]
        some = [next(iter(group.values())) for group in of_experiment]
        for group, differences in zip(of_experiment, _differences(some), strict=True):
            base = f"{experiment} ({differences})" if differences else experiment
            name, number = base, 1
            while name in named:
                number += 1
                name = f"{base} #{number}"
            named[name] = group
    return named


def _differences(runs: Sequence[Run]) -> list[str]:
    """Return what tells each run from the others: first Hydra's choices, then key by key."""
    choices = _differing([run.choices for run in runs])
    prefixes = tuple(f"{_package(choice)}." for choice in choices)
    keys = _differing([run.config for run in runs])
    apart = [key for key in keys if not f"{key}.".startswith(prefixes)]
    texts = []
    for run in runs:
        # A group's other values follow from the choice, except among runs with the same choice.
        alike = [
            other.config
            for other in runs
            if all(other.choices.get(c) == run.choices.get(c) for c in choices)
        ]
        within = [key for key in _differing(alike) if key not in apart]
        parts = [f"{choice}={run.choices.get(choice, 'unset')}" for choice in choices]
        parts += [f"{key}={_short(run.config.get(key, 'unset'))}" for key in (*apart, *within)]
        more = len(parts) - _MOST_DIFFERENCES
        if more > 0:
            parts = [*parts[:_MOST_DIFFERENCES], f"and {more} more"]
        texts.append(", ".join(parts))
    return texts


def _differing(mappings: Sequence[Mapping[str, str]]) -> list[str]:
    """Keys that not all mappings have with the same value, in order of appearance."""
    keys = dict.fromkeys(key for mapping in mappings for key in mapping)
    return [key for key in keys if len({mapping.get(key) for mapping in mappings}) > 1]


def _package(choice: str) -> str:
    """Return where a Hydra group ends up in the configuration: `sensor@views.sensor`, `a/b`."""
    group, _, package = choice.partition("@")
    return package or group.replace("/", ".")


def _leaves(config: Mapping[str, Any]) -> dict[str, str]:
    """Return the leaves of a configuration by their dotted names, as JSON."""
    return {name: json.dumps(leaf, sort_keys=True, default=str) for name, leaf in flat(config)}


def _prefixed(config: Mapping[str, str]) -> dict[str, str]:
    return {f"config:{key}": value for key, value in config.items()}


def _short(value: str) -> str:
    text = value.strip('"')
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 1]}…"
