"""The page of `dolens play`: messages to and fro, and a browser that a person uses."""

import base64
import json
from contextlib import contextmanager

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from dolens import load_lens
from dolens.live.play import PlayedLens
from dolens.live.play_page import PlayPage
from dolens.live.serve import LocalServer


@contextmanager
def served(name="cooke_triplet"):
    with LocalServer(PlayPage(PlayedLens(load_lens(name), name)).routes()) as server:
        yield server


@pytest.fixture
def server():
    with served() as running:
        yield running


class Client:
    """What a browser does, without one."""

    def __init__(self, socket):
        self.socket, self.count = socket, 0
        self.lens = self.next("lens")
        self.first = [self.next() for _ in range(3)]

    def next(self, what=None):
        while True:
            message = json.loads(self.socket.recv(timeout=60))
            if what in (None, message["is"]):
                return message

    def send(self, **message):
        self.count += 1
        self.socket.send(json.dumps({**message, "id": self.count}))
        return self.count

    def answer(self, what="seen", **message):
        """The first answer of a kind to a message."""
        number = self.send(**message)
        while (found := self.next(what)).get("id") != number:
            pass
        return found


@pytest.fixture
def client(server):
    address = server.address.replace("http", "ws", 1) + "socket"
    with connect(address, max_size=None) as socket:
        yield Client(socket)


def test_a_browser_is_told_all_of_the_lens(client):
    assert [part["is"] for part in client.first] == ["seen", "mtf", "picture"]
    seen, mtf, picture = client.first
    assert seen["where"]["fields"] == ["0°", "14°", "20°"]
    assert dict(seen["numbers"])["EFL"] == "50.02 mm"
    assert len(seen["section"]["glasses"]) == 3
    assert [len(rays) for rays in seen["section"]["rays"]] == [7, 7, 7]
    assert seen["spots"]["rms"][0] == pytest.approx(4.6, abs=0.2)
    assert mtf["curves"][0][0][0] == 1.0
    assert base64.b64decode(picture["jpeg"])[:2] == b"\xff\xd8"
    assert "SCHOTT:N-BK7" in client.lens["glasses"]


def test_a_change_is_answered_and_undone(client):
    change = {"surfaces.1.radius": 21.0}
    there = client.answer(do="change", changes=change, done=True)
    assert there["values"]["surfaces.1.curvature"] == 1.0 / 21.0
    assert (there["undo"], there["redo"]) == (1, 0)
    assert dict(there["numbers"])["EFL"] != "50.02 mm"
    back = client.answer(do="undo")
    assert dict(back["numbers"])["EFL"] == "50.02 mm"
    assert (back["undo"], back["redo"]) == (0, 1)


def test_of_many_changes_the_last_wins_and_none_is_lost(client):
    for step in range(40):
        client.send(do="change", changes={"surfaces.1.radius": 21.0 + 0.01 * step})
    last = client.send(do="change", changes={"sensor_distance": 41.0}, done=True)
    answers = [client.next("seen")]
    while answers[-1]["id"] != last:
        answers.append(client.next("seen"))
    assert len(answers) < 20
    assert answers[-1]["values"]["surfaces.1.curvature"] == 1.0 / 21.39
    assert answers[-1]["values"]["sensor_distance"] == 41.0
    assert answers[-1]["undo"] == 1


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("axicon_ring_focus", None),  # has no power
        ("cassegrain_hoo_v2c18_3", "surface 1 is a mirror"),
        ("spectrometer_prism", "names no sensor's diameter"),  # its axis is broken
        ("eye_navarro_wide", "the sensor is curved"),
    ],
)
def test_lenses_out_of_the_ordinary_are_shown_and_lack_a_photograph_for_a_reason(name, problem):
    page = PlayPage(PlayedLens(load_lens(f"published/{name}"), name))
    first, mtf, picture = (part() for part in page.parts())
    json.dumps([first, mtf], allow_nan=False)
    assert first["section"]["rays"][0] and first["spots"]["rms"][0] is not None
    assert (problem or "") in picture.get("problem", "")


