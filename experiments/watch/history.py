"""The course of a run is recorded in its folder, within a bounded size, and read back as data.

`history/frames.json` has a frame for each recorded step: the values of the lens's parameters that
move, the names of pictures beside it, and for a search its best forms.  Numbers of all steps are in
`metrics.csv`.
"""

import json
import logging
import math
import re
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dolens.errors import InputError, one_line
from dolens.experiments.running.run_files import read_json
from dolens.files import written_whole

logger = logging.getLogger(__name__)

FOLDER, FILE = "history", "frames.json"
_VERSION = 1
_PICTURE = re.compile(r"\d{9}_\d{1,3}\.webp")
# Seconds between frames, frames with pictures and writes at least; and the share of a run's time
# that each of them takes at most.
_LEAST_S = {"frame": 0.05, "pictures": 1.0, "write": 1.0}
_SHARE = 0.005
# Numbers in the file at most: 1.2 MB.
_MOST_NUMBERS, _FEWEST = 60_000, 16

Values = dict[str, float | list[float]]


@dataclass
class Frame:
    """A recorded step.

    Attributes:
        step: of the optimizer, or of the search.
        seconds: since the run began, earlier tries included.
        lens: name → value of the parameters that move, in the lens's own units.
        pictures: name, as that of a photograph → label, as `sensor` → file in the folder.
        forms: of a search, the best first: merit, spots, way and prescription of each.
    """

    step: int
    seconds: float
    lens: Values = field(default_factory=dict)
    pictures: dict[str, dict[str, str]] = field(default_factory=dict)
    forms: list[dict[str, Any]] = field(default_factory=list)

    def files(self) -> set[str]:
        """Return the names of its pictures' files."""
        return {file for pictures in self.pictures.values() for file in pictures.values()}


@dataclass
class History:
    """What was recorded of a run.

    Attributes:
        frames: in the order of their steps.
        rounds: of a design: where its rounds began, and their rays were chosen.
        bounds: label of a variable → least and greatest value and unit, as files have them.
    """

    frames: list[Frame] = field(default_factory=list)
    rounds: list[Frame] = field(default_factory=list)
    bounds: dict[str, list[Any]] = field(default_factory=dict)

    def until(self, step: int) -> "History":
        """Return what was recorded up to a step."""
        kept = ([f for f in part if f.step <= step] for part in (self.frames, self.rounds))
        return History(*kept, self.bounds)


def read_history(run: Path) -> History:
    """Read the history of a run folder; an empty one where there is none.

    Raises:
        InputError: the file is damaged, or is none that `Recorder` writes; one line.
    """
    path = run / FOLDER / FILE
    found = read_json(path)
    if not found:
        return History()
    try:
        if found["version"] != _VERSION:
            raise ValueError(f"version {found['version']!r}; known: {_VERSION}")
        frames, rounds = ([_frame(entry) for entry in found[key]] for key in ("frames", "rounds"))
        bounds = {str(label): _bound(limits) for label, limits in found["bounds"].items()}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path} is no history of a run ({one_line(repr(error))})") from None
    return History(frames, rounds, bounds)


def _frame(entry: Any) -> Frame:
    given = {key: entry[key] for key in Frame.__dataclass_fields__}
    found = Frame(**given)
    if type(found.step) is not int or not 0 <= found.step < 10**9:
        raise ValueError(f"step {found.step!r}")
    found.seconds = _number(found.seconds)
    found.lens = {
        str(name): [*map(_number, value)] if isinstance(value, list) else _number(value)
        for name, value in found.lens.items()
    }
    for pictures in found.pictures.values():
        for file in pictures.values():
            if not _PICTURE.fullmatch(file):
                raise ValueError(f"picture {file!r}")
    for form in found.forms:
        _number(form["merit"])
        [*map(_number, form["spots"])]
        if not isinstance(form["lens"], dict) or not isinstance(form["way"], str):
            raise ValueError("a form without a lens")
    return found


def _number(value: Any) -> float:
    if type(value) not in (int, float) or not math.isfinite(value):
        raise ValueError(f"{value!r} is no finite number")
    return float(value)


def _bound(limits: Any) -> list[Any]:
    low, high, unit = limits
    for limit in (low, high):
        if limit is not None:
            _number(limit)
    return [low, high, str(unit)]


def _least_missed(frames: list[Frame]) -> int:
    """Return the place of the frame without which the steps have the smallest gap."""
    steps = [frame.step for frame in frames]
    gaps = [after - before for before, after in zip(steps, steps[2:], strict=False)]
    return 1 + gaps.index(min(gaps))


