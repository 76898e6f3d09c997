"""A scale bar says how large an image is."""

from typing import Any

from matplotlib.axes import Axes

from dolens.plotting.number_text import number_text
from dolens.plotting.style import SMALL

_LONGEST = 0.45


def round_length(longest: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above a length."""
    lengths = [factor * 10.0**power for power in range(-9, 7) for factor in (1.0, 2.0, 5.0)]
    return max((length for length in lengths if length <= longest * (1.0 + 1e-9)), default=longest)


def scale_bar(axes: Axes, pixels: int, pitch: float) -> None:
    """Draw a bar of a round length below an image, at its left, where it covers nothing.

    Artists carry gids: `scale bar`, `scale`.

    Args:
        axes: with an image of square pixels.
        pixels: shown across it.
        pitch: mm, of a pixel.
    """
    length = round_length(_LONGEST * pixels * pitch)
    share = length / (pixels * pitch)
    look: dict[str, Any] = {
        "color": "black",
        "linewidth": 2.0,
        "solid_capstyle": "butt",
        "clip_on": False,
    }
    axes.plot([0.0, share], [-0.05, -0.05], transform=axes.transAxes, gid="scale bar", **look)
    text = f"{number_text(length)} mm" if length >= 0.1 else f"{number_text(1e3 * length)} µm"
    count = length / pitch
    text += f" ({number_text(count)} px)" if abs(count - round(count)) < 1e-6 else ""
    axes.text(
        0.0,
        -0.08,
        text,
        transform=axes.transAxes,
        ha="left",
        va="top",
        fontsize=SMALL - 1,
        gid="scale",
    )