@pytest.mark.parametrize(
    ("message", "said"),
    [
        ({"do": "change", "changes": {"thicknesses.1": -2.0}}, "negative thickness"),
        ({"do": "change", "changes": 1}, "'changes' must be keys with values"),
        ({"do": "explode"}, "do: 'explode' is unknown"),
        ({"do": "save", "suffix": ".exe"}, "save: '.exe' is unknown"),
        ({"do": "part", "part": "moon"}, "part: 'moon' is unknown"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_the_lens_stays(client, message, said):
    found = client.answer("problem", **message)
    assert said in found["text"] and "\n" not in found["text"]
    assert client.answer(do="look")["values"] == client.first[0]["values"]


def test_an_optimization_is_taken_and_saved(client):
    blurred = client.answer(do="change", changes={"sensor_distance": 41.5}, done=True)
    client.send(do="optimize", variables=["sensor_distance"], efl=False)
    assert client.next("optimized")["text"].startswith("RMS spot radius")
    sharp = client.next("seen")
    assert max(sharp["spots"]["rms"]) < 0.5 * max(blurred["spots"]["rms"])
    client.send(do="optimize", variables=[], efl=False)
    assert "tick the values" in client.next("optimized")["text"]
    saved = client.answer("saved", do="save", suffix=".zmx")
    assert saved["name"] == "cooke_triplet.zmx"
    assert b"SURF 1" in base64.b64decode(saved["data"])


def test_what_is_no_message_ends_the_connection_alone(server):
    address = server.address.replace("http", "ws", 1) + "socket"
    for text in ("{", "[1]", "NaN"):
        with connect(address, max_size=None) as socket:
            Client(socket)
            socket.send(text)
            with pytest.raises(ConnectionClosed):
                while True:
                    socket.recv(timeout=60)
    with connect(address, max_size=None) as socket:
        assert Client(socket).first[0]["is"] == "seen"


def test_the_browser_that_came_last_has_the_lens(server):
    address = server.address.replace("http", "ws", 1) + "socket"
    with connect(address, max_size=None) as old, connect(address, max_size=None) as new:
        assert Client(new).first[0]["is"] == "seen"
        with pytest.raises(ConnectionClosed) as closed:
            while True:
                old.recv(timeout=60)
        assert closed.value.rcvd.code == 4001


def test_a_browser_that_breaks_off_leaves_the_lens_to_the_next(server):
    address = server.address.replace("http", "ws", 1) + "socket"
    for radius in (21.0, 21.5):
        with connect(address, max_size=None) as socket:
            client = Client(socket)
            client.send(do="change", changes={"surfaces.1.radius": radius}, done=True)
            client.next("seen")
            client.send(do="look")
            socket.socket.close()
    with connect(address, max_size=None) as socket:
        client = Client(socket)
        assert client.first[0]["values"]["surfaces.1.curvature"] == 1.0 / 21.5
        assert client.first[0]["undo"] == 2


@pytest.mark.browser
def test_a_person_drags_a_radius_undoes_it_and_saves(server, page):
    page.goto(server.address)
    shown = page.locator("body")
    page.locator("#picture[src]").wait_for()
    page.locator("#mtf .curve").first.wait_for()
    first = page.locator("#numbers").inner_text()
    picture = page.locator("#picture").get_attribute("src")
    assert "50.02 mm" in first

    slider = page.get_by_label("Surface 1: radius", exact=True)
    box = slider.bounding_box()
    middle = box["y"] + 0.5 * box["height"]
    page.mouse.move(box["x"] + 0.5 * box["width"], middle)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.55 * box["width"], middle, steps=5)
    page.mouse.up()
    page.locator("#undo:enabled").wait_for()
    page.locator(f"#picture:not([src='{picture}'])").wait_for()
    assert page.locator("#numbers").inner_text() != first
    assert page.locator("#section .chosen").count() == 1
    assert page.screenshot()[:4] == b"\x89PNG"

    page.keyboard.press("Control+z")
    page.locator("#redo:enabled").wait_for()
    assert page.locator("#numbers").inner_text() == first

    count = int(shown.get_attribute("data-shown"))
    slider.focus()
    page.keyboard.press("ArrowRight")
    page.locator(f"body:not([data-shown='{count}'])").wait_for()
    page.locator("#redo:disabled").wait_for()

    thickness = page.get_by_role("spinbutton", name="thickness mm").first
    thickness.fill("-2")
    thickness.press("Enter")
    page.locator("#said.problem").wait_for()
    assert "negative thickness" in page.locator("#said").inner_text()
    assert thickness.input_value() == "3.259"

    with page.expect_download() as saved:
        page.get_by_role("button", name="Save", exact=True).click()
    assert saved.value.suggested_filename == "cooke_triplet.yaml"


@pytest.mark.browser
@pytest.mark.parametrize("width", [390, 1280])
def test_nothing_is_wider_than_the_screen(page, width):
    page.set_viewport_size({"width": width, "height": 844})
    with served("phone") as server:
        page.goto(server.address)
        page.locator("#mtf .curve").first.wait_for()
        page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
        assert page.evaluate("document.documentElement.scrollWidth") == width
        assert page.get_by_label("Surface 2: a4", exact=True).is_visible()
