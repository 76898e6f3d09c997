"""The page of a lens is written: one file that needs nothing else."""

import os
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch

from dolens.errors import InputError
from dolens.files import installed_version
from dolens.html import rendered
from dolens.lens_page.markup import PAGE, Block, figure_html, rasterise
from dolens.lens_page.overview import Overview, lens_overview, prepared_lens
from dolens.lens_page.sections import PageSections, Section
from dolens.lens_page.tables import number
from dolens.optics.fields import field_label
from dolens.optics.lens import Lens
from dolens.plotting.export import laid_out, save_figures

# Every page says by this what it is, so that only pages are overwritten unasked.
GENERATOR = "dolens show"
# Whose figures are drawn.
_MOST_FIELDS = 9

Progress = Callable[[str, int, int], None]


@dataclass
class Written:
    """What `write_page` wrote.

    Attributes:
        sections: on the page.
        figures: on the page, or in the folder.
        problems: section and reason of whatever could not be computed; the page says so too.
    """

    sections: int = 0
    figures: int = 0
    problems: list[tuple[str, str]] = field(default_factory=list)


def write_page(
    lens: Lens,
    path: str | Path | None,
    tolerances: str | Path | None = None,
    figures: str | Path | None = None,
    command: str = "",
    progress: Progress | None = None,
    ghosts: bool = False,
) -> Written:
    """Write a page about a lens: its section, its aberrations, and what a designer asks for.

    The page is one HTML file with figures, tables and a view in space that can be turned; it needs
    no network.  What cannot be computed is named on the page, with the reason, in its place.

    Args:
        lens: stays as it is; `prepared_lens` gives one other fields, wavelengths or aperture.
        path: the page's file; None writes figures only.
        tolerances: `default`, or a file of tolerances (see `dolens.prescriptions.files`), adds the
            worst offenders; None leaves them out.
        figures: a folder that gets every figure as PNG and SVG.
        command: what made the page, for its heading.

    Rarely needed:
        progress: is called with a title, the steps done and the number of all steps.
        ghosts: adds the ghosts of a source at each field.

    Tables list all fields; figures show nine of them at most, and the heading says which.

    Raises:
        InputError: the lens names conditions that no analysis can take, or a file cannot be
            written.
    """
    lens = prepared_lens(lens)
    overview = lens_overview(lens)
    shown, about = _with_few_fields(lens, overview)
    listed = PageSections(shown, about, tolerances, ghosts).sections()
    written = Written()
    blocks = _overview_blocks(overview)
    said = progress or (lambda title, done, total: None)
    for at, section in enumerate(listed):
        said(section.title, at, len(listed))
        blocks.append(_block(section, path is not None, figures, written))
    said("done", len(listed), len(listed))
    written.problems = [(block.title, text) for block in blocks for text in block.problems]
    # The section and the view in space come first, before the tables.
    first = 1 + next(n for n, section in enumerate(listed) if section.name == "space")
    tables, drawings = blocks[: len(overview.sections)], blocks[len(overview.sections) :]
    blocks = [*drawings[:first], *tables, *drawings[first:]]
    if path is not None:
        facts = _facts(lens, overview)
        if about is not overview:
            labels = [field_label(p, about.conditions.field_unit) for p in about.conditions.fields]
            facts.append(("fields of the figures", f"{len(labels)} of them: {', '.join(labels)}"))
        page = rendered(
            PAGE,
            title=overview.name,
            facts=facts,
            command=command,
            sections=blocks,
            generator=GENERATOR,
            version=installed_version("dolens") or "",
        )
        _write(Path(path), page)
    written.sections = len(blocks)
    return written


def _with_few_fields(lens: Lens, overview: Overview) -> tuple[Lens, Overview]:
    """Return a lens and its overview with fields for figures: evenly many from the axis outwards.

    A figure has a panel or a curve for each field, and takes as long as there are fields.
    """
    points = overview.conditions.fields
    if len(points) <= _MOST_FIELDS:
        return lens, overview
    outwards = points.norm(dim=-1).argsort(stable=True)
    places = torch.linspace(0, len(points) - 1, _MOST_FIELDS).round().long()
    chosen = outwards[places].sort().values.tolist()
    few = prepared_lens(lens)
    own = few.fields
    assert own is not None  # the usual ones are fewer
    vignetting, weights = own.vignetting, own.weights
    if weights and not any(weights[n] for n in chosen):
        weights = None
    few.fields = own._replace(
        points=tuple(own.points[n] for n in chosen),
        vignetting=vignetting and tuple(vignetting[n] for n in chosen),
        weights=weights and tuple(weights[n] for n in chosen),
    )
    return few, lens_overview(few)


def is_page(path: str | Path) -> bool:
    """Return whether a file is a page that `write_page` wrote."""
    if not os.path.isfile(path):
        return False
    with Path(path).open("rb") as file:
        return f'name="generator" content="{GENERATOR} '.encode() in file.read(600)


def _overview_blocks(overview: Overview) -> list[Block]:
    return [
        Block(
            re.sub(r"[^a-z]+", "-", section.title.lower()),
            section.title,
            problems=section.problems,
            tables=section.tables,
        )
        for section in overview.sections
    ]


def _block(section: Section, drawn: bool, folder: str | Path | None, written: Written) -> Block:
    """Compute a section; where that fails the section says why."""
    figures = []
    try:
        content = section.make()
        for name, figure in content.figures.items():
            written.figures += 1
            with laid_out(figure):
                if drawn:
                    label = f"{section.title}: {name.replace('_', ' ')}"
                    figures.append(figure_html(figure, re.sub(r"\W", "", name), label))
                if folder is not None:
                    rasterise(figure)
                    save_figures(figure, Path(folder) / name, ("png", "svg"))
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from None
    except Exception as error:
        known = isinstance(error, InputError)
        reason = str(error) if known else f"{type(error).__name__}: {error}"
        return Block(section.name, section.title, problems=[" ".join(reason.split())])
    return Block(
        *(section.name, section.title, content.note, content.space),
        *(figures, content.problems, content.tables),
    )


def _facts(lens: Lens, overview: Overview) -> list[tuple[str, str]]:
    """Return what the heading says."""
    where = overview.conditions
    first = lens.first_order(where.reference_wavelength, where.object_distance)
    facts = [
        ("focal length", f"{number(first.efl)} mm"),
        ("F-number", number(abs(float(first.f_number)), 4)),
    ]
    if where.object_distance is not None:
        facts.append(("object at", f"{number(where.object_distance)} mm"))
        facts.append(("working F-number", number(abs(float(first.working_f_number)), 4)))
    facts.append(
        ("fields", ", ".join(field_label(point, where.field_unit) for point in where.fields))
    )
    waves = [
        f"{float(wave):g}{'*' if float(wave) == where.reference_wavelength else ''}"
        for wave in where.wavelengths
    ]
    if len(waves) == 1:
        waves = [waves[0].rstrip("*")]
    facts.append(("wavelengths", f"{', '.join(waves)} nm"))
    if lens.sensor_diameter:
        facts.append(("image circle", f"{number(lens.sensor_diameter)} mm"))
    facts.append(("indices", lens.index_model))
    return facts


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
