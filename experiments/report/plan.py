"""What the report runs and shows: the systems and the supplement's items, read from YAML files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from dolens.errors import InputError, check_choice, check_keys
from dolens.typed_values import call_with_settings

FOLDER = Path(__file__).resolve().parent


@dataclass(frozen=True)
class System:
    """A run of the report.

    Attributes:
        name: the name of its folder, and what `--only` takes.
        title: what it is, in a few words.
        seconds: how long it takes on one core, processor time.
        overrides: what `dolens train` is given; empty where `module` is run instead.
        module: a module that is run with the folder as its only argument, or None.
    """

    name: str
    title: str
    seconds: float
    overrides: tuple[str, ...] = ()
    module: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "overrides", tuple(str(entry) for entry in self.overrides))
        if bool(self.overrides) == bool(self.module):
            raise InputError(f"system '{self.name}': give either overrides or a module")


@dataclass(frozen=True)
class Comparison:
    """The gain of one camera over another, paired over the photographs of their tests.

    Attributes:
        name: by which checks and rows refer to its numbers.
        title: what is compared.
        run: the system whose gain it is.
        against: the system that it is compared with.
        judge: what makes the test images, as `wave`; None for the test's own renderer.
    """

    name: str
    title: str
    run: str
    against: str
    judge: str | None = None


@dataclass(frozen=True)
class Row:
    """A number of the supplement beside ours.

    Attributes:
        what: the quantity and its unit.
        printed: the number as the supplement prints it, or `-` where it prints none.
        run: the system or comparison that ours is of.
        metric: its name in metrics.json, or None.
        lens: its place in lens/final.yaml, as `surfaces.1.radius`, or None.
        bound: the metric of its standard error, or None.
        low: the metric of the lower end of its interval, or None.
        high: the metric of the upper end, or None.
        digits: significant digits.
    """

    what: str
    printed: str
    run: str
    metric: str | None = None
    lens: str | None = None
    bound: str | None = None
    low: str | None = None
    high: str | None = None
    digits: int = 4

    def __post_init__(self) -> None:
        object.__setattr__(self, "printed", str(self.printed))
        if bool(self.metric) == bool(self.lens):
            raise InputError(f"row '{self.what}': give either metric or lens")

    def metrics(self) -> tuple[str, ...]:
        """Return the names of all metrics that the row shows."""
        return tuple(name for name in (self.metric, self.bound, self.low, self.high) if name)


@dataclass(frozen=True)
class Picture:
    """A figure of a run.

    Attributes:
        run: the system.
        name: of the file in its folder `figures`, without the ending; of `a|b` the first there is,
            since runs of other versions may be taken.
        caption: one sentence.
    """

    run: str
    name: str
    caption: str


@dataclass(frozen=True)
class Item:
    """An equation, algorithm, table or figure of the supplement.

    Attributes:
        item: as the supplement calls it, as `S1` or `Figure 3`.
        title: what it is about.
        printed: what the supplement prints, in our own words.
        code: dotted names of what implements it.
        tests: files of the tests that hold it.
        runs: the systems that show it.
        why: why our result differs from the printed one; empty where nothing is to be compared.
        error: what is known of the error of ours.
        not_compared: why it cannot be compared, or empty.
        rows: numbers side by side.
        pictures: figures of our runs.
    """

    item: str
    title: str
    printed: str
    code: tuple[str, ...] = ()
    tests: tuple[str, ...] = ()
    runs: tuple[str, ...] = ()
    why: str = ""
    error: str = ""
    not_compared: str = ""
    rows: tuple[Row, ...] = ()
    pictures: tuple[Picture, ...] = ()


@dataclass(frozen=True)
class Section:
    """A section of the supplement with its items.

    Attributes:
        title: its heading.
        items: in the order of the supplement.
    """

    title: str
    items: tuple[Item, ...]


@dataclass(frozen=True)
class Plan:
    """All that the report runs and shows.

    Attributes:
        systems: in the order in which they are run.
        comparisons: of cameras.
        sections: of the supplement.
    """

    systems: tuple[System, ...]
    comparisons: tuple[Comparison, ...]
    sections: tuple[Section, ...]

    def system(self, name: str) -> System:
        """Return a system by its name.

        Raises:
            InputError: there is none of this name; the message names the nearest one.
        """
        check_choice(name, [system.name for system in self.systems], "system")
        return next(system for system in self.systems if system.name == name)

    def items(self) -> tuple[Item, ...]:
        """Return the items of all sections."""
        return tuple(item for section in self.sections for item in section.items)


@cache
def load_plan() -> Plan:
    """Read systems.yaml and the files in supplement/, a section each.

    Raises:
        InputError: an unknown or missing key, or a system that there is not.
    """
    runs = read_yaml(FOLDER / "systems.yaml")
    systems = _made(System, runs["systems"], "systems.yaml: systems")
    comparisons = _made(Comparison, runs["comparisons"], "systems.yaml: comparisons")
    sections = tuple(_section(path) for path in sorted((FOLDER / "supplement").glob("*.yaml")))
    plan = Plan(systems, comparisons, sections)
    names = [system.name for system in systems]
    for comparison in comparisons:
        for name in (comparison.run, comparison.against):
            check_choice(name, names, f"comparison '{comparison.name}'")
    for item in plan.items():
        for name in (*item.runs, *(picture.run for picture in item.pictures)):
            check_choice(name, names, f"supplement: {item.item}")
        for row in item.rows:
            allowed = [*names, *(comparison.name for comparison in comparisons)]
            check_choice(row.run, allowed, f"supplement: {item.item}: '{row.what}'")
    return plan


def read_yaml(path: Path) -> Any:
    """Read a YAML file as plain data."""
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def _made(kind: type, entries: Sequence[Mapping[str, Any]], where: str) -> tuple[Any, ...]:
    """Return an object of a class for each entry."""
    return tuple(call_with_settings(kind, entry, where) for entry in entries)


def _section(path: Path) -> Section:
    entry = read_yaml(path)
    check_keys(entry, ("title", "items"), path.name)
    return Section(entry["title"], tuple(_item(item, path.name) for item in entry["items"]))


def _item(entry: Mapping[str, Any], file: str) -> Item:
    where = f"{file}: {entry.get('item')}"
    settings = dict(entry)
    for key in ("code", "tests", "runs"):
        settings[key] = tuple(settings.get(key, ()))
    settings["rows"] = _made(Row, settings.get("rows", ()), f"{where}: rows")
    settings["pictures"] = _made(Picture, settings.get("pictures", ()), f"{where}: pictures")
    return call_with_settings(Item, settings, where)
