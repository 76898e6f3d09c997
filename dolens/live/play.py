"""A lens whose numbers are changed by hand: what may be changed, its history, and files of it."""

import base64
import copy
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch

from dolens.analysis.conditions import conditions
from dolens.errors import InputError, check_choice
from dolens.live.draft import Draft, section_profiles
from dolens.live.play_controls import (
    F_NUMBER,
    FIELD,
    PUPIL,
    SENSOR,
    TEMPERATURE,
    WIDEST,
    Value,
    controls_of,
    farthest_field,
    values_of,
)
from dolens.optics.field_and_aperture import with_aperture
from dolens.optics.lens import Lens
from dolens.optics.materials import is_glass
from dolens.plotting.section import Profile
from dolens.prescriptions.build import lens_from_prescription, prescription_of
from dolens.prescriptions.conversion import converted
from dolens.prescriptions.lens_formats import WRITTEN_SUFFIXES
from dolens.prescriptions.numbers import curvature_row, radius_key

ITERATIONS = 20
_WHERE = "lens"
_UNDONE = 500


@dataclass(frozen=True)
class State:
    """A lens as it is played with, a step of its history.

    Attributes:
        prescription: plain data; never changed in place.
        field: what its fields are multiplied by.
        temperature: °C, that it is looked at; None: its own.
    """

    prescription: dict[str, Any]
    field: float = 1.0
    temperature: float | None = None


@dataclass(frozen=True)
class Seen:
    """A state with the lens that it makes, and its rays.

    Attributes:
        state: this step.
        lens: at its own temperature.
        draft: its rays, at the temperature that it is looked at.
        profiles: of its surfaces.
    """

    state: State
    lens: Lens
    draft: Draft
    profiles: list[Profile]


