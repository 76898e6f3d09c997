"""Fixtures of all tests that look at pages in headless Chromium, which is started once."""

import io
import shutil

import anyio.from_thread
import numpy as np
import pytest
from PIL import Image


@pytest.fixture(scope="session")
def chromium():
    """Headless Chromium, by Playwright; skipped where there is none.

    Playwright's loop of events runs in this thread until the end of the session: no other loop
    can, so tests that need one take the fixture `run_async`.
    """
    playwright = pytest.importorskip("playwright.sync_api")
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    if program is None:
        pytest.skip("there is no chromium on this machine")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def run_async():
    """Runs a coroutine function in a thread of its own, and returns what it returns."""
    with anyio.from_thread.start_blocking_portal() as portal:
        yield portal.call


@pytest.fixture
def page(chromium):
    """A page in a browser, which must log no error; `page.goto(server.address)` opens one."""
    problems = []
    with chromium.new_context(viewport={"width": 1280, "height": 900}) as context:
        opened = context.new_page()
        opened.on("pageerror", lambda error: problems.append(str(error)))
        opened.on(
            "console", lambda said: problems.append(said.text) if said.type == "error" else None
        )
        yield opened
    assert problems == [], problems


def pixels_of(screenshot):
    """A screenshot's bytes as an array `(rows, columns, 3)` of 0 to 255."""
    return np.asarray(Image.open(io.BytesIO(screenshot)).convert("RGB")).astype(float)
