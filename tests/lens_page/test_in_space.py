"""A lens in space by itself: the page holds the lens's surfaces, and needs nothing else."""

import base64
import json
import math
from html import unescape

import numpy as np
import pytest

from dolens import InputError, load_lens
from tests.browser import pixels_of
from tests.lens_page.conftest import HOSTILE, Page


def data_of(html):
    start = html.index('id="viewer-data">') + len('id="viewer-data">')
    return json.loads(html[start : html.index("</script>", start)])


def points(text):
    return np.frombuffer(base64.b64decode(text), dtype="<f4").reshape(-1, 3).astype(float)


def test_the_page_holds_the_spheres_of_a_triplet_where_they_stand():
    """In closed form: z = vertex + R - sign(R)·√(R² - r²), out to the semi-diameter."""
    lens = load_lens("cooke_triplet")
    data = data_of(lens.draw_3d().html)
    meshes = [points(mesh["positions"]) for mesh in data["meshes"] if mesh["kind"] == "glass"]
    surfaces, vertex = [], 0.0
    for number, surface in lens.surfaces.items():
        # The stop between the elements is of air on both sides.
        if not all(material.name == "air" for material in lens.materials[int(number) - 1 :][:2]):
            surfaces.append((surface, vertex))
        vertex += float(lens.thicknesses[number]) if number in lens.thicknesses else 0.0
    assert len(meshes) == len(surfaces) == 6
    for found, (surface, z) in zip(meshes, surfaces, strict=True):
        radius = 1.0 / float(surface.curvature)
        r = np.hypot(found[:, 0], found[:, 1])
        sphere = z + radius - math.copysign(1.0, radius) * np.sqrt(radius**2 - r**2)
        assert found[:, 2] == pytest.approx(sphere, abs=1e-5)
        assert r.max() == pytest.approx(surface.semi_diameter, rel=1e-6)
    # Rays end on the sensor.
    for field in data["fields"]:
        assert len(field["rays"]) > 8
        for ray in field["rays"]:
            assert points(ray)[-1, 2] == pytest.approx(
                vertex + float(lens.sensor_distance), abs=1e-4
            )


def test_the_page_is_whole_and_no_address_leads_out_of_it(hostile_lens):
    found = hostile_lens.draw_3d()
    page = Page(found.html)
    assert page.links == [] and "http" not in found.html
    assert HOSTILE not in found.html and "".join(page.text).count(HOSTILE) >= 1
    assert len(page.named["script"]) == 2 and len(page.named["canvas"]) == 1
    # Of the three fields one is dark.
    assert "40° (no ray passes)" in "".join(page.text)
    assert "2 of 3 fields with rays" in repr(found)


def test_a_notebook_shows_the_page_in_a_frame_of_its_own(hostile_lens):
    found = hostile_lens.draw_3d(fields=[0.0, 3.0], f_number=8.0)
    frame = Page(found._repr_html_())
    assert list(frame.named) == ["iframe"] and frame.named["iframe"][0]["srcdoc"] == found.html
    assert len(data_of(unescape(found._repr_html_()))["fields"]) == 2


def test_the_page_is_saved_as_one_file_and_as_nothing_else(hostile_lens, tmp_path):
    found = hostile_lens.draw_3d()
    path = tmp_path / "new" / "lens.html"
    assert found.save(path) == path and path.read_text(encoding="utf-8") == found.html
    assert found.save(str(path)) == path
    with pytest.raises(InputError, match=r"path: .*lens\.png'; allowed: .*\.html"):
        found.save(tmp_path / "lens.png")
    (tmp_path / "folder.html").mkdir()
    with pytest.raises(InputError, match=r"^path: .*folder\.html"):
        found.save(tmp_path / "folder.html")


def test_arguments_that_are_unknown_or_wrong_are_named():
    lens = load_lens("cooke_triplet")
    with pytest.raises(InputError, match=r"draw_3d\(\): unknown key 'f_numbre'; did you mean 'f_n"):
        lens.draw_3d(f_numbre=8.0)
    with pytest.raises(InputError, match="f_number must be positive, not -8"):
        lens.draw_3d(f_number=-8.0)


@pytest.mark.browser
def test_a_browser_draws_the_lens_in_a_notebook_s_frame(tmp_path, chromium):
    notebook = tmp_path / "notebook.html"
    notebook.write_text(f"<body>{load_lens('cooke_triplet').draw_3d()._repr_html_()}</body>")
    with chromium.new_context(viewport={"width": 900, "height": 600}) as context:
        page = context.new_page()
        page.goto(notebook.as_uri())
        frame = page.frame_locator("iframe")
        frame.locator("[data-drawn=yes]").wait_for()
        pixels = pixels_of(page.screenshot())
        assert "Cooke triplet" in frame.locator("body").inner_text()
    # Glass is pale; rays are not.
    assert ((pixels.max(-1) - pixels.min(-1)) > 90).sum() > 100
