"""What is drawn in a figure, found by the gid that each artist has."""

import numpy as np


def by_gid(axes, gid):
    return [artist for artist in axes.get_children() if artist.get_gid() == gid]


def drawn(figure, gid):
    """Return the points of each line in a figure's first axes, (N, 2)."""
    return [np.stack(line.get_data(), -1) for line in by_gid(figure.axes[0], gid)]


def legend(figure):
    """Return the texts of all legends, those of the figure first."""
    boxes = [*figure.legends, *(axes.get_legend() for axes in figure.axes)]
    return [text.get_text() for box in boxes if box for text in box.get_texts()]
