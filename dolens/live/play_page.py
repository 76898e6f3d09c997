"""The page of `dolens play`: one lens, and a browser that changes it.

The browser sends what the user does as JSON over a websocket; changes that came while one was made
are joined.  The answer comes in parts, the section and the spots first; parts that a newer change
makes out of date are left out, but for a few times a second.
"""

import asyncio
import base64
import json
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from starlette.routing import BaseRoute, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from dolens.errors import InputError, check_choice, one_line
from dolens.files import installed_version
from dolens.html import rendered
from dolens.live.draft_picture import DraftCamera, picture_to_photograph
from dolens.live.play import PlayedLens
from dolens.live.play_looks import (
    blur_of,
    conditions_of,
    fans_of,
    modulation_of,
    numbers_of,
    section_of,
    spots_of,
)
from dolens.live.serve import file_routes, text_route
from dolens.optics.glass_catalog import catalogues, glass_names
from dolens.prescriptions.lens_formats import WRITTEN_SUFFIXES

_FOLDER = Path(__file__).parent
_FILES = ("play.css", "play.js", "play_views.js")
# A browser that another takes the place of, and a message that is none.
_TAKEN, _UNREADABLE = 4001, 4002
_MOST_WAITING = 100
# Seconds after which an answer is sent whole, whatever waits.
_OFTEN = 0.3
Part = Callable[[], dict[str, Any]]


class PlayPage:
    """Serves a played lens to the browser that came last.

    Args:
        lens: what is played with.
        picture: to photograph; None: one that is always there.
    """

    def __init__(self, lens: PlayedLens, picture: str | Path | None = None) -> None:
        self._lens, self._part = lens, "edge"
        self._camera: DraftCamera | str
        light = picture_to_photograph(picture)
        try:
            self._camera = DraftCamera.of(lens.seen.draft.lens, blur_of(lens.seen), light)
        except InputError as problem:
            self._camera = str(problem)
        # One thread makes everything of the lens; another optimizes a copy of it.
        self._worker = ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(1,))
        self._optimizer = ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(1,))
        self._current: WebSocket | None = None

    def routes(self) -> list[BaseRoute]:
        """Return the page, its files and its websocket."""
        shared = Path(__file__).parents[1] / "lens_page"
        page = rendered(
            _FOLDER / "play.html",
            shared,
            title=self._lens.seen.lens.name or self._lens.name,
            suffixes=WRITTEN_SUFFIXES,
            version=installed_version("dolens") or "",
        )
        return [
            text_route("/", page),
            *file_routes([shared / "page.css", *(_FOLDER / name for name in _FILES)]),
            WebSocketRoute("/socket", self._serve),
        ]

    async def _serve(self, socket: WebSocket) -> None:
        await socket.accept()
        before, self._current = self._current, socket
        if before is not None:
            with suppress(RuntimeError, WebSocketDisconnect):  # it has gone by itself
                await before.close(_TAKEN, "opened in another window")
        session = _Session(self, socket)
        with suppress(WebSocketDisconnect):
            await session.run()
        if self._current is socket:
            self._current = None

    # ---------------------------------------------------------------- in the thread of the lens

    def everything(self) -> dict[str, Any]:
        """Return what a browser must know before all else."""
        glasses = [f"{maker}:{name}" for maker in catalogues() for name in glass_names(maker)]
        return {
            "is": "lens",
            "controls": self._lens.controls,
            "glasses": glasses,
            "focus": self._lens.focus,
            "part": self._part,
        }

    def do(self, message: Mapping[str, Any]) -> dict[str, Any] | None:
        """Do what a message asks for, and return an answer of its own, if it has one.

        Raises:
            InputError: it cannot be done.
        """
        lens, what = self._lens, str(message.get("do"))
        if what == "change":
            changes = message.get("changes")
            if not isinstance(changes, Mapping):
                raise InputError("change: 'changes' must be keys with values")
            lens.change(changes, bool(message.get("done")))
        elif what in ("undo", "redo", "reset", "refocus"):
            getattr(lens, what)()
        elif what == "focus":
            lens.focus = bool(message.get("on"))
            if lens.focus:
                lens.refocus()
        elif what == "part":
            if not isinstance(self._camera, str):
                check_choice(message.get("part"), self._camera.parts, "part")
                self._part = str(message["part"])
        elif what == "save":
            return {"is": "saved", **lens.saved(str(message.get("suffix")))}
        elif what != "look":
            raise InputError(f"do: '{what[:40]}' is unknown")
        return None

    def parts(self) -> list[Part]:
        """Return what makes the parts of an answer, in their order."""
        return [self._first, self._modulation, self._picture]

    def _first(self) -> dict[str, Any]:
        seen, (undo, redo) = self._lens.seen, self._lens.steps
        return {
            "is": "seen",
            "values": self._lens.values(),
            "undo": undo,
            "redo": redo,
            "where": conditions_of(seen),
            "numbers": numbers_of(seen),
            "section": section_of(seen),
            "spots": spots_of(seen),
        }

    def _modulation(self) -> dict[str, Any]:
        return {"is": "mtf", **modulation_of(self._lens.seen), "fans": fans_of(self._lens.seen)}

    def _picture(self) -> dict[str, Any]:
        seen = self._lens.seen
        if isinstance(self._camera, str):
            return {"is": "picture", "problem": self._camera}
        try:
            data = self._camera.photograph(seen.draft.lens, self._part, blur_of(seen))
        except InputError as problem:
            return {"is": "picture", "problem": str(problem)}
        sensor = self._camera.parts[self._part]
        width, height = (n * sensor.pixel_pitch for n in (sensor.width, sensor.height))
        return {
            "is": "picture",
            "jpeg": base64.b64encode(data).decode("ascii"),
            "size": f"{width:.3g} × {height:.3g} mm of the sensor, pixels of "
            f"{1e3 * sensor.pixel_pitch:.3g} µm",
        }

    async def optimize(self, message: Mapping[str, Any]) -> dict[str, Any]:
        """Optimize a copy of the lens, and take it unless the lens was changed meanwhile."""
        loop = asyncio.get_running_loop()
        given = message.get("variables")
        variables = [str(key) for key in given] if isinstance(given, list) else []
        before = self._lens.seen.state
        efl = bool(message.get("efl"))
        state, said = await loop.run_in_executor(
            self._optimizer, self._lens.optimized, variables, efl
        )
        if self._lens.seen.state is not before:
            return {"is": "optimized", "text": "the lens was changed meanwhile: not taken"}
        await loop.run_in_executor(self._worker, self._lens.take, state)
        return {"is": "optimized", "text": said}

    async def made(self, make: Callable[..., Any], *arguments: Any) -> Any:
        """Run something in the thread of the lens."""
        return await asyncio.get_running_loop().run_in_executor(self._worker, make, *arguments)


