"""The page of a run is served on this machine, from the files of its folder alone."""

import os
import time
from collections.abc import Callable
from pathlib import Path

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from dolens.errors import InputError
from dolens.experiments.watch.run_page import RunPage
from dolens.live.serve import LocalServer, file_routes, text_route
from dolens.photograph_page import page as photograph_page

_HERE = Path(__file__).parent
_SHARED = Path(photograph_page.__file__).parent


class WatchServer:
    """Serves the page of a run.

    Args:
        run: the run folder.
        port: to listen on; None: a free one.

    Attributes:
        address: to open in a browser.

    Raises:
        InputError: the folder is none of a run, or the port cannot be used.
    """

    def __init__(self, run: Path, port: int | None = None) -> None:
        self._page = RunPage(run)
        self._looked = time.monotonic()
        files = [_HERE / "watch.css", _HERE / "watch.js"]
        files += [_SHARED / name for name in ("page.css", "comparison.css", "comparison.js")]
        routes = [
            text_route("/", (_HERE / "watch.html").read_text(encoding="utf-8")),
            *file_routes(files),
            Route("/state", self._state),
            Route("/frame/{number:int}", self._frame),
            Route("/picture/{name}", self._file(self._page.picture, "image/webp")),
            Route("/figure/{name}", self._file(self._page.figure, "image/png")),
        ]
        self.server = LocalServer(routes, port)
        self.address = self.server.address

    def run(self, idle_s: float | None = None) -> None:
        """Serve until Ctrl-C, or until the run has ended and nobody has looked for some time.

        Args:
            idle_s: seconds; None: until Ctrl-C.
        """
        if idle_s is None:
            self.server.run()
            return
        os.nice(5)  # the run has the first claim to the processors
        with self.server:
            while not (time.monotonic() - self._looked > idle_s and self._page.ended):
                time.sleep(min(1.0, idle_s))

    # Functions, not coroutines: Starlette runs them in threads, where reading may take its time.

    def _state(self, request: Request) -> Response:
        self._looked = time.monotonic()
        found = self._page.state()
        if request.query_params.get("seen") == found["version"]:
            return Response(status_code=204)
        return JSONResponse(found)

    def _frame(self, request: Request) -> Response:
        self._looked = time.monotonic()
        try:
            return JSONResponse(self._page.frame(request.path_params["number"]))
        except InputError as problem:
            return Response(str(problem), 404)

    def _file(self, read: Callable[[str], bytes], kind: str) -> Callable[[Request], Response]:
        def answer(request: Request) -> Response:
            try:
                return Response(read(request.path_params["name"]), media_type=kind)
            except InputError as problem:
                return Response(str(problem), 404)

        return answer
