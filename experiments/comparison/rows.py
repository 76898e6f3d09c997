"""Runs that differ in the seed alone become a row, with its settings and mean metrics."""

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

from dolens.errors import InputError, did_you_mean
from dolens.experiments.comparison.runs import Run


@dataclass(frozen=True)
class Row:
    """A row holds the runs that differ in nothing but the seed.

    Attributes:
        number: from 1, in the order of the table.
        experiment: its name.
        settings: what tells the row from the others, full name → plain value; a setting that the
            row does not have is missing.
        label: these settings in short, as `network=unet, light=300`.
        runs: seed → run.
    """

    number: int
    experiment: str
    settings: Mapping[str, Any]
    label: str
    runs: Mapping[int, Run]

    def values(self, metric: str) -> list[float]:
        """Return a metric of each run that has it."""
        return [run.metrics[metric] for run in self.runs.values() if metric in run.metrics]


@dataclass(frozen=True)
class Rows:
    """All rows of a comparison.

    Attributes:
        rows: in the order in which their runs were found.
        columns: full names of the settings that tell rows apart → their short names.
        notes: lines about runs that are the same, and rows of several versions of the code.
    """

    rows: tuple[Row, ...]
    columns: Mapping[str, str]
    notes: tuple[str, ...]


def rows_of(runs: Sequence[Run]) -> Rows:
    """Put runs with the same settings into a row, and find what tells rows apart.

    Runs that differ in anything but the seed are never in one row.  Of runs that are the same in
    all, the seed included, the last one counts, and a note names them.
    """
    groups: dict[tuple, dict[int, Run]] = {}
    notes: list[str] = []
    for run in runs:
        of_seed = groups.setdefault(run.key(), {})
        if run.seed in of_seed:
            notes.append(
                f"{of_seed[run.seed].folder} and {run.folder} have the same settings and seed "
                f"{run.seed}; only {run.folder} counts"
            )
        of_seed[run.seed] = run
    firsts = [next(iter(group.values())) for group in groups.values()]
    names = setting_names(firsts)
    columns = short_names(names, firsts)
    rows = []
    for number, group in enumerate(groups.values(), 1):
        run = next(iter(group.values()))
        settings = {name: value for name in names if (value := _value(run, name)) is not _MISSING}
        label = ", ".join(f"{columns[n]}={text_of(v)}" for n, v in settings.items())
        rows.append(Row(number, run.experiment, settings, label or run.experiment, group))
        if len({run.code for run in group.values()}) > 1:
            codes = sorted({f"{r.code[0][:8]} on {r.code[1]}" for r in group.values()})
            notes.append(f"row {number} has runs of several versions: {', '.join(codes)}")
    return Rows(tuple(rows), columns, tuple(notes))


def setting_names(runs: Sequence[Run]) -> list[str]:
    """Return the settings that tell runs apart, which must all differ in something.

    The experiment and Hydra's other choices come first.  What a choice sets follows from it, and is
    named only where runs with the same choice differ in it, or where the command line set it.
    """
    experiments = _differing([{"experiment": run.experiment} for run in runs])
    of_runs = [run.choices for run in runs]
    same = [[r.choices for r in group] for group in _parted(runs, ["experiment"])]
    # What an experiment chooses follows from it.
    own = {choice for group in same for choice in _differing(group)}
    own |= {name for run in runs for name in run.overridden if name in run.choices}
    choices = [*experiments, *(choice for choice in _differing(of_runs) if choice in own)]
    prefixes = tuple(f"{_package(choice)}." for choice in choices if choice != "experiment")
    named = _differing([_named(run) for run in runs])
    of_experiments = _differing_within(runs, ["experiment"])
    apart = [key for key in of_experiments if not f"{key}.".startswith(prefixes)]
    within = _differing_within(runs, choices)
    names = dict.fromkeys((*choices, *named, *apart, *within))
    return [name for name in names if len({_shown(run, name) for run in runs}) > 1]


def _named(run: Run) -> dict[str, str]:
    """Return the leaves of the configuration that the command line set, without its choices."""
    named = [name for name in run.overridden if name not in run.choices]
    return {name: value for part in named for name, value in _below(run.config, part)}


def _below(config: Mapping[str, str], name: str) -> Iterable[tuple[str, str]]:
    inner = f"{name}."
    return ((key, value) for key, value in config.items() if key == name or key.startswith(inner))


def _differing_within(runs: Sequence[Run], choices: Sequence[str]) -> list[str]:
    """Return settings in which runs with the same choices differ."""
    groups = _parted(runs, choices)
    return [key for same in groups for key in _differing([run.config for run in same])]


