"""Figures show themselves in a notebook without pyplot."""

import io
from functools import partial

from matplotlib.figure import Figure


def showing(figure: Figure) -> Figure:
    """Return the same figure, with the picture that IPython asks an object for.

    IPython's own formatter for figures exists only where pyplot was set up; where it does, it comes
    first and this is not asked, so that a figure is shown once.
    """
    figure._repr_png_ = partial(png_of, figure)  # type: ignore[attr-defined]
    return figure


def png_of(figure: Figure) -> bytes:
    """Return a figure as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    return buffer.getvalue()
