"""A page of photographs: its pixels are those that were given, and a browser compares them."""

import base64
import io
import re

import numpy as np
import pytest
import torch
from PIL import Image

from dolens.errors import InputError
from dolens.photograph_page import page as module
from dolens.photograph_page.page import PhotographPage, ShownPhotograph


def photograph(name="chelsea", height=48, width=64, **of_page):
    """Three pictures of noise, whose pixels are whole numbers of 255."""
    images = torch.randint(0, 256, (3, 3, height, width)) / 255.0
    pictures = dict(zip(("truth", "sensor", "restored"), images, strict=True))
    return ShownPhotograph(name, pictures, **of_page)


def written(tmp_path, *photographs):
    page = PhotographPage(len(photographs))
    for entry in photographs:
        page.add(entry)
    page.write(tmp_path / "photographs.html", "Photographs", ["One note."])
    return tmp_path / "photographs.html"


def embedded(text):
    """The pictures in a page, each (height, width, 3)."""
    found = re.findall(r'src="data:image/webp;base64,([^"]*)"', text)
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))) for data in found]


def test_pixels_stand_in_the_page_without_loss(tmp_path):
    given = photograph()
    found = embedded(written(tmp_path, given).read_text())
    assert len(found) == 3
    for image, pixels in zip(given.pictures.values(), found, strict=True):
        assert np.array_equal((image * 255).round().permute(1, 2, 0).numpy(), pixels)


def test_the_page_leads_nowhere_and_no_name_is_markup(tmp_path):
    name = "<img src=x onerror=alert(1)>"
    text = written(tmp_path, photograph(name, metrics={name: 1.0}, note=name)).read_text()
    assert name not in text and "&lt;img src=x" in text
    assert not re.search(r"https?:", text)


def test_a_large_photograph_is_reduced_and_a_detail_of_it_is_not(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(module, "_MOST_PIXELS", 64 * 64)
    given = photograph(height=150, width=200)
    given.pictures["truth"][:, :75, :] = 0.5  # the lower half has all detail
    with caplog.at_level("INFO"):
        text = written(tmp_path, given).read_text()
    truth, detail = embedded(text)[0], embedded(text)[3]
    # 32² pixels for the detail leave 3072: every fourth along each side.
    assert truth.shape == (38, 50, 3) and detail.shape == (32, 32, 3)
    assert "200×150 pixels are shown as means of 4×4" in text and "means of 4×4" in caplog.text
    top, left = map(int, re.search(r"rows (\d+) to \d+, columns (\d+) to", text).groups())
    assert top >= 64
    cut = given.pictures["truth"][:, top : top + 32, left : left + 32]
    assert np.array_equal((cut * 255).round().permute(1, 2, 0).numpy(), detail)
    mean = 255 * given.pictures["truth"][:, 148:, 196:].mean((1, 2))
    assert np.allclose(truth[-1, -1], mean.numpy(), atol=1.0)


def test_a_page_without_photographs_is_refused(tmp_path):
    with pytest.raises(InputError, match="no photographs"):
        written(tmp_path)


@pytest.mark.browser
def test_the_slider_divides_the_two_pictures_where_it_is_dragged(page, tmp_path):
    flat = {label: torch.full((3, 64, 96), value) for label, value in
            (("truth", 0.0), ("sensor", 0.2), ("restored", 1.0))}  # fmt: skip
    page.goto(written(tmp_path, ShownPhotograph("flat", flat)).as_uri())
    page.wait_for_selector("[data-shown]")
    stage = page.locator(".stage")
    box = stage.bounding_box()

    def share_of_white():
        pixels = np.asarray(Image.open(io.BytesIO(stage.screenshot())).convert("L"))
        return (pixels[: len(pixels) // 3] > 250).mean()

    assert abs(share_of_white() - 0.5) < 0.02  # the restored picture is to the right
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 20)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 4, box["y"] + 20, steps=4)
    page.mouse.up()
    assert abs(share_of_white() - 0.75) < 0.02
    page.locator("input[type=range]").focus()
    page.keyboard.press("End")
    assert share_of_white() < 0.02
    # Another picture in its place: the sensor's and the truth are dark.
    page.locator("[role=group]").nth(1).get_by_text("truth").click()
    page.keyboard.press("Home")
    assert share_of_white() < 0.02


@pytest.mark.browser
@pytest.mark.parametrize("width", [1280, 390])
def test_the_magnifier_shows_the_pixels_of_one_place_in_all(page, tmp_path, width):
    page.set_viewport_size({"width": width, "height": 800})
    two = photograph("first"), photograph("second")
    page.goto(written(tmp_path, *two).as_uri())
    page.wait_for_selector("[data-shown='1']")
    page.keyboard.press("n")
    page.wait_for_selector("[data-shown='2']")
    assert page.locator("h2").inner_text() == "second"
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    box = page.locator(".stage").bounding_box()
    scale = box["width"] / 64
    page.mouse.move(box["x"] + 31.5 * scale, box["y"] + 20.5 * scale)
    column, row = map(int, re.findall(r"\d+", page.get_by_text("about column").inner_text()))
    assert abs(column - 31) <= 1 and abs(row - 20) <= 1
    page.locator(".magnifier").focus()
    for key, moved in (("ArrowRight", (1, 0)), ("ArrowUp", (0, -1))):
        page.keyboard.press(key)
        column, row = column + moved[0], row + moved[1]
        for image, said in zip(
            two[1].pictures.values(), page.locator("figcaption:visible").all(), strict=True
        ):
            value = (255 * image[:, row, column]).round().int().tolist()
            assert said.inner_text().split()[1:] == list(map(str, value))
