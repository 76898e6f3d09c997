"""The documentation site is built from the repository alone, without the network."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from dolens.experiments.running.catalogue import configuration_folders, experiments

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built site; a broken link, anchor or name in the API ends the build."""
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder],
        cwd=ROOT,
        env={**os.environ, "https_proxy": "http://127.0.0.1:9", "http_proxy": "http://127.0.0.1:9"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    return folder


def test_every_page_of_the_navigation_is_built(site):
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    pages = re.findall(r"([\w/]+)\.(?:md|ipynb)\b", text.partition("nav:")[2])
    assert len(pages) > 30
    for page in pages:
        assert (site / f"{page}.html").is_file(), page


def test_no_page_loads_anything_from_the_network(site):
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(r'<(?:script|img|iframe)[^>]*\bsrc="(https?:[^"]*)"', text)
        loaded += re.findall(r'<link[^>]*rel="stylesheet"[^>]*href="(https?:[^"]*)"', text)
        assert not loaded, (page.name, loaded)


def test_the_search_needs_no_server(site):
    """Its index is a script, and its worker a frame: a page from a folder may load no more."""
    assert (site / "search/search_index.js").read_text("utf-8").startswith("var __index")
    assert (site / "iframe-worker.js").is_file()
    assert 'src="iframe-worker.js"' in (site / "index.html").read_text("utf-8")


def test_the_api_has_what_a_user_imports(site):
    text = "".join(p.read_text(encoding="utf-8") for p in (site / "api").glob("*.html"))
    for name in ("load_lens", "DampedLeastSquares", "RayRenderer", "UNetRestoration", "Experiment"):
        assert name in text, name


def test_no_page_shows_its_markup(site):
    """A fence, a list or a heading that Markdown did not take stands in the text as it is typed."""
    for page in site.rglob("*.html"):
        text = re.sub(
            r"<(pre|code|script|style)\b.*?</\1>", "", page.read_text("utf-8"), flags=re.S
        )
        for paragraph in re.findall(r"<(?:p|li)>(.*?)</(?:p|li)>", text, re.S):
            assert "```" not in paragraph and "\n- " not in paragraph, (page.name, paragraph[:200])


def test_what_a_function_returns_is_one_entry(site):
    """`Returns:` describes one value over several lines; each line is not a value of its own."""
    text = (site / "api/optics.html").read_text(encoding="utf-8")
    for part in re.findall(r"Returns:.*?</ul>", text, re.S):
        assert part.count("<li") == 1, re.sub(r"<[^>]*>", "", part)[:300]


def test_the_gallery_has_every_experiment_and_notebook_once_with_its_cost(site):
    text = (site / "gallery.html").read_text(encoding="utf-8")
    known = experiments(configuration_folders(ROOT))
    assert len(known) > 40
    for one in known:
        assert text.count(f"<code>dolens train experiment={one.name}</code>") == 1
        assert one.cost and one.cost in text
    for path in (ROOT / "docs/notebooks").glob("*.ipynb"):
        assert text.count(f"<code>jupyter lab docs/notebooks/{path.name}</code>") == 1
        assert (site / f"images/notebooks/{path.stem}.webp").is_file()


def test_pictures_load_quickly():
    """In all as much as a photograph or two of a telephone."""
    sizes = [path.stat().st_size for path in (ROOT / "docs/images").rglob("*.*")]
    assert sum(sizes) < 4_500_000
    assert max(p.stat().st_size for p in (ROOT / "docs/images/gallery").iterdir()) <= 40_000
