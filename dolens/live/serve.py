"""A page is served to the browsers of this machine's user, and to nobody else.

The server listens on 127.0.0.1 alone.  Its address begins with a random token, without which
nothing answers.  Requests that name another host, as they do after DNS rebinding, and those that
come from another page are refused.  Pages may load nothing but what their own server has.
"""

import hmac
import logging
import secrets
import socket
import threading
from collections.abc import Iterable, Sequence
from http import HTTPStatus
from pathlib import Path
from typing import Self

import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from dolens.errors import InputError

_HOST = "127.0.0.1"
_TYPES = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".svg": "image/svg+xml",
    ".png": "image/png",
}
# Pictures and files to save are made by scripts, as `blob:` and `data:`.
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "content-security-policy": _POLICY,
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}
# Of a message to the server, and the seconds that it waits for answers under way when it ends.
_MOST_BYTES, _LAST_SECONDS = 1 << 20, 1


class LocalServer:
    """Serves a page on this machine until it is stopped.

    `run` serves in this thread until Ctrl-C; a `with` block serves in a thread of its own.

    Args:
        routes: what Starlette serves, with paths as `/` and `/socket`; see `text_route`.
        port: to listen on; None: a free one.

    Attributes:
        address: to open in a browser, with the token.

    Raises:
        InputError: the port is no port, or another program's.
    """

    def __init__(self, routes: Sequence[BaseRoute], port: int | None = None) -> None:
        self._socket = _listening(port)
        number = self._socket.getsockname()[1]
        token = secrets.token_urlsafe(24)
        self.address = f"http://{_HOST}:{number}/{token}/"
        self._server = uvicorn.Server(
            uvicorn.Config(
                _OnlyOwn(Starlette(routes=routes), token, number),
                log_config=None,
                access_log=False,
                lifespan="off",
                server_header=False,
                ws_max_size=_MOST_BYTES,
                ws_ping_interval=None,  # a machine may sleep
                ws_per_message_deflate=False,
                timeout_graceful_shutdown=_LAST_SECONDS,
            )
        )
        self._thread: threading.Thread | None = None

    def run(self) -> None:
        """Serve until Ctrl-C."""
        try:
            self._serve()
        except KeyboardInterrupt:
            return

    def _serve(self) -> None:
        # What it logs of a connection that broke off says nothing to a user.
        logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
        self._server.run(sockets=[self._socket])

    def __enter__(self) -> Self:
        """Serve in a thread of its own, which ends with the process at the latest.

        Connections made before it has begun wait until it has.
        """
        self._thread = threading.Thread(target=self._serve, name="dolens page", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Stop serving."""
        assert self._thread is not None
        self._server.should_exit = True
        self._thread.join()


def text_route(path: str, text: str, media_type: str = "text/html") -> Route:
    """Return the route of one text, as a page.

    Args:
        path: as `/`.
        text: the same for every request.
        media_type: of the text.
    """
    body = text.encode()

    def answer(request: Request) -> Response:
        return Response(body, media_type=media_type)

    return Route(path, answer)


def file_routes(files: Iterable[Path]) -> list[Route]:
    """Return the routes of some files by their names alone, as `/page.css`.

    Args:
        files: read once; their suffixes say what they are.
    """
    return [text_route(f"/{file.name}", file.read_text(), _TYPES[file.suffix]) for file in files]


def _listening(port: int | None) -> socket.socket:
    if port is not None and not 1 <= port <= 65535:
        raise InputError(f"--port: {port}; allowed: 1 to 65535")
    # Of a socket that does not name TCP asyncio leaves Nagle's delays on, 40 ms a message.
    found = socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        found.bind((_HOST, port or 0))
        found.listen()
    except OSError as error:
        found.close()
        raise InputError(
            f"--port: {port} cannot be used ({error.strerror}); without --port a free one is found"
        ) from None
    return found


class _OnlyOwn:
    """Lets requests pass that know the token, name this host and come from this page."""

    def __init__(self, app: ASGIApp, token: str, port: int) -> None:
        self._app, self._token = app, token
        self._hosts = {f"{host}:{port}" for host in (_HOST, "localhost")}
        self._origins = {f"http://{host}" for host in self._hosts}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""
        refused = self._refused(scope)
        if refused is not None:
            await _refuse(scope, receive, send, refused)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        await self._app({**scope, "root_path": f"/{self._token}"}, receive, with_headers)

    def _refused(self, scope: Scope) -> HTTPStatus | None:
        headers = Headers(scope=scope)
        hosts, origins = headers.getlist("host"), headers.getlist("origin")
        if len(hosts) != 1 or hosts[0].lower() not in self._hosts:
            return HTTPStatus.MISDIRECTED_REQUEST
        # Browsers always name it of websockets; a program on this machine that knows the token may.
        if any(origin.lower() not in self._origins for origin in origins):
            return HTTPStatus.FORBIDDEN
        _, token, *_ = f"{scope['path']}/".split("/")
        if not hmac.compare_digest(token.encode(errors="replace"), self._token.encode()):
            return HTTPStatus.NOT_FOUND
        return None


async def _refuse(scope: Scope, receive: Receive, send: Send, status: HTTPStatus) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close"})  # before it was accepted: 403
        return
    answer = Response(f"{status.phrase}\n", status, _HEADERS, "text/plain")
    await answer(scope, receive, send)
