"""What a run folder says of its run, as plain data for a page: status, curves, figures, history.

Everything is read again when its file has changed; a folder from a stranger is data.
"""

import csv
import json
import math
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

from dolens.errors import InputError, one_line
from dolens.experiments.running.run_files import (
    HYDRA,
    INFO,
    METRICS,
    info_of,
    job_of,
    metrics_of,
)
from dolens.experiments.watch.history import FILE, FOLDER, History, read_history
from dolens.files import read_file

if TYPE_CHECKING:
    from dolens.experiments.watch.lens_frames import LensFrames

TABLE = "metrics.csv"
_MOST_BYTES = 64_000_000
# Points of a curve, curves of a plot, and forms of a search.
_POINTS, _CURVES, _FORMS = 400, 8, 6
# Seconds without a sign of life.
_SILENT_S = 120.0
# Title, unit, whether it is logarithmic, and the columns with what a curve is called.
_PLOTS: tuple[tuple[str, str, bool, str], ...] = (
    ("Merit", "", True, r"((?:train|val)/merit)"),
    ("RMS spots", "µm", True, r"spot_um/(.*)"),
    ("Operands' share of the merit", "", True, r"merit/(.*)"),
    ("Loss", "", True, r"((?:train|val)/loss)"),
    ("PSNR, restored", "dB", False, r"val/psnr_db/(.*)"),
    ("PSNR, sensor", "dB", False, r"val/raw_psnr_db/(.*)"),
)
_BEST = "Mean RMS spot of the best forms"
_FIGURE = re.compile(r"[\w.+-]{1,100}\.png", re.ASCII)


class RunPage:
    """Looks at a run folder for a page.

    Args:
        run: the folder.

    Raises:
        InputError: it is no run folder.
    """

    def __init__(self, run: Path) -> None:
        if not any((run / name).exists() for name in (INFO, METRICS, HYDRA, TABLE, FOLDER)):
            raise InputError(f"{run}: is no run folder")
        self.run = run
        self._lock = Lock()
        self._kept: dict[str, tuple[Any, Any]] = {}
        self._shown: dict[str, dict[str, Any]] = {}

    def state(self) -> dict[str, Any]:
        """Return what the page shows whatever step it looks at, with a `version` that changes with
        it; what cannot be read is among its `problems`.
        """
        problems: list[str] = []
        info = self._read(INFO, info_of, {}, problems)
        history = self._history(problems)
        status, detail = self._status(info)
        found = {
            "name": self.run.name,
            "experiment": self._experiment(problems),
            "status": status,
            "detail": detail,
            "frames": [
                {"step": f.step, "seconds": round(f.seconds, 2), "pictures": f.pictures}
                for f in history.frames
            ],
            "kind": _kind(history),
            "plots": [*self._read(TABLE, self._plots, [], problems), *_best(history)],
            "metrics": self._read(METRICS, metrics_of, {}, problems),
            "figures": self._figures(),
            "problems": problems,
        }
        if not history.frames:
            found["note"] = "This run has no history of its lens or photographs: " + (
                "none was recorded."
                if status != "running"
                else "none is recorded yet, or its experiment records none."
            )
        found["version"] = str(hash(json.dumps(found, sort_keys=True)))
        return found

    def frame(self, number: int) -> dict[str, Any]:
        """Return what the page shows of a frame, computed once.

        Raises:
            InputError: there is no such frame.
        """
        history = self._history([])
        if not 0 <= number < len(history.frames):
            raise InputError(f"there is no frame {number}")
        frame = history.frames[number]
        key = json.dumps([frame.step, frame.lens, [form["merit"] for form in frame.forms]])
        with self._lock:  # PyTorch's threads are those of one frame at a time
            if key not in self._shown:
                if len(self._shown) > 600:
                    self._shown.clear()
                self._shown[key] = self._made(history, number)
            return self._shown[key]

    def _made(self, history: History, number: int) -> dict[str, Any]:
        # The address is there before all that draws a lens is loaded.
        from dolens.experiments.watch.lens_frames import form_section

        frame = history.frames[number]
        if frame.forms:
            return {
                "forms": [
                    {
                        "merit": form["merit"],
                        "spots": form["spots"],
                        "way": form["way"],
                        "section": form_section(form["lens"]),
                    }
                    for form in frame.forms[:_FORMS]
                ]
            }
        try:
            lenses = self._lenses()
        except InputError as problem:
            return {"section": str(problem), "spots": str(problem), "variables": []}
        return lenses.shown(history, frame)

    def picture(self, name: str) -> bytes:
        """Return a recorded picture, WebP.

        Raises:
            InputError: no frame has it, or it cannot be read.
        """
        if name not in {file for frame in self._history([]).frames for file in frame.files()}:
            raise InputError(f"there is no picture {name}")
        return read_file(self.run / FOLDER / name, _MOST_BYTES, "picture")

    def figure(self, name: str) -> bytes:
        """Return a figure, PNG.

        Raises:
            InputError: the run has none of this name, or it cannot be read.
        """
        if name not in self._figures():
            raise InputError(f"there is no figure {name}")
        return read_file(self.run / "figures" / name, _MOST_BYTES, "figure")

    @property
    def ended(self) -> bool:
        """Return whether the run has ended, or gives no sign of life."""
        info = self._read(INFO, info_of, {}, [])
        status, detail = self._status(info)
        return status != "running" or bool(detail)

    # ---------------------------------------------------------------- parts

    def _read(
        self, name: str, read: Callable[[Path], Any], otherwise: Any, problems: list[str]
    ) -> Any:
        """Read a file of the folder when it has changed; say why where it cannot be read."""
        path = self.run / name
        try:
            state = path.stat()
            key = state.st_mtime_ns, state.st_size
        except OSError:
            return otherwise
        if self._kept.get(name, (None,))[0] != key:
            try:
                self._kept[name] = key, read(self.run)
            except (InputError, OSError) as problem:
                self._kept[name] = key, InputError(one_line(problem))
        found = self._kept[name][1]
        if isinstance(found, InputError):
            problems.append(str(found))
            return otherwise
        return found

    def _history(self, problems: list[str]) -> History:
        return self._read(f"{FOLDER}/{FILE}", read_history, History(), problems)

    def _lenses(self) -> "LensFrames":
        from dolens.experiments.watch.lens_frames import LensFrames

        problems: list[str] = []
        found = self._read("lens/initial.yaml", LensFrames.of, None, problems)
        if found is None:
            raise InputError(problems[0] if problems else "the run has no lens/initial.yaml")
        return found

    def _experiment(self, problems: list[str]) -> str:
        job = self._read(HYDRA, job_of, None, problems)
        return str((job and job.choices.get("experiment")) or "")

    def _status(self, info: dict[str, Any]) -> tuple[str, str]:
        status = str(info.get("status", "unknown"))
        if status != "running":
            return status, str(info.get("reason", ""))
        newest = 0.0
        for name in (INFO, TABLE, f"{FOLDER}/{FILE}", "log.txt", "search"):
            path = self.run / name
            if path.exists():
                newest = max(newest, path.stat().st_mtime)
        silent = time.time() - newest
        if silent > _SILENT_S:
            return status, f"nothing was written for {silent / 60.0:.0f} min"
        return status, ""

    def _figures(self) -> list[str]:
        folder = self.run / "figures"
        try:
            names = sorted(path.name for path in folder.iterdir())
        except OSError:
            return []
        return [name for name in names if _FIGURE.fullmatch(name)][:60]

    def _plots(self, run: Path) -> list[dict[str, Any]]:
        """Return curves of the table, a plot for each kind of quantity."""
        text = read_file(run / TABLE, _MOST_BYTES, "table").decode("utf-8", "replace")
        # What is behind the last end of a line is half a row.
        rows = list(csv.reader(text.rpartition("\n")[0].splitlines()))
        if not rows or "step" not in rows[0]:
            return []
        columns = {name: n for n, name in enumerate(rows[0])}
        found = []
        for title, unit, log, pattern in _PLOTS:
            curves = {}
            for name, n in columns.items():
                called = re.fullmatch(pattern, name)
                points = list(_points(rows[1:], columns["step"], n, log)) if called else []
                if called and len(points) > 1:
                    curves[called[1]] = points
            if pattern.startswith("merit/"):  # those that cost anything, of many
                largest = sorted(curves, key=lambda name: -max(y for _, y in curves[name]))
                curves = {name: curves[name] for name in largest[:_CURVES]}
            if curves:
                found.append(_plot(title, unit, log, curves))
        return found


