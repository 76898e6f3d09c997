"""A page is laid out by a browser: nothing is cut off, empty or blank, on a laptop or a phone."""

import pytest

from tests.browser import pixels_of

MEASURE = """() => {
  const box = (e) => { const b = e.getBoundingClientRect();
    return [b.left, b.top + scrollY, b.width, b.height].map(Math.round); };
  const viewer = document.getElementById("viewer");
  return {
    width: innerWidth, scroll: document.documentElement.scrollWidth,
    sections: [...document.querySelectorAll("section")].map(box),
    figures: [...document.querySelectorAll("figure svg")].map(box),
    tables: [...document.querySelectorAll(".scroll")].map(box),
    canvas: box(viewer.querySelector("canvas")), renderer: viewer.dataset.renderer,
  };
}"""
LAPTOP, PHONE = 1280, 390


@pytest.fixture(scope="module")
def looked_at(page, chromium):
    """Widths of the screen → what the browser measured there, and the whole page's pixels."""

    def look(width):
        with chromium.new_context(viewport={"width": width, "height": 900}) as context:
            opened = context.new_page()
            opened.goto(page[0].as_uri())
            opened.locator("#viewer[data-drawn=yes]").wait_for()
            return opened.evaluate(MEASURE), pixels_of(opened.screenshot(full_page=True))

    return {width: look(width) for width in (LAPTOP, PHONE)}


@pytest.fixture
def measured(looked_at):
    return {width: found for width, (found, _) in looked_at.items()}


@pytest.mark.browser
@pytest.mark.parametrize("width", [LAPTOP, PHONE])
def test_no_section_is_wider_than_the_screen(measured, width):
    found = measured[width]
    assert found["width"] == width
    assert found["scroll"] <= width
    for left, _, across, down in (*found["sections"], *found["tables"]):
        assert left >= 0 and left + across <= width
        assert across > 0.7 * min(width, 900) - 40 and down > 30


@pytest.mark.browser
@pytest.mark.parametrize("width", [LAPTOP, PHONE])
def test_every_figure_has_a_size(measured, width):
    assert len(measured[width]["figures"]) >= 10
    for left, _, across, down in measured[width]["figures"]:
        assert across > 250 and down > 60
        assert left + across <= width


@pytest.mark.browser
def test_figures_and_the_view_in_space_show_something(looked_at):
    found, pixels = looked_at[LAPTOP]
    assert found["renderer"] in ("webgl", "canvas")
    assert pixels.shape[1] == LAPTOP
    for left, top, across, down in (*found["figures"], found["canvas"]):
        part = pixels[top : top + down, left : left + across]
        assert part.std((0, 1)).max() > 4.0
    left, top, across, down = found["canvas"]
    part = pixels[top : top + down, left : left + across]
    # Glass is pale; rays are not.
    assert ((part.max(-1) - part.min(-1)) > 90).sum() > 100