class _Session:
    """One browser's messages, and the answers to them."""

    def __init__(self, page: PlayPage, socket: WebSocket) -> None:
        self._page, self._socket = page, socket
        self._waiting: list[dict[str, Any]] = [{"do": "look"}]
        self._came = asyncio.Event()
        self._whole = 0.0  # when the last whole answer was sent
        self._tasks: set[asyncio.Task[None]] = set()

    async def run(self) -> None:
        await self._send(await self._page.made(self._page.everything))
        self._came.set()
        answering = asyncio.create_task(self._answer())
        try:
            while True:
                self._receive(await self._socket.receive_text())
        finally:
            tasks = [answering, *self._tasks]
            for task in tasks:
                task.cancel()
            # A browser that has gone takes no answer, and nobody asks why.
            await asyncio.gather(*tasks, return_exceptions=True)

    def _receive(self, text: str) -> None:
        try:
            message = json.loads(text)
        except (ValueError, RecursionError):
            message = None
        if not isinstance(message, dict) or len(self._waiting) >= _MOST_WAITING:
            raise WebSocketDisconnect(_UNREADABLE)
        last = self._waiting[-1] if self._waiting else {}
        if message.get("do") == "optimize":
            task = asyncio.create_task(self._optimized(message))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
        elif (
            message.get("do") == last.get("do") == "change"
            and not last.get("done")
            and isinstance(message.get("changes"), dict)
            and isinstance(last.get("changes"), dict)
        ):
            self._waiting[-1] = {**message, "changes": {**last["changes"], **message["changes"]}}
        else:
            self._waiting.append(message)
        self._came.set()

    async def _answer(self) -> None:
        while True:
            await self._came.wait()
            self._came.clear()
            while self._waiting:
                await self._do(self._waiting.pop(0))

    async def _do(self, message: dict[str, Any]) -> None:
        number, started = message.get("id"), time.perf_counter()
        try:
            answer = await self._page.made(self._page.do, message)
            if answer is not None:
                await self._send({**answer, "id": number})
                return
            for make in self._page.parts():
                part = await self._page.made(make)
                took = round(1e3 * (time.perf_counter() - started), 1)
                await self._send({**part, "id": number, "ms": took})
                started = time.perf_counter()
                if self._waiting and started - self._whole < _OFTEN:
                    return
            self._whole = time.perf_counter()
        except Exception as problem:
            await self._send({"is": "problem", "id": number, "text": _said(problem)})

    async def _optimized(self, message: dict[str, Any]) -> None:
        try:
            await self._send(await self._page.optimize(message))
        except Exception as problem:
            await self._send({"is": "optimized", "text": _said(problem), "failed": True})
        self._waiting.append({"do": "look"})
        self._came.set()

    async def _send(self, message: dict[str, Any]) -> None:
        await self._socket.send_text(json.dumps(message, allow_nan=False))


def _said(problem: Exception) -> str:
    """Return what a browser shows of a problem: the page goes on after a defect too."""
    if isinstance(problem, WebSocketDisconnect):
        raise problem
    kind = (
        "" if isinstance(problem, InputError) else f"defect of dolens: {type(problem).__name__}: "
    )
    return kind + one_line(problem)
