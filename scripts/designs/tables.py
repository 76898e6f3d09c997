"""Tables of designs of others: what was asked for and traced, and what redesigning them gave."""

from collections.abc import Mapping, Sequence
from typing import Any

from scripts.designs.files import Design
from scripts.designs.lenses import Measures

WAYS = ("from_published", "from_start", "their_rule")
# Spots that differ by less than this part are equal.
_EQUAL = 1e-3


def check_row(design: Design, found: Measures) -> str:
    """Return a line of the table: asked for / traced."""
    asked = f"{design.pupil:g} mm" if design.pupil else f"f/{design.f_number:g}"
    track = f"{design.track:g}" if design.track is not None else "–"
    return (
        f"| {design.name} | {design.focal_length:.3f} / {found.efl:.3f} | "
        f"{asked} / f/{found.f_number:.3f} | ±{design.half_field:g}° | {track} / "
        f"{found.track:.3f} | {found.back:.3f} | {100.0 * found.distortion:.2f} | "
        f"{found.glass[0]:.2f}, {found.glass[2]:.2f} | {found.air[0]:.2f}, {found.air[1]:.2f} | "
        f"{found.spots[0]:.2f} | {found.mean:.3f} | {max(found.spots):.2f} |"
    )


def check_table(rows: Sequence[str]) -> list[str]:
    """Return lines of Markdown."""
    return [
        "| design | EFL asked / traced, mm | aperture asked / traced | field | track asked / "
        "traced, mm | back focus, mm | distortion, % | glass on axis, at edge, mm | air on axis, "
        "at edge, mm | spot on the axis, µm | mean, µm | largest, µm |",
        "|" + "---|" * 12,
        *rows,
    ]


def redesign_table(found: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return lines of Markdown: mean spots in µm, and how often they are as good as published.

    A spot counts where every limit is kept.
    """
    lines = [
        "| design | published | from there | start | dolens from the start | the authors' rule "
        "from the start | steps |",
        "|" + "---|" * 7,
    ]
    for entry in found:
        cells = [_cell(entry.get(way)) for way in WAYS]
        steps = ", ".join(str(entry[w]["steps"]) if w in entry else "–" for w in WAYS)
        start = f"{entry['start']:.1f} ({100.0 * entry['away']:g} %)" if "start" in entry else "–"
        lines.append(
            f"| {entry['name']} | {entry['published']:.3f} | {cells[0]} | {start} | "
            f"{cells[1]} | {cells[2]} | {steps} |"
        )
    counts = []
    for way in WAYS:
        good = [
            e
            for e in found
            if way in e and not e[way]["broken"]
            if e[way]["mean"] <= (1.0 + _EQUAL) * e["published"]
        ]
        counts.append(len(good))
    both = [e for e in found if "from_start" in e and "their_rule" in e]
    ahead = [e for e in both if _rank(e["from_start"]) <= _rank(e["their_rule"])]
    return [
        *lines,
        "",
        f"As good as published, or better, with every limit kept: {counts[0]} of {len(found)} from "
        f"there, {counts[1]} by dolens from the start, {counts[2]} by the authors' rule from the "
        f"start. From the start dolens is as good as their rule in {len(ahead)} of {len(both)}.",
    ]


def _rank(made: Mapping[str, Any]) -> tuple[int, float]:
    return len(made["broken"]), made["mean"] / (1.0 + _EQUAL)


def _cell(made: Mapping[str, Any] | None) -> str:
    if made is None:
        return "–"
    broken = f" ({', '.join(made['broken'])})" if made["broken"] else ""
    return f"{made['mean']:.3f}{broken}"
