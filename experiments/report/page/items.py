"""The section of one item of the supplement."""

import shlex

from dolens.experiments.report.checks import State
from dolens.experiments.report.page.material import Material
from dolens.experiments.report.page.numbers import (
    count_text,
    memory_text,
    number_text,
    seconds_text,
    step_text,
)
from dolens.experiments.report.page.overview import (
    anchor,
    css_class,
    expected_text,
    found_text,
)
from dolens.experiments.report.page.pictures import embedded, size_of
from dolens.experiments.report.plan import Item, Row
from dolens.experiments.report.results import Result, telling_overrides
from dolens.experiments.report.runner import shown_command
from dolens.html import Child, Markup, element, joined, prose, table

_BADGES = {
    State.HOLDS: "its checks hold",
    State.FAILS: "does not hold",
    State.NOT_RUN: "not run",
}


def item_section(material: Material, item: Item) -> Markup:
    """Return what is printed, ours, why they differ, cost, error, pictures and commands."""
    return element(
        "section",
        element("h3", element("b", item.item), f" {item.title} ", _badge(material, item)),
        element("p", prose(item.printed)),
        _rows(material, item),
        _labelled("Why ours differs", item.why),
        _labelled("Cannot be compared", item.not_compared),
        _labelled("Error", item.error),
        _checks(material, item),
        _pictures(material, item),
        _costs(material, item),
        _code(item),
        id=anchor(item.item),
        class_="item",
    )


def ours_text(material: Material, row: Row) -> str:
    """Return our number with its standard error or its interval, or `not run`."""
    metrics = material.metrics(row.run)
    if metrics is None:
        return "not run"
    value = metrics.get(row.metric) if row.metric else _lens_value(material, row)
    if value is None:
        return "not in this run"
    text = number_text(value, row.digits)
    if row.bound in metrics:
        text += f" ± {number_text(metrics[row.bound], 2)}"
    if row.low in metrics and row.high in metrics:
        low, high = (number_text(metrics[name], row.digits) for name in (row.low, row.high))
        text += f" (95 %: {low} to {high})"
    return text


def cost_text(result: Result) -> str:
    """Return seconds, rays and memory of a run, as far as it knows them."""
    metrics, record = result.metrics, result.record
    parts = []
    wall = record.get("wall_s", metrics.get("cost/wall_s"))
    if wall is not None:
        parts.append(seconds_text(wall))
    if "cpu_s" in record:
        parts[-1] += f" ({seconds_text(record['cpu_s'])} of processor time)"
    if "cost/step_s" in metrics:
        step = metrics["cost/step_s"]
        parts.append(f"{step_text(step)} a step")
    if "cost/rays" in metrics:
        parts.append(f"{count_text(metrics['cost/rays'])} rays")
    if "cost/peak_memory_mb" in metrics:
        parts.append(f"{memory_text(metrics['cost/peak_memory_mb'])} of memory")
    return ", ".join(parts)


def command_of(material: Material, name: str) -> str:
    """Return the command of a run: its own where it has settings of its own."""
    result = material.results.get(name)
    system = material.plan.system(name)
    if result is None or not result.overrides:
        return shown_command(system)
    return shlex.join(["dolens", "train", *telling_overrides(result.overrides)])


def _lens_value(material: Material, row: Row) -> float | None:
    result = material.results.get(row.run)
    return result.lens_value(row.lens) if result and row.lens else None


def _badge(material: Material, item: Item) -> Markup:
    states = {outcome.state for outcome in material.outcomes_of(item.item)}
    for state in (State.FAILS, State.HOLDS, State.NOT_RUN):
        if state in states:
            return element("span", _BADGES[state], class_=f"badge {css_class(state)}")
    return (
        element("span", "shown, no check", class_="badge quiet")
        if item.runs
        else (element("span", "held by tests", class_="badge quiet"))
    )


def _rows(material: Material, item: Item) -> Markup | None:
    if not item.rows:
        return None
    rows: list[tuple[Child, ...]] = [
        (row.what, row.printed, ours_text(material, row)) for row in item.rows
    ]
    return table(("Quantity", "Printed", "Ours"), rows, "numbers", named_cells=True)


def _checks(material: Material, item: Item) -> Markup | None:
    outcomes = material.outcomes_of(item.item)
    if not outcomes:
        return None
    rows: list[tuple[Child, ...]] = [
        (
            prose(outcome.check.what),
            expected_text(outcome.check),
            element("span", found_text(outcome), class_=css_class(outcome.state)),
            str(outcome.state),
        )
        for outcome in outcomes
    ]
    return table(("Check", "Expected", "Found", "Outcome"), rows, "numbers", named_cells=True)


def _pictures(material: Material, item: Item) -> Markup | None:
    shown, missing = [], []
    for picture in item.pictures:
        result = material.results.get(picture.run)
        path = result.figure(picture.name) if result else None
        if path is None:
            missing.append(f"{picture.run}: {picture.name}")
            continue
        width, height = size_of(path)
        image = element(
            "img",
            src=embedded(path),
            alt=picture.caption,
            width=str(width),
            height=str(height),
        )
        shown.append(element("figure", image, element("figcaption", picture.caption)))
    note = f"No picture yet of {'; '.join(missing)}." if missing else ""
    return joined(*shown, element("p", note, class_="quiet") if note else None)


def _costs(material: Material, item: Item) -> Markup | None:
    if not item.runs:
        return None
    lines = []
    for name in item.runs:
        result = material.results.get(name)
        cost = cost_text(result) if result else "not run"
        lines.append(element("p", element("b", "Cost"), f": {cost}"))
        lines.append(element("pre", command_of(material, name)))
    return joined(*lines)


def _code(item: Item) -> Markup | None:
    parts: list[Child] = []
    if item.code:
        codes = [element("code", name) for name in item.code]
        parts += ["Code: ", *[part for code in codes for part in (code, ", ")][:-1], ". "]
    if item.tests:
        parts += ["Held by: ", element("code", f"python -m pytest {' '.join(item.tests)}")]
    return element("p", *parts, class_="quiet") if parts else None


def _labelled(label: str, text: str) -> Markup | None:
    return element("p", element("b", label), ": ", prose(text)) if text else None