def _best(history: History) -> list[dict[str, Any]]:
    """Return the course of a search as plots: the merits of its best forms."""
    ranks = {
        f"form {rank + 1}": [
            (float(f.step), float(f.forms[rank]["merit"]))
            for f in history.frames
            if len(f.forms) > rank
        ]
        for rank in (0, 2, 5)
    }
    curves = {name: points for name, points in ranks.items() if len(points) > 1}
    return [_plot(_BEST, "µm", True, curves)] if curves else []


def _plot(
    title: str, unit: str, log: bool, curves: dict[str, list[tuple[float, float]]]
) -> dict[str, Any]:
    series = [{"name": name, "points": _thinned(points)} for name, points in curves.items()]
    return {"title": title, "unit": unit, "log": log, "series": series}


def _points(
    rows: list[list[str]], step: int, column: int, positive: bool
) -> Iterator[tuple[float, float]]:
    for row in rows:
        try:
            x, y = float(row[step]), float(row[column])
        except (ValueError, IndexError):
            continue
        if math.isfinite(x) and math.isfinite(y) and (y > 0.0 or not positive):
            yield x, y


def _thinned(points: list[tuple[float, float]]) -> list[list[float]]:
    """Return some of many points, the last among them, to six digits."""
    every = math.ceil(len(points) / _POINTS)
    kept = points[:: max(every, 1)]
    if kept[-1] != points[-1]:
        kept.append(points[-1])
    return [[x, float(f"{y:.6g}")] for x, y in kept]


def _kind(history: History) -> str:
    if not history.frames:
        return ""
    if history.frames[-1].forms:
        return "search"
    return "camera" if any(frame.pictures for frame in history.frames) else "design"