def _parted(runs: Sequence[Run], choices: Sequence[str]) -> list[list[Run]]:
    """Return the runs in groups with the same choices."""
    groups: dict[tuple, list[Run]] = {}
    for run in runs:
        own = {"experiment": run.experiment, **run.choices}
        groups.setdefault(tuple(own.get(choice) for choice in choices), []).append(run)
    return list(groups.values())


def _differing(mappings: Sequence[Mapping[str, str]]) -> list[str]:
    """Return keys that not all mappings have with the same value, in order of appearance."""
    keys = dict.fromkeys(key for mapping in mappings for key in mapping)
    return [key for key in keys if len({mapping.get(key) for mapping in mappings}) > 1]


def _package(choice: str) -> str:
    """Return where a Hydra group ends up in the configuration: `sensor@views.sensor`, `a/b`."""
    group, _, package = choice.partition("@")
    return package or group.replace("/", ".")


_MISSING = object()


def _value(run: Run, name: str) -> Any:
    """Return a setting of a run as a reader wants it."""
    if name == "experiment":
        return run.experiment
    if name in run.choices and name not in run.config:
        return run.choices[name]
    if name in run.config:
        return run.values.get(name, run.config[name].strip('"'))
    return _MISSING


def _shown(run: Run, name: str) -> str:
    value = _value(run, name)
    return "" if value is _MISSING else text_of(value) + run.config.get(name, "")


def text_of(value: Any) -> str:
    """Return a value as short text."""
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def short_names(names: Sequence[str], runs: Sequence[Run]) -> dict[str, str]:
    """Return the shortest ends of dotted names that no other setting of the runs ends with.

    A short name does not begin with a number: `surfaces.1.radius`, not `1.radius`.
    """
    everything = {key for run in runs for key in run.config} | set(names)
    ends: dict[str, int] = {}
    for key in everything:
        parts = key.split(".")
        for start in range(len(parts)):
            end = ".".join(parts[start:])
            ends[end] = ends.get(end, 0) + 1
    found = {}
    for name in names:
        parts = name.split(".")
        candidates = [".".join(parts[start:]) for start in reversed(range(len(parts)))]
        good = (c for c in candidates if ends[c] == 1 and not c[0].isdigit())
        found[name] = next(good, name)
    return found


def chosen_row(rows: Rows, wanted: str) -> Row:
    """Return the row that a user means.

    Args:
        rows: of the comparison.
        wanted: a row's number, its label, its experiment, or settings as `network=unet,light=300`.

    Raises:
        InputError: no row, or several.
    """
    listed = "; ".join(f"{row.number}: {row.label}" for row in rows.rows)
    named = [r for r in rows.rows if wanted in (str(r.number), r.label)]
    named = named or [r for r in rows.rows if wanted == r.experiment] or _selected(rows, wanted)
    if not named:
        raise InputError(f"--against: '{wanted}' is no row; rows are {listed}")
    if len(named) > 1:
        several = "; ".join(f"{row.number}: {row.label}" for row in named)
        raise InputError(f"--against: '{wanted}' is several rows; choose one by number: {several}")
    return named[0]


def _selected(rows: Rows, wanted: str) -> list[Row]:
    """Return the rows that have some settings."""
    pairs = [part.strip().partition("=")[::2] for part in wanted.split(",") if "=" in part]
    full = {short: name for name, short in rows.columns.items()}
    return [
        row
        for row in rows.rows
        if pairs
        and all(
            text_of(row.settings.get(full.get(key, key), _MISSING)) == value for key, value in pairs
        )
    ]


# Beside the objective, where runs have them.
_MAIN = (
    "test/psnr_db/worst",
    "test/psnr_db",
    "test/ssim",
    "test/raw_psnr_db",
    "cost/step_s",
    "cost/wall_s",
)


@dataclass(frozen=True)
class Value:
    """The `Value` of a metric in a row.

    Attributes:
        mean: over the seeds.
        half_range: over the seeds; 0 for one seed.
        count: of seeds.
        low: lower end of the run's own 95 % interval over photographs; None where the row has
            several seeds, or the run gives none.
        high: upper end likewise.
    """

    mean: float
    half_range: float
    count: int
    low: float | None = None
    high: float | None = None

    def text(self) -> str:
        """Return the mean ± half the range, or the value with its interval."""
        digits = digits_of(self.mean)
        mean = f"{self.mean:.{digits}f}" if digits is not None else f"{self.mean:.3g}"
        if self.count > 1:
            spread = (
                f"{self.half_range:.{digits}f}"
                if digits is not None
                else (f"{self.half_range:.2g}")
            )
            return f"{mean} ± {spread}"
        if self.low is not None and self.high is not None and digits is not None:
            return f"{mean} [{self.low:.{digits}f}, {self.high:.{digits}f}]"
        return mean


def digits_of(value: float) -> int | None:
    """Return how many decimals a number is shown with; None where it needs an exponent."""
    size = abs(value)
    if size != 0.0 and not 1e-3 <= size < 1e6:
        return None
    return 0 if size >= 1000 else 1 if size >= 100 else 2 if size >= 10 else 3 if size >= 0.1 else 4