class PlayedLens:
    """A lens, what of it may be changed, and all that was done to it.

    A change that makes no lens raises `InputError`, and the lens stays as it was.

    Args:
        lens: as it is at first; of one state.
        name: of its file, for files to save.

    Attributes:
        seen: the lens as it is now.
        focus: whether the sensor follows the best focus at each change.

    Raises:
        InputError: the lens cannot be played with; one line that says why.
    """

    def __init__(self, lens: Lens, name: str) -> None:
        self.name, self.focus = name, False
        self._where = conditions(lens)
        if lens.fields is not None and lens.fields.from_the_side:
            raise InputError(f"{name}: light comes from the side; sliders are for lenses in front")
        start = State(prescription_of(lens))
        self.seen, problems = self._made(start, False)
        self._at_first = {_without_number(text) for text in problems}
        self._done, self._undone = [start], list[State]()
        self.controls = controls_of(self.seen.lens, start.prescription, self._where)
        self._keys = [control["key"] for control in self.controls]

    # ---------------------------------------------------------------- changes

    def change(self, changes: Mapping[str, Value], done: bool = True) -> None:
        """Change some values.

        Args:
            changes: key of a control → number or glass; `surfaces.N.radius` is known too.
            done: whether this is a step that `undo` goes back to.

        Raises:
            InputError: an unknown key, a value that is none, or no lens comes of it.
        """
        state = self.seen.state
        for key, value in changes.items():
            state = self._changed(state, key, value)
        self._take(state, done)

    def _take(self, state: State, done: bool) -> None:
        seen, problems = self._made(state, self.focus)
        for text in problems:
            if _without_number(text) not in self._at_first:
                raise InputError(text)
        self.seen = seen
        if done and self._done[-1] != seen.state:
            self._done = [*self._done, seen.state][-_UNDONE:]
            self._undone = []

    def undo(self) -> None:
        """Go back one step, if there is one."""
        if len(self._done) > 1:
            self._undone.append(self._done.pop())
        self.seen = self._made(self._done[-1], False)[0]

    def redo(self) -> None:
        """Take back what `undo` did last."""
        if self._undone:
            self._done.append(self._undone.pop())
            self.seen = self._made(self._done[-1], False)[0]

    def reset(self) -> None:
        """Go back to the lens of the file, as a step that can be undone."""
        self._take(self._done[0], True)

    def refocus(self) -> None:
        """Put the sensor where the mean square of all spots is least."""
        seen, _ = self._made(self.seen.state, True)
        self._take(seen.state, True)

    @property
    def steps(self) -> tuple[int, int]:
        """Return how many steps can be undone, and how many redone."""
        return len(self._done) - 1, len(self._undone)

    def optimized(self, variables: Sequence[str], keep_efl: bool) -> tuple[State, str]:
        """Return a state with smaller spots and what was done, in words; this lens stays as it is.

        Args:
            variables: keys of controls: curvatures, gaps, aspheric terms.
            keep_efl: whether to keep the focal length.

        Raises:
            InputError: there are no variables, or the search cannot begin.
        """
        allowed = [control["key"] for control in self.controls if control["varies"]]
        for key in variables:
            check_choice(key, allowed, "variables")
        if not variables:
            raise InputError("optimize: tick the values that may change")
        seen = self.seen
        where = seen.draft.where
        keep = {}
        if keep_efl:
            first = seen.lens.first_order(where.reference_wavelength, where.object_distance)
            keep["efl"] = float(first.efl)
        lens = lens_from_prescription(seen.state.prescription, where=_WHERE)
        better = lens.optimize(  # type: ignore[operator]
            list(variables), keep=keep, iterations=ITERATIONS, fields=where.fields.tolist()
        )
        said = better.optimization.heading.partition(": ")[2]
        return replace(seen.state, prescription=prescription_of(better)), said

    def take(self, state: State) -> None:
        """Take a state that `optimized` returned, as a step."""
        self._take(state, True)

    # ---------------------------------------------------------------- what it is

    def values(self) -> dict[str, Value]:
        """Return the value of every control."""
        lens, state, first = self.seen.lens, self.seen.state, self.seen.draft.first
        if state.temperature is not None:
            where = self._where
            first = lens.first_order(where.reference_wavelength, where.object_distance, "y")
        return values_of(lens, first, self._where, state.field, state.temperature, self._keys)

    def saved(self, suffix: str) -> dict[str, Any]:
        """Return a file of the lens in a format: its name, its bytes in base 64, and what the
        format could not hold, a sentence each.

        Raises:
            InputError: an unknown suffix, or the format cannot hold the lens.
        """
        check_choice(suffix, WRITTEN_SUFFIXES, "save")
        state = self.seen.state
        prescription = copy.deepcopy(state.prescription)
        if state.field != 1.0:
            kind = "angles" if self._where.object_distance is None else "heights"
            row = prescription.get("fields")
            own = {key: value for key, value in (row or {}).items() if key == "weights"}
            points = (self._where.fields * state.field).tolist()
            prescription["fields"] = {kind: points, **own}
        name = f"{self.name}{suffix}"
        found = converted(prescription, _WHERE, name)
        data = base64.b64encode(found.data).decode("ascii")
        return {"name": name, "data": data, "changes": found.changes}

    # ---------------------------------------------------------------- how it is made

    def _changed(self, state: State, key: str, value: Value) -> State:
        parts = key.split(".")
        is_radius = parts[0] == "surfaces" and parts[-1].startswith("radius")
        named = key.replace(".radius", ".curvature") if is_radius else key
        check_choice(named, self._keys, "change")
        if parts[-1] == "material":
            if not isinstance(value, str):
                raise InputError(f"{key}: must be the name of a glass, not {value!r}")
            return replace(state, prescription=_with(state.prescription, key, value.strip()))
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(f"{key}: must be a number, not {value!r}")
        try:
            number = float(value)
        except OverflowError:  # of an integer
            number = math.nan
        if not (math.isfinite(number) or (is_radius and math.isinf(number))):
            raise InputError(f"{key}: must be finite")
        if key == FIELD:
            farthest = farthest_field(self._where)
            if not 0.0 <= number <= (WIDEST if self._where.object_distance is None else math.inf):
                raise InputError(f"field: {number:g}; allowed: 0 to {WIDEST:g}")
            return replace(state, field=number / farthest)
        if key == TEMPERATURE:
            return replace(state, temperature=number)
        if key in (F_NUMBER, PUPIL):
            wanted = {key if key == F_NUMBER else "entrance_pupil_diameter": number}
            lens = lens_from_prescription(state.prescription, where=_WHERE)
            return replace(state, prescription=prescription_of(with_aperture(lens, **wanted)))
        return replace(state, prescription=_with(state.prescription, key, number))

    @torch.no_grad()
    def _made(self, state: State, focus: bool) -> tuple[Seen, list[str]]:
        """Return a state with its rays, at its best focus if asked for, and what of it is no lens
        that can be made, a sentence each.

        Raises:
            InputError: it is none, or no light passes.
        """
        lens = lens_from_prescription(state.prescription, where=_WHERE).requires_grad_(False)
        there = _at(lens, state.temperature)
        where = replace(self._where, fields=self._where.fields * state.field)
        draft = Draft(there, where)
        draft.check()
        if focus and abs(draft.focus_shift) > 0.0:
            distance = float(lens.sensor_distance) + draft.focus_shift
            if not distance * float(lens.sensor_distance) >= 0.0:
                raise InputError("the best focus lies inside of the lens")
            prescription = _with(state.prescription, SENSOR, distance)
            return self._made(replace(state, prescription=prescription), False)
        profiles = section_profiles(there.system())
        return Seen(state, lens, draft, profiles), list(_impossible(there, profiles))


