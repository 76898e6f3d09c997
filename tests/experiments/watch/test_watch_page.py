"""`dolens watch` and `live=true`: the page of a run, as one looks at it."""

import re
import time

import pytest
from typer.testing import CliRunner

from dolens.cli.app import app
from dolens.errors import InputError
from dolens.experiments.running import training
from dolens.experiments.watch.history import Frame, Recorder

pytest.importorskip("starlette")
from dolens.experiments.watch.server import WatchServer


def test_the_command_says_its_address_and_ends_when_nobody_looks(tiny_run):
    done = CliRunner().invoke(app, ["watch", str(tiny_run), "--idle", "0.005"])
    assert done.exit_code == 0, done.output
    assert re.search(r"http://127\.0\.0\.1:\d+/[\w-]{30,}/", done.output.replace("\n", ""))


@pytest.mark.parametrize(
    ("words", "message"),
    [(["none"], "none: is no folder of a run"), ([".", "--idle", "0"], "--idle: 0; allowed"),
     ([".", "--port", "99999"], "--port: 99999; allowed")],
)  # fmt: skip
def test_what_cannot_be_watched_is_refused_in_one_line(words, message, tiny_run, monkeypatch):
    monkeypatch.chdir(tiny_run)
    done = CliRunner().invoke(app, ["watch", *words])
    assert isinstance(done.exception, InputError) and message in str(done.exception)


def test_a_folder_of_something_else_is_refused(tmp_path):
    with pytest.raises(InputError, match="is no run folder"):
        WatchServer(tmp_path)


def test_live_starts_the_page_of_the_run(trained, monkeypatch):
    asked = []
    monkeypatch.setattr(training, "start_page", asked.append)
    run = trained("experiment=asphere", "live=true", "test=false", "objective=train/merit",
                  "callbacks.pictures=null", "+trainer.enable_progress_bar=false")  # fmt: skip
    assert asked == [run.folder]


def test_live_is_a_yes_or_a_no(refused):
    refused("live: 'maybe'", "experiment=asphere", "live=maybe")


@pytest.fixture
def watched(run_copy):
    """A run that goes on, under a name that is markup, and what records it."""
    folder = run_copy.rename(run_copy.with_name("<img src=x onerror=alert(1)>"))
    (folder / "run.json").write_text('{"status": "running"}')
    recorder = Recorder(folder)
    for step in (1, 2):
        add(recorder, step)
    return folder, recorder


def add(recorder, step):
    values = {"sensor_distance": 95.0 + 0.1 * step, "surfaces.5.x3": 1e-3 * step}
    recorder.add(step, Frame(0, 0.0, values), time.monotonic())
    recorder.write()


@pytest.mark.browser
def test_one_scrubs_through_a_run_that_goes_on(page, watched):
    folder, recorder = watched
    with WatchServer(folder).server as server:
        page.goto(server.address)
        page.wait_for_selector("body[data-step='2']", timeout=60_000)
        assert page.locator("h1").inner_text().endswith("<img src=x onerror=alert(1)>")
        assert page.locator("#status").inner_text() == "running"
        newest = page.locator("#section svg").first.inner_html()
        # What is recorded next is shown by itself.
        asked = time.monotonic()
        add(recorder, 3)
        page.wait_for_selector("body[data-step='3']", timeout=30_000)
        assert time.monotonic() - asked < 20.0
        # A step that one has chosen stays.
        box = page.locator("#frame").bounding_box()
        page.mouse.click(box["x"] + 2, box["y"] + box["height"] / 2)
        page.wait_for_selector("body[data-step='1']")
        first = page.locator("#section svg").first.inner_html()
        assert first != newest and "step 1," in page.locator("#where").inner_text()
        add(recorder, 4)
        page.wait_for_selector("#frame[max='3']")
        assert page.locator("body").get_attribute("data-step") == "1"
        page.locator("h1").click()
        page.keyboard.press("ArrowRight")
        page.wait_for_selector("body[data-step='2']")
        page.keyboard.press("End")
        page.wait_for_selector("body[data-step='4']")
        assert page.locator("#newest").get_attribute("aria-pressed") == "true"
        (folder / "run.json").write_text('{"status": "finished"}')
        page.wait_for_selector("#status.finished")
        page.set_viewport_size({"width": 390, "height": 800})
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        page.goto("about:blank")  # before the server is gone


@pytest.mark.browser
def test_photographs_change_with_the_step(page, two_epochs):
    with WatchServer(two_epochs.folder).server as server:
        page.goto(server.address)
        page.wait_for_selector("#comparison[data-shown]", timeout=60_000)
        assert "after step 4" in page.locator("#photographs h2").inner_text()
        before = page.locator(".stage img").nth(1).get_attribute("src")
        page.locator("#frame").focus()
        page.keyboard.press("Home")
        page.keyboard.press("ArrowRight")
        page.keyboard.press("ArrowRight")
        page.locator("#photographs .thumbnails button").nth(1).click()
        page.wait_for_selector(f".stage img:nth-child(2):not([src='{before}'])")
        assert page.locator("#plots figure").count() >= 2
        page.goto("about:blank")
