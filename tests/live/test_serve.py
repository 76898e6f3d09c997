"""A page is served to who knows its token, under its own name, to its own scripts."""

import http.client
import os
import signal
import subprocess
import sys
from urllib.parse import urlsplit

import pytest

pytest.importorskip("starlette")
from starlette.routing import WebSocketRoute
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from dolens.errors import InputError
from dolens.live.serve import LocalServer, file_routes, text_route


async def echo(socket):
    await socket.accept()
    await socket.send_text(await socket.receive_text())


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    script = tmp_path_factory.mktemp("page") / "page.js"
    script.write_text("// script")
    (script.parent / "secret.js").write_text("// secret")
    routes = [
        text_route("/", "<p>page"),
        *file_routes([script]),
        WebSocketRoute("/socket", echo),
    ]
    with LocalServer(routes) as running:
        yield running


@pytest.fixture
def get(server):
    def answer(path, **headers):
        """Its status, headers and body; the path is sent as it is."""
        host = urlsplit(server.address).netloc
        connection = http.client.HTTPConnection(host, timeout=10)
        connection.putrequest("GET", path, skip_host=True)
        for name, value in {"Host": host, **headers}.items():
            connection.putheader(name, value)
        connection.endheaders()
        found = connection.getresponse()
        return found.status, found.headers, found.read().decode()

    return answer


@pytest.fixture
def path(server):
    return urlsplit(server.address).path


def test_the_page_and_its_script_are_served_under_the_token(get, path):
    status, headers, body = get(path)
    assert (status, body) == (200, "<p>page")
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert headers["Referrer-Policy"] == "no-referrer"
    status, headers, body = get(f"{path}page.js")
    assert (status, body) == (200, "// script")
    assert headers["Content-Type"].startswith("text/javascript")


@pytest.mark.parametrize("wrong", ["/", "/page.js", "/%c3%a9/", "//page.js", "/token/page.js"])
def test_nothing_is_served_without_the_token(get, wrong):
    status, _, body = get(wrong)
    assert status == 404
    assert "page" not in body and "script" not in body


def test_a_token_that_begins_alike_is_another(get, path):
    assert get(f"{path[:-2]}/")[0] == 404
    assert get(f"{path[:-1]}x/")[0] == 404


@pytest.mark.parametrize(
    "name", ["secret.js", "../secret.js", "%2e%2e/secret.js", "..%2fsecret.js", "/etc/passwd", ".."]
)
def test_no_other_file_is_served(get, path, name):
    status, _, body = get(path + name)
    assert status == 404
    assert "secret" not in body and "root" not in body


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1", "evil.example:80", ""])
def test_another_host_is_refused(get, path, host):
    assert get(path, Host=host)[0] == 421


def test_a_request_from_another_page_is_refused(get, path, server):
    own = "http://" + urlsplit(server.address).netloc
    assert get(path, Origin=own)[0] == 200
    assert get(path, Origin="http://evil.example")[0] == 403
    assert get(path, Origin="null")[0] == 403


def test_a_websocket_needs_token_host_and_origin(server, get, path):
    address = server.address.replace("http", "ws", 1) + "socket"
    own = server.address.split("/")[2]
    with connect(address, origin=f"http://{own}") as socket:
        socket.send("light")
        assert socket.recv(timeout=10) == "light"
    for refused, settings in (
        (f"ws://{own}/socket", {}),
        (f"ws://{own}/wrong/socket", {}),
        (address, {"origin": "http://evil.example"}),
    ):
        with pytest.raises(InvalidStatus, match="403"), connect(refused, **settings):
            pass
    upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
    upgrade["Sec-WebSocket-Key"] = "MDEyMzQ1Njc4OWFiY2RlZg=="
    assert get(f"{path}socket", **upgrade, Host="evil.example")[0] == 403


def test_it_listens_on_this_machine_alone_and_a_taken_port_is_one_line(server):
    host, port = urlsplit(server.address).netloc.split(":")
    assert host == "127.0.0.1"
    with pytest.raises(InputError, match=rf"--port: {port} cannot be used .*a free one is found"):
        LocalServer([], int(port))
    with pytest.raises(InputError, match="allowed: 1 to 65535"):
        LocalServer([], 0)


def test_ctrl_c_ends_it_without_a_traceback():
    program = (
        "from dolens.live.serve import LocalServer\n"
        "server = LocalServer([])\n"
        "print(server.address, flush=True)\n"
        "server.run()\n"
        "print('ended')\n"
    )
    with subprocess.Popen(
        [sys.executable, "-P", "-c", program],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as running:
        address = running.stdout.readline().strip()
        connection = http.client.HTTPConnection(urlsplit(address).netloc, timeout=10)
        connection.request("GET", urlsplit(address).path)
        assert connection.getresponse().status == 404  # it serves
        os.kill(running.pid, signal.SIGINT)
        out, error = running.communicate(timeout=20)
    assert (out, error, running.returncode) == ("ended\n", "", 0)


@pytest.mark.browser
def test_a_browser_opens_it_and_runs_its_script_alone(page):
    script = "document.body.dataset.seen = 'yes'"
    body = "<link rel='icon' href='data:,'><p>page</p><script src='page.js'></script>"
    routes = [text_route("/", body), text_route("/page.js", script, "text/javascript")]
    with LocalServer(routes) as server:
        page.goto(server.address)
        assert page.locator("body").get_attribute("data-seen") == "yes"
