import math
import sys

import numpy as np
import pytest
import torch
from PIL import Image

from dolens.errors import InputError
from dolens.plotting import curves_figure, figure_to_image, save_figure

SERIES = {"train": ([0, 1, 2], [1.0, 0.1, 0.01]), "val": ([0, 2], [2.0, math.nan])}


def test_every_series_is_a_labelled_line():
    axes = curves_figure(SERIES, "epoch", "loss", "History").axes[0]
    for line, (label, (x, y)) in zip(axes.get_lines(), SERIES.items(), strict=True):
        assert line.get_label() == label
        np.testing.assert_array_equal(line.get_xdata(), x)
        np.testing.assert_array_equal(line.get_ydata(), y)
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_title()) == ("epoch", "loss", "History")
    assert [text.get_text() for text in axes.get_legend().get_texts()] == list(SERIES)
    assert axes.get_yscale() == "linear"
    assert all(tick == round(tick) for tick in axes.get_xticks())


def test_logarithm_and_one_line_without_a_legend():
    axes = curves_figure({"mtf": ([0.0, 0.5], [1.0, 0.0])}, "x", "y", logy=True).axes[0]
    assert axes.get_yscale() == "log"
    assert axes.get_legend() is None


def test_unequal_lengths_are_refused():
    with pytest.raises(InputError, match="'train'"):
        curves_figure({"train": ([0, 1], [1.0])}, "x", "y")


def test_an_image_tensor_has_the_figures_size_and_colours():
    figure = curves_figure(SERIES, "epoch", "loss")
    dpi = figure.get_dpi()
    image = figure_to_image(figure, dpi=50)
    assert image.dtype == torch.uint8 and image.is_contiguous()
    width, height = figure.get_size_inches()
    assert image.shape == (3, round(50 * height), round(50 * width))
    assert (image[:, 0, 0] == 255).all()
    # The first line's blue, red first.
    blue = torch.tensor([0x00, 0x72, 0xB2]).view(3, 1, 1)
    assert ((image.int() - blue).abs().amax(0) < 8).any()
    assert figure.get_dpi() == dpi
    assert torch.equal(image, figure_to_image(figure, dpi=50))


def test_a_file_is_written_with_its_folders(tmp_path):
    path = tmp_path / "figures" / "deep" / "curves.png"
    figure = curves_figure(SERIES, "epoch", "loss")
    save_figure(figure, path, dpi=60)
    with Image.open(path) as picture:
        assert picture.size == tuple(round(60 * side) for side in figure.get_size_inches())
        assert np.asarray(picture.convert("L")).std() > 1.0


def test_figures_are_not_registered_anywhere():
    if "matplotlib.pyplot" in sys.modules:
        before = sys.modules["matplotlib.pyplot"].get_fignums()
        figure_to_image(curves_figure(SERIES, "x", "y"), dpi=20)
        assert sys.modules["matplotlib.pyplot"].get_fignums() == before
    else:
        figure_to_image(curves_figure(SERIES, "x", "y"), dpi=20)
        assert "matplotlib.pyplot" not in sys.modules