class Recorder:
    """Records frames of a run.

    Frames, frames with pictures and writing each take half a percent of the run's time at most:
    what costs more is done less often.  Beyond a number of frames, or of bytes of pictures, some
    are dropped, so that the others are spread over the run.  The file is written whole, or not at
    all; where it cannot be, as on a full disk, the run goes on without.

    Args:
        run: the run folder.
        most_frames: frames that are kept at most.
        most_bytes: of pictures.

    Attributes:
        history: what is recorded so far.
    """

    def __init__(self, run: Path, most_frames: int = 300, most_bytes: int = 4 << 20) -> None:
        self.folder = run / FOLDER
        self.history = History()
        self._most, self._most_bytes = most_frames, most_bytes
        self._began = time.monotonic()
        self._next = dict.fromkeys(_LEAST_S, 0.0)
        self._waits = self._failed = False

    def due(self, kind: str = "frame") -> bool:
        """Return whether it is time for a frame, or for one with `pictures`."""
        return time.monotonic() >= self._next[kind] and not self._failed

    def go_on(self, run: Path, step: int = 10**9) -> int:
        """Take up the history of a run up to a step, this one's own or another's.

        Returns:
            The last step that is recorded; 0 where there is none.
        """
        try:
            self.history = read_history(run).until(step)
            for file in {f for frame in self.history.frames for f in frame.files()}:
                if run / FOLDER != self.folder:
                    self._write_file(file, (run / FOLDER / file).read_bytes())
        except (InputError, OSError) as problem:
            logger.warning("The history begins anew: %s", problem)
            self.history = History()
        if not self.history.frames:
            return 0
        self._began -= self.history.frames[-1].seconds
        return self.history.frames[-1].step

    def add(
        self, step: int, frame: Frame, started: float, pictures: Mapping[str, Any] | None = None
    ) -> None:
        """Record a frame, and write the file if it is time.

        Args:
            step: of the frame; one of the same step is replaced.
            frame: its step and time are set here.
            started: when the work for it began, s, as `time.monotonic` has it.
            pictures: of the frame: name → label → bytes, WebP.
        """
        frame.step, frame.seconds = step, started - self._began
        frames = self.history.frames
        if frames and frames[-1].step == step:
            last = frames.pop()
            frame.pictures = frame.pictures or last.pictures
            frame.forms = frame.forms or last.forms
        frame.pictures = {
            name: {
                label: self._picture(step, number * 8 + place, data)
                for place, (label, data) in enumerate(of_name.items())
            }
            for number, (name, of_name) in enumerate((pictures or {}).items())
        } or frame.pictures
        frames.append(frame)
        self._waits = True
        self._thin()
        self._pause("pictures" if pictures else "frame", started)
        if self.due("write"):
            self.write()

    def write(self) -> None:
        """Write what waits."""
        if not self._waits or self._failed:
            return
        started = time.monotonic()
        parts = {"frames": self.history.frames, "rounds": self.history.rounds}
        content = {name: [*map(vars, part)] for name, part in parts.items()}
        content |= {"version": _VERSION, "bounds": self.history.bounds}
        try:
            self.folder.mkdir(exist_ok=True)
            text = json.dumps(content, separators=(",", ":"), allow_nan=False)
            with written_whole(self.folder / FILE) as aside:
                aside.write_text(text, encoding="utf-8")
            self._drop_others()
        except (OSError, ValueError) as problem:
            self._fail(problem)
        self._waits = False
        self._pause("write", started)

    def _pause(self, kind: str, started: float) -> None:
        now = time.monotonic()
        self._next[kind] = now + max(_LEAST_S[kind], (now - started) / _SHARE)

    def _picture(self, step: int, number: int, data: bytes) -> str:
        name = f"{step:09d}_{number}.webp"
        try:
            self._write_file(name, data)
        except OSError as problem:
            self._fail(problem)
        return name

    def _write_file(self, name: str, data: bytes) -> None:
        self.folder.mkdir(exist_ok=True)
        with written_whole(self.folder / name) as aside:
            aside.write_bytes(data)

    def _fail(self, problem: object) -> None:
        if not self._failed:
            logger.error("No more is recorded in %s: %s", self.folder, problem)
        self._failed = True

    def _thin(self) -> None:
        """Drop frames, or their pictures, where there are too many: those that leave least gaps."""
        frames = self.history.frames
        numbers = len(json.dumps(frames[-1].forms)) / 20 if frames[-1].forms else 0
        numbers += sum(len(v) if isinstance(v, list) else 1 for v in frames[-1].lens.values())
        most = min(self._most, max(_FEWEST, int(_MOST_NUMBERS / max(numbers, 1))))
        while len(frames) > most:
            del frames[_least_missed(frames)]
        shown = [frame for frame in frames if frame.pictures]
        while len(shown) > 2 and self._bytes() > self._most_bytes:
            shown.pop(_least_missed(shown)).pictures = {}
        self.history.rounds = self.history.rounds[-most:]

    def _bytes(self) -> int:
        files = {file for frame in self.history.frames for file in frame.files()}
        with suppress(OSError):
            return sum((self.folder / file).stat().st_size for file in files)
        return 0

    def _drop_others(self) -> None:
        """Delete pictures that no frame has any more."""
        kept = {file for frame in self.history.frames for file in frame.files()}
        for path in self.folder.glob("*.webp*"):
            if path.name not in kept:
                path.unlink(missing_ok=True)
