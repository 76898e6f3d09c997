"""The paper of a drawing: frame, title block, tables, dimension lines, and a true scale."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.textpath import TextPath
from matplotlib.transforms import Affine2D, ScaledTranslation

# A4, landscape.
SIZE = (11.69, 8.27)
MM_PER_INCH = 25.4
INK = "#1A1A1A"
THIN, THICK = 0.5, 1.1
TEXT = 7.0
_SCALES = (1, 2, 5)


@dataclass(frozen=True)
class TitleBlock:
    """What stands on every sheet of one lens.

    Attributes:
        lens: its name.
        design: the beginning of the design's hash.
        date: of the drawing.
        program: name and version.
        wavelength: nm, of the design.
        sheets: how many there are.
    """

    lens: str
    design: str
    date: str
    program: str
    wavelength: float
    sheets: int


def new_sheet(block: TitleBlock, number: int, title: str, scale: str) -> Figure:
    """Return an A4 sheet with its frame and title block."""
    figure = Figure(figsize=SIZE)
    figure.set_facecolor("white")
    paper = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    paper.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0))
    paper.axis("off")
    paper.plot([0.02, 0.98, 0.98, 0.02, 0.02], [0.03, 0.03, 0.97, 0.97, 0.03], color=INK, lw=THICK)
    cells = [
        [
            ("lens", block.lens, 0.34),
            ("sheet shows", title, 0.42),
            ("sheet", f"{number} of {block.sheets}", 0.10),
            ("scale", scale, 0.10),
        ],
        [
            ("design (sha256)", block.design, 0.17),
            ("drawn by", block.program, 0.17),
            ("date", block.date, 0.12),
            ("design wavelength", f"{block.wavelength:g} nm", 0.15),
            ("dimensions in", "mm", 0.10),
            ("indications", "in the manner of ISO 10110", 0.25),
        ],
    ]
    for line, row in enumerate(cells):
        top = 0.115 - 0.0425 * line
        paper.plot([0.02, 0.98], [top, top], color=INK, lw=THIN)
        x = 0.02
        for caption, text, width in row:
            paper.text(x + 0.006, top - 0.012, caption, fontsize=5.5, color="0.35", va="center")
            # About 150 characters of this size fit across the sheet.
            fits = max(8, int(150 * width))
            shown = text if len(text) <= fits else text[: fits - 1] + "…"
            paper.text(x + 0.006, top - 0.029, shown, fontsize=8.0, color=INK, va="center")
            if x > 0.02:
                paper.plot([x, x], [top, top - 0.0425], color=INK, lw=THIN)
            x += width
    return figure


def drawing_axes(
    figure: Figure, box: Sequence[float], width: float, height: float
) -> tuple[Axes, str]:
    """Add axes in a box of the sheet, in true scale: 1, 2 or 5 times a power of ten, or under.

    Args:
        figure: an A4 sheet.
        box: left, bottom, width, height, as shares of the sheet.
        width: mm, what must fit.
        height: mm.

    Returns:
        The axes, centred on (0, 0) in mm, and the scale as text, such as `2:1`.
    """
    paper = [box[2] * SIZE[0] * MM_PER_INCH, box[3] * SIZE[1] * MM_PER_INCH]
    largest = min(paper[0] / width, paper[1] / height)
    scale = max(s for s in _all_scales() if s <= largest * (1.0 + 1e-9))
    axes = figure.add_axes((box[0], box[1], box[2], box[3]))
    half = [0.5 * side / scale for side in paper]
    axes.set(xlim=(-half[0], half[0]), ylim=(-half[1], half[1]), aspect="equal")
    axes.axis("off")
    return axes, f"{scale:g}:1" if scale >= 1.0 else f"1:{1.0 / scale:g}"


def per_paper_mm(axes: Axes) -> float:
    """Return the drawing's mm in one mm of paper."""
    low, high = axes.get_xlim()
    return (high - low) / (axes.get_position().width * SIZE[0] * MM_PER_INCH)


def dimension(
    axes: Axes,
    start: tuple[float, float],
    end: tuple[float, float],
    level: float,
    text: str,
    upright: bool,
    after: bool,
) -> None:
    """Draw a dimension with extension lines from two points of the drawing (mm).

    Args:
        axes: from `drawing_axes`.
        start: first point, (z, y).
        end: second point.
        level: z of an upright dimension line, y of a level one.
        text: what stands beside it.
        upright: whether the dimension line is upright.
        after: whether the text stands beyond the line (right of or above it), or before it.
    """
    unit = per_paper_mm(axes)
    over = math.copysign(1.2 * unit, 1.0)
    first, last = (start, end) if not upright else (start[::-1], end[::-1])
    # (along, across) of the dimension line, whichever way it runs.
    for along, across in (first, last):
        outer = level + over * math.copysign(1.0, level - across)
        ends = ([along, along], [across, outer])
        axes.plot(*(ends if not upright else ends[::-1]), color="0.55", lw=0.4, zorder=1)
    points = [(first[0], level), (last[0], level)]
    points = [p if not upright else p[::-1] for p in points]
    small = abs(first[0] - last[0]) < 9.0 * unit
    style = "-" if small else "<|-|>"
    arrow = {
        "arrowstyle": style,
        "lw": THIN,
        "color": INK,
        "shrinkA": 0,
        "shrinkB": 0,
        "mutation_scale": 6,
    }
    axes.annotate("", points[1], points[0], arrowprops=arrow, zorder=3)
    if small:
        low, high = sorted((first[0], last[0]))
        for tip, tail in ((low, low - 6.0 * unit), (high, high + 6.0 * unit)):
            tips = [(tip, level), (tail, level)]
            head, foot = [p if not upright else p[::-1] for p in tips]
            inward = {**arrow, "arrowstyle": "-|>"}
            axes.annotate("", head, foot, arrowprops=inward, zorder=3)
    middle = 0.5 * (first[0] + last[0])
    shift = level + (1.0 if after else -1.0) * 1.7 * unit
    place = (middle, shift) if not upright else (shift, middle)
    alignment = (
        {"ha": "center", "va": "bottom" if after else "top"}
        if not upright
        else {"ha": "left" if after else "right", "va": "center", "rotation": 90}
    )
    axes.text(*place, text, fontsize=TEXT + 0.5, color=INK, zorder=4, **alignment)