def value_of(row: Row, metric: str) -> Value | None:
    """Return a metric of a row; None where a run of it does not have it."""
    values = row.values(metric)
    if not values or len(values) < len(row.runs):
        return None
    mean, half_range = statistics.mean(values), 0.5 * (max(values) - min(values))
    if len(values) > 1:
        return Value(mean, half_range, len(values))
    metrics = next(iter(row.runs.values())).metrics
    ends = (metrics.get(f"error/{metric}/{end}") for end in ("low", "high"))
    return Value(mean, half_range, 1, *ends)


def chosen_metrics(rows: Rows, wanted: Sequence[str] = ()) -> list[str]:
    """Return the metrics of a comparison.

    Args:
        rows: of the comparison.
        wanted: names, patterns (`test/psnr_db/*`), or what stands behind `test/` (`psnr_db`: that
            of all views); none: the objective, the main scores of a test, and costs.

    Raises:
        InputError: a name that no run has.
    """
    metrics = _of_all(rows)
    if not wanted:
        return [name for name in dict.fromkeys((*objectives(rows), *_MAIN)) if name in metrics]
    found: dict[str, None] = {}
    for pattern in wanted:
        of_test = (f"test/{pattern}", f"test/{pattern}/*")
        matched = [m for m in metrics if fnmatchcase(m, pattern)] or [
            m for m in metrics if any(fnmatchcase(m, p) for p in of_test)
        ]
        if not matched:
            raise InputError(
                f"--metrics: no run has '{pattern}'{did_you_mean(pattern, metrics)} "
                "(metrics.json of a run has all names)"
            )
        found.update(dict.fromkeys(matched))
    return list(found)


def objectives(rows: Rows) -> list[str]:
    """Return the metrics that the runs returned, without those that no run has."""
    metrics = _of_all(rows)
    named = (n for row in rows.rows for run in row.runs.values() for n in run.objectives)
    return [name for name in dict.fromkeys(named) if name in metrics]


def _of_all(rows: Rows) -> Mapping[str, None]:
    runs = (run for row in rows.rows for run in row.runs.values())
    return {name: None for run in runs for name in _in_order(run.metrics)}


def _in_order(metrics: Mapping[str, float]) -> list[str]:
    """Return names with the worst view behind the others, as reports have it."""
    return sorted(
        metrics, key=lambda name: (name.rpartition("/")[0], name.endswith("/worst"), name)
    )


_WORDS = {"psnr": "PSNR", "ssim": "SSIM", "rms": "RMS", "efl": "EFL", "mtf": "MTF"}
_UNITS = {
    **{"db": "dB", "um": "µm", "mm": "mm", "nm": "nm", "s": "s", "mb": "MB", "deg": "°"},
    **{"grey_levels": "grey levels", "pixels": "pixels"},
}
# By the last part of a setting's name; lens files and configurations share these units.
_SETTINGS = {
    **dict.fromkeys(
        (
            *("radius", "thickness", "semi_diameter", "stop_semi_diameter", "distance"),
            *("diameter", "pixel_pitch", "decenter_x", "decenter_y", "shift_z", "depths"),
        ),
        "mm",
    ),
    **dict.fromkeys(("curvature", "curvature_x", "curvature_y"), "1/mm"),
    **dict.fromkeys(("tilt_x", "tilt_y", "tilt_z"), "°"),
    **dict.fromkeys(("wavelength", "wavelengths"), "nm"),
    "light": "electrons in white",
}


def metric_label(name: str) -> str:
    """Return a metric in words: `test/psnr_db/worst` is `test PSNR, worst (dB)`."""
    unit = ""
    parts = []
    for part in name.split("/"):
        for suffix, symbol in _UNITS.items():
            if part.endswith(f"_{suffix}"):
                part, unit = part.removesuffix(f"_{suffix}"), f" ({symbol})"
                break
        parts.append(" ".join(_WORDS.get(word, word) for word in part.split("_")))
    if parts[0] == "test" and len(parts) > 1:
        parts[:2] = [f"test {parts[1]}"]
    return ", ".join(parts) + unit


def setting_label(name: str) -> str:
    """Return a setting in words: `lens.surfaces.1.radius` is `radius of surface 1 (mm)`."""
    parts = name.split(".")
    last = parts[-1]
    unit = f" ({_SETTINGS[last]})" if last in _SETTINGS else ""
    if len(parts) > 2 and parts[-3] == "surfaces":
        return f"{last.replace('_', ' ')} of surface {parts[-2]}{unit}"
    if parts[-2:] == ["sensor", "distance"]:
        return f"sensor distance{unit}"
    return f"{name}{unit}"
