"""Figures become files and image tensors."""

import sys

import numpy as np
import pytest
import torch
from PIL import Image

from dolens.errors import InputError
from dolens.plotting import (
    figure_to_image,
    history_figure,
    save_figure,
    save_figures,
)
from dolens.plotting.export import laid_out


def test_an_image_tensor_has_the_figures_size_and_colours():
    figure = history_figure([1.0, 0.1, 0.01])
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
    path = tmp_path / "figures" / "deep" / "history.png"
    figure = history_figure([1.0, 0.1, 0.01])
    save_figure(figure, path, dpi=60)
    with Image.open(path) as picture:
        assert picture.size == tuple(round(60 * side) for side in figure.get_size_inches())
        assert np.asarray(picture.convert("L")).std() > 1.0


def test_figures_are_not_registered_anywhere():
    if "matplotlib.pyplot" in sys.modules:
        before = sys.modules["matplotlib.pyplot"].get_fignums()
        figure_to_image(history_figure([1.0, 0.1, 0.01]), dpi=20)
        assert sys.modules["matplotlib.pyplot"].get_fignums() == before
    else:
        figure_to_image(history_figure([1.0, 0.1, 0.01]), dpi=20)
        assert "matplotlib.pyplot" not in sys.modules


def test_a_figure_is_written_in_every_format_that_is_asked_for(tmp_path):
    figure = history_figure([1.0, 0.1, 0.01])
    paths = save_figures(figure, tmp_path / "deep" / "history.v2", ("png", "pdf", "svg"))
    assert [path.name for path in paths] == ["history.v2.png", "history.v2.pdf", "history.v2.svg"]
    png, pdf, svg = (path.read_bytes() for path in paths)
    assert png[1:4] == b"PNG" and pdf[:4] == b"%PDF" and b"<svg" in svg
    # Letters stay letters in PDF: fonts of type 42, not shapes of type 3.
    assert b"/Type3" not in pdf and b"/CIDFontType2" in pdf
    again = save_figures(figure, tmp_path / "again", ("svg",))[0].read_bytes()
    assert again == svg
    with pytest.raises(InputError, match="gif"):
        save_figures(figure, tmp_path / "history", ("gif",))


def test_a_figure_is_laid_out_for_all_its_files_at_once(tmp_path, monkeypatch):
    """And keeps its layout engine, whatever goes wrong."""
    figure = history_figure([1.0, 0.1, 0.01])
    engine, passes = figure.get_layout_engine(), []
    execute = engine.execute
    monkeypatch.setattr(engine, "execute", lambda *a: passes.append(a) or execute(*a))
    with laid_out(figure):
        save_figures(figure, tmp_path / "history", ("png", "svg"))
        figure_to_image(figure)
    assert len(passes) == 2
    assert figure.get_layout_engine() is engine
    (tmp_path / "a folder.png").mkdir()
    with pytest.raises(IsADirectoryError):
        save_figure(figure, tmp_path / "a folder.png")
    assert figure.get_layout_engine() is engine