def table(
    figure: Figure,
    box: Sequence[float],
    columns: Sequence[tuple[str, Sequence[tuple[str, str]]]],
    widths: Sequence[float],
    name_share: float = 0.27,
) -> None:
    """Draw columns of named rows, each under its heading, in a box of the sheet."""
    axes = figure.add_axes((box[0], box[1], box[2], box[3]))
    axes.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0))
    axes.axis("off")
    most = max(len(rows) for _, rows in columns) + 1
    height = box[3] * SIZE[1] * 72.0
    size = min(TEXT + 0.5, 0.62 * height / (most + 0.6))
    step = min(1.0 / (most + 0.4), 1.75 * size / height)
    bottom = 1.0 - step * (most + 0.4)
    axes.plot([0, 1, 1, 0, 0], [1, 1, bottom, bottom, 1], color=INK, lw=THIN, clip_on=False)
    x = 0.0
    for (heading, rows), width in zip(columns, widths, strict=True):
        if x > 0.0:
            axes.plot([x, x], [bottom, 1.0], color=INK, lw=THIN)
        axes.text(
            x + 0.008,
            1.0 - 0.55 * step,
            heading,
            fontsize=size + 0.5,
            weight="bold",
            va="center",
            color=INK,
        )
        for number, (name, text) in enumerate(rows, 1):
            y = 1.0 - (number + 0.6) * step
            wide = name == ""
            axes.text(x + 0.008, y, name, fontsize=size, color="0.3", va="center")
            start = x + (0.008 if wide else name_share * width)
            axes.text(
                start,
                y,
                text,
                fontsize=size,
                color=INK,
                va="center",
                style="italic" if "to be agreed" in text else "normal",
            )
        x += width
    axes.plot([0, 1], [1.0 - 1.1 * step] * 2, color=INK, lw=THIN)


def grid_table(
    figure: Figure,
    box: Sequence[float],
    title: str,
    rows: Sequence[Sequence[str]],
    widths: Sequence[float] | None = None,
) -> None:
    """Draw rows of numbers under a title, the first row in bold, right-aligned.

    Columns are of equal widths, or of given shares of the box.
    """
    axes = figure.add_axes((box[0], box[1], box[2], box[3]))
    axes.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0))
    axes.axis("off")
    height = box[3] * SIZE[1] * 72.0
    shares = widths or [1.0 / len(rows[0])] * len(rows[0])
    across = box[2] * SIZE[0] * 72.0
    fits = [
        share * across / (0.6 * (1 + max(map(len, column))))
        for share, column in zip(shares, zip(*rows, strict=True), strict=True)
    ]
    size = min(TEXT, 0.6 * height / (len(rows) + 2), *fits)
    step = min(1.0 / (len(rows) + 1.5), 1.7 * size / height)
    axes.text(0.0, 1.0 - 0.5 * step, title, fontsize=TEXT, weight="bold", va="center", color=INK)
    for number, row in enumerate(rows):
        y = 1.0 - (number + 1.6) * step
        right = 0.0
        for share, text in zip(shares, row, strict=True):
            right += share
            axes.text(
                right - 0.005,
                y,
                text,
                fontsize=size,
                ha="right",
                va="center",
                color=INK,
                weight="bold" if number == 0 else "normal",
            )
    axes.plot([0, 1], [1.0 - 2.1 * step] * 2, color=INK, lw=THIN)


def draw_formula(figure: Figure, place: tuple[float, float], formula: str, size: float) -> None:
    """Draw mathematical text as outlines, which look the same in every viewer.

    Signs such as roots come from fonts that only matplotlib has.

    Args:
        figure: the sheet.
        place: of the left end at half the height, as shares of the sheet.
        formula: between dollar signs.
        size: of letters, points.
    """
    outline = TextPath((0.0, 0.0), formula, size=size)
    extents = outline.get_extents()
    centred = Affine2D().translate(-extents.x0, -0.5 * (extents.y0 + extents.y1)).scale(1.0 / 72.0)
    placed = centred + figure.dpi_scale_trans
    placed += ScaledTranslation(*place, figure.transFigure)  # type: ignore[arg-type]  # any
    figure.add_artist(PathPatch(outline, transform=placed, facecolor=INK, linewidth=0.0))


def _all_scales() -> list[float]:
    up = [float(s * 10**p) for p in range(5) for s in _SCALES]
    return [*up, *(1.0 / s for s in up)]
