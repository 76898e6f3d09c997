"""The report's page, with a section for each item of the supplement."""

import base64
import io
import shlex
from pathlib import Path

from PIL import Image

from dolens.experiments.report.checks import Material, State
from dolens.experiments.report.page.overview import (
    anchor,
    count_text,
    css_class,
    expected_text,
    found_text,
    memory_text,
    number_text,
    overview,
    seconds_text,
    step_text,
)
from dolens.experiments.report.plan import Item, Row, Section
from dolens.experiments.report.runs import Result, shown_command, telling_overrides
from dolens.html import Child, Markup, document, element, joined, prose, table
from dolens.sensor.image_files import opened_image

_STYLE = Path(__file__).with_name("style.css")
_TITLE = "dolens: the dO supplement, run again"
_ABOUT = (
    "Every equation, algorithm, table and figure of the supplemental document of dO (Wang, Chen "
    "and Heidrich, 2022) beside what dolens finds: the printed number, ours, why they differ, the "
    "cost and the error of ours, and the command that repeats it."
)
_CONVENTIONS = (
    "Lengths are in mm, wavelengths in nm, angles in degrees; light travels towards +z. RMS spot "
    "radii are about the centroid. Index models: dfc takes glass at the lines d, F and C with air "
    "at 1; do takes the lines and the air of the authors’ program (656.3, 589.3, 486.1 nm, air "
    "1.000293). Intervals are 95\N{NO-BREAK SPACE}% intervals over the photographs of the test."
)


def page(material: Material) -> str:
    """Return the page as one HTML file without references to other files."""
    main = element(
        "main",
        element("h1", _TITLE),
        element("p", _ABOUT),
        element("p", _CONVENTIONS, class_="quiet"),
        element("p", material.made, class_="quiet"),
        overview(material),
        _contents(material),
        *(_section(material, section) for section in material.plan.sections),
        _runs(material),
    )
    return document(_TITLE, _STYLE.read_text(encoding="utf-8"), [main])


def _contents(material: Material) -> Markup:
    lines = []
    for section in material.plan.sections:
        links: list[Child] = []
        for item in section.items:
            links += [element("a", item.item, href=f"#{anchor(item.item)}"), " · "]
        lines.append(element("p", element("b", section.title), ": ", *links[:-1]))
    return element("nav", element("h2", "Contents"), *lines)


def _section(material: Material, section: Section) -> Markup:
    items = [item_section(material, item) for item in section.items]
    return joined(element("h2", section.title), *items)


def _runs(material: Material) -> Markup:
    rows: list[tuple[Child, ...]] = []
    for system in material.plan.systems:
        result = material.results.get(system.name)
        state = "failed" if system.name in material.failed else "not run"
        rows.append(
            (
                joined(element("b", system.name), f" {system.title}"),
                cost_text(result) if result else state,
                _version(material, system.name),
                element("code", command_of(material, system.name)),
            )
        )
    return joined(
        element("h2", "All runs"),
        table(("Run", "Cost", "Code", "Command"), rows, "runs", named_cells=True),
    )


def _version(material: Material, name: str) -> str:
    result = material.results.get(name)
    if result is None:
        return "–"
    code = result.record.get("code")
    if code == material.code:
        return "this version"
    git = result.info.get("git") or {}
    commit = str(git.get("commit") or "")[:10]
    return f"another version{f' ({commit})' if commit else ''}"


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


# Twice what the page is wide, for sharp screens and for enlarging.
_WIDEST = 1600
_QUALITY = 90


def embedded(path: Path) -> str:
    """Return a picture as an address that holds its bytes.

    A picture wider than 1600 pixels is reduced.  Of WebP without loss and with quality 90 the
    smaller is taken: drawings are smaller without loss, photographs with it.

    Args:
        path: BMP, GIF, JPEG, PNG, PPM, TIFF or WebP.
    """
    with opened_image(path) as image:
        picture = image.convert("RGB")
    if picture.width > _WIDEST:
        height = round(picture.height * _WIDEST / picture.width)
        picture = picture.resize((_WIDEST, height), Image.Resampling.LANCZOS)
    written = []
    for options in ({"lossless": True}, {"quality": _QUALITY}):
        stream = io.BytesIO()
        picture.save(stream, "WEBP", **options)
        written.append(stream.getvalue())
    return "data:image/webp;base64," + base64.b64encode(min(written, key=len)).decode("ascii")


def size_of(path: Path) -> tuple[int, int]:
    """Return width and height of a picture in pixels."""
    with opened_image(path) as image:
        return image.size
