"""The whole page."""

from pathlib import Path

from dolens.experiments.report.page.items import command_of, cost_text, item_section
from dolens.experiments.report.page.material import Material
from dolens.experiments.report.page.overview import anchor, overview
from dolens.experiments.report.plan import Section
from dolens.html import Child, Markup, document, element, joined, table

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