def _at(lens: Lens, temperature: float | None) -> Lens:
    if temperature is None:
        return lens
    with _silent("dolens.optics.thermal_lens"):  # what lacks data has no control
        return lens.at(temperature)


@contextmanager
def _silent(name: str) -> Iterator[None]:
    logger = logging.getLogger(name)
    before = logger.disabled
    logger.disabled = True
    try:
        yield
    finally:
        logger.disabled = before


def _with(prescription: dict[str, Any], key: str, value: Value) -> dict[str, Any]:
    """Return a prescription with another value."""
    found, is_radius = dict(prescription), ".radius" in key
    if key == SENSOR:
        found["sensor"] = {**prescription["sensor"], "distance": value}
        return found
    _, number, *rest = key.split(".")
    name = rest[0] if rest else "thickness"
    row = dict(prescription["surfaces"][number])
    if name.startswith(("radius", "curvature")):
        name = name.replace("radius", "curvature")
        for one in (name, radius_key(name)):
            row.pop(one, None)
        row |= {radius_key(name): value} if is_radius else curvature_row(name, float(value))
    else:
        row[name] = value
    found["surfaces"] = {**prescription["surfaces"], number: row}
    return found


def _impossible(lens: Lens, profiles: Sequence[Profile]) -> Iterator[str]:
    """Yield a sentence for each glass that ends before it begins, and for air on the axis."""
    system = lens.system()
    if system.breaks or system.mirrors:
        return
    for number, other in system.neighbours:
        gap = float(system.thicknesses[number - 1])
        glass = is_glass(system.materials[number])
        what = "glass" if glass else "air"
        if gap < 0.0:
            yield f"the {what} behind surface {number} has a negative thickness ({gap:.3g} mm)"
        front, back = profiles[number - 1], profiles[other - 1]
        if glass and gap >= 0.0 and len(front[0]) and len(back[0]):
            edge = min(float(back[0][end] - front[0][end]) for end in (0, -1))
            if edge < 0.0:
                yield f"the glass behind surface {number} has a negative edge ({edge:.3g} mm)"


def _without_number(text: str) -> str:
    return text.partition(" (")[0]
