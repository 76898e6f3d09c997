"""A page is laid out by a browser: nothing is cut off, empty or blank, on a laptop or a phone."""

import json
import re
from html import unescape

import numpy as np
import pytest
from PIL import Image

# What a browser knows of the layout, written into the page for --dump-dom.
MEASURE = """
<pre id="measured"></pre>
<script>
window.addEventListener("load", () => setTimeout(() => {
  const box = (e) => { const b = e.getBoundingClientRect();
    return [b.left, b.top + scrollY, b.width, b.height].map(Math.round); };
  const viewer = document.getElementById("viewer");
  document.getElementById("measured").textContent = JSON.stringify({
    width: innerWidth, scroll: document.documentElement.scrollWidth,
    sections: [...document.querySelectorAll("section")].map(box),
    figures: [...document.querySelectorAll("figure svg")].map(box),
    tables: [...document.querySelectorAll(".scroll")].map(box),
    canvas: box(viewer.querySelector("canvas")),
    drawn: viewer.dataset.drawn, renderer: viewer.dataset.renderer,
  });
}, 500));
</script>
</body>"""
LAPTOP, PHONE = 1280, 390


@pytest.fixture(scope="module")
def measured(page, chromium):
    """Widths of the viewport → what the browser measured in a frame of that width."""
    inner = page[0].parent / "measured.html"
    inner.write_text(page[0].read_text(encoding="utf-8").replace("</body>", MEASURE))

    def measure(width):
        # A window of a browser may not be as narrow as a phone; a frame may.
        outer = page[0].parent / f"frame{width}.html"
        outer.write_text(
            f'<iframe id="f" src="measured.html" style="width:{width}px;height:900px;border:0">'
            '</iframe><pre id="out"></pre><script>setInterval(() => {'
            'const found = f.contentDocument && f.contentDocument.getElementById("measured");'
            "if (found && found.textContent) out.textContent = found.textContent; }, 100)</script>"
        )
        dom = chromium(
            outer, "--dump-dom", "--allow-file-access-from-files", "--window-size=1400,1000"
        )
        return json.loads(unescape(re.search(r'<pre id="out">(.*?)</pre>', dom, re.DOTALL)[1]))

    return {width: measure(width) for width in (LAPTOP, PHONE)}


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
def test_figures_and_the_view_in_space_show_something(page, measured, chromium):
    found = measured[LAPTOP]
    assert found["drawn"] == "yes"
    assert found["renderer"] in ("webgl", "canvas")
    height = max(top + down for _, top, _, down in found["sections"]) + 50
    picture = page[0].parent / "page.png"
    chromium(page[0], f"--screenshot={picture}", f"--window-size={LAPTOP},{height}")
    pixels = np.asarray(Image.open(picture).convert("RGB")).astype(float)
    assert pixels.shape[1] == LAPTOP
    for left, top, across, down in (*found["figures"], found["canvas"]):
        part = pixels[top : top + down, left : left + across]
        assert part.std((0, 1)).max() > 4.0
    left, top, across, down = found["canvas"]
    part = pixels[top : top + down, left : left + across]
    # Glass is pale; rays are not.
    assert ((part.max(-1) - part.min(-1)) > 90).sum() > 100
