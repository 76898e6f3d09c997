"""A TYPE of surface in a Zemax `.zmx` file is a row of a table, which drives reader and writer.

CURV and CONI are a surface's base.  Further numbers stand behind `PARM n` and `XDAT n`: the table
of a TYPE says which key of a prescription's row each of them is, and in which power of the file's
unit.  A list of terms in XDAT has its length in front, and then the radius that coordinates are
divided by.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import islice
from typing import Any, NamedTuple

from dolens.errors import InputError
from dolens.prescriptions.numbers import (
    as_integer,
    as_number,
    curvature_in_text,
    number_in_text,
    radius_row,
    reciprocal,
    shifted,
)
from dolens.prescriptions.other_programs import Number, Table, row_numbers, slot_values
from dolens.prescriptions.zemax.file import NAMED_ZERO, SurfaceBlock

Row = dict[str, Any]

# Rules of numbers: a radius of normalization, an order of diffraction, and one that is not 0.
RADIUS, ORDER, ORDER_BUT_0 = "radius", "order", "order but 0"


class Base(NamedTuple):
    """A `Base` is what CURV and CONI are: read as keys of a row, and written as lines."""

    read: Callable[[SurfaceBlock], Row]
    write: Callable[[Mapping[str, Any], str], list[str]]


NOTHING = Base(lambda block: {}, lambda row, place: [])


@dataclass(frozen=True)
class ZemaxShape:
    """A `ZemaxShape` is a TYPE of surface that a prescription holds.

    Attributes:
        type: the word behind TYPE.
        kinds: the types of a prescription's rows that are written as this TYPE.
        base: what CURV and CONI are.
        numbers: slot (`PARM 2`) → key of the row, or of its phase.
        terms: the same for the terms of a list in XDAT.
        kind: the type of a row that is read, where it is not the first of the kinds.
        phase: type of the phase that numbers and terms are about; a row must have it to be written
            as this TYPE, and none where it is empty.
        count: the number of XDAT that says how many terms there are; the next one is the radius of
            normalization.
        scales: whether terms are lengths, of coordinates divided by that radius, and a row's keys
            of coordinates in mm.
        extrapolates: the number of PARM that says whether terms go on beyond that radius.
        filled: whether what a row does not have is written as 0, up to the last term.
        fixed: slot → text that is always written.
        refused: slots, or PARM or XDAT for all others, which must be 0 → what they are about.
        others: the same of those that the base has, or that mean nothing.
        surface: whether light meets a surface there, which has a medium behind it and an aperture;
            a change of axes has a gap only.
        own_read: block → row, where the table alone (`by_table`) does not say it.
        own_write: row and its name in messages → lines, likewise (`lines`).
    """

    type: str
    kinds: tuple[str, ...] = ()
    base: Base = NOTHING
    numbers: Table = field(default_factory=dict)
    terms: Table = field(default_factory=dict)
    kind: str = ""
    phase: str = ""
    count: int = 1
    scales: bool = False
    extrapolates: int | None = None
    filled: bool = False
    fixed: Mapping[str, str] = field(default_factory=dict)
    refused: Mapping[str, str] = field(default_factory=dict)
    others: tuple[str, ...] = ()
    surface: bool = True
    own_read: Callable[["ZemaxShape", SurfaceBlock], Row] | None = None
    own_write: Callable[["ZemaxShape", Mapping[str, Any], str], list[str]] | None = None

    def read(self, block: SurfaceBlock) -> Row:
        """Return the `type` and the keys of the shape that a surface's block has, in mm.

        Raises:
            InputError: a number is missing, or no row can have it.
        """
        return (self.own_read or ZemaxShape.by_table)(self, block)

    def write(self, row: Mapping[str, Any], place: str) -> list[str]:
        """Return the lines of the shape without TYPE, such as `CURV 0.02` and `PARM 2 1e-6`, in mm.

        The writer reads all lines back and compares, so that what has no line is refused there.

        Raises:
            InputError: the file has no slot for a coefficient.
        """
        return (self.own_write or ZemaxShape.lines)(self, row, place)

    def require_held(self, block: SurfaceBlock) -> None:
        """Refuse numbers in slots that the shape does not have, or that no row holds."""
        held = {*self.numbers, *self.terms, *self.fixed}
        if self.terms:
            held |= {f"XDAT {self.count}", f"XDAT {self.count + 1}"}
        for slot, word in block.slots.items():
            operand = slot[:4]
            if slot in held or float(word) == 0.0:
                continue
            if slot in self.others and slot not in self.refused:
                continue
            if slot in self.refused or operand in self.refused:
                what = self.refused.get(slot) or self.refused[operand]
                raise InputError(f"{block.place}: {what} ({slot}: {word})")
            if operand in self.others:
                continue
            allowed = sorted(
                int(one[5:])
                for one in (*held, *self.others, *self.refused)
                if one[:5] == f"{operand} "
            )
            has = f"{operand} {allowed[0]} to {allowed[-1]}" if allowed else "none"
            raise InputError(f"{block.place}: {slot} is {word}, but TYPE {self.type} has {has}")

    def by_table(self, block: SurfaceBlock) -> Row:
        """Return the row of a block as base and table have it."""
        base = {"type": self.kind or self.kinds[0]} | self.base.read(block)
        terms, radius = self._terms(block)
        found = row_numbers(
            {**self.numbers, **terms},
            block.slots,
            block.factor,
            block.place,
            named,
            dict.fromkeys(terms, radius) if radius and self.scales else None,
        )
        for one, number in self.numbers.items():
            if number.rule in (ORDER, ORDER_BUT_0):
                found[number.key] = _order(block, one, number.rule == ORDER)
        if self.extrapolates is not None and radius:
            self._require_inside(block, found)
        if not self.phase:
            return base | found
        if self.terms and not terms:
            found["norm_radius"] = 1.0
        return base | {"phase": {"type": self.phase, "order": found["order"], **found}}

    def lines(self, row: Mapping[str, Any], place: str) -> list[str]:
        """Return the lines of a row as base and table have them."""
        own, what = (row["phase"], f"{place}: phase") if self.phase else (row, place)
        values = slot_values({**self.numbers, **self.terms}, own, what, ".zmx")
        count = max((n for n, slot in enumerate(self.terms, 1) if slot in values), default=0)
        table = {**self.numbers, **dict(islice(self.terms.items(), count))}
        texts = {
            slot: _text(values.get(slot), table[slot], f"{what}: '{table[slot].key}'")
            for slot in (table if self.filled else values)
        }
        texts |= self.fixed
        if self.terms:
            texts[f"XDAT {self.count}"] = str(count)
        ordered = sorted(texts, key=lambda slot: (slot[:4], int(slot[5:]) if slot[0] == "X" else 0))
        return [*self.base.write(row, place), *(f"{slot} {texts[slot]}" for slot in ordered)]

    def _terms(self, block: SurfaceBlock) -> tuple[Table, Fraction | None]:
        """Return the terms that a block has, and the radius of normalization in the file's unit:
        None where nothing is divided by it, and none need be given.
        """
        if not self.terms:
            return {}, None
        count = _number_of_terms(block, self.count, len(self.terms))
        terms = dict(islice(self.terms.items(), count))
        slot = f"XDAT {self.count + 1}"
        of_sag = slot in self.numbers and not self.phase
        some = any(named(block.slots.get(term, "0")) for term in terms)
        if not (of_sag or some or (self.phase and terms)):
            return terms, None
        word = block.slots.get(slot, self.fixed.get(slot, "0"))
        if not number_in_text(word, f"{block.place}: {slot}") > 0.0:
            what = "the normalization radius" if of_sag else "the radius of normalization"
            raise InputError(f"{block.place}: {slot}, {what}, must be positive, not {word}")
        return terms, Fraction(word)

    def _require_inside(self, block: SurfaceBlock, found: Mapping[str, float]) -> None:
        """Refuse polynomials that end within the aperture."""
        radius = found.get("normalization_radius", found.get("norm_radius", math.inf))
        center = math.hypot(found.get("decenter_x", 0.0), found.get("decenter_y", 0.0))
        reach = block.length("DIAM") + center
        if block.slot(f"PARM {self.extrapolates}") == 0.0 and reach > radius * (1.0 + 1e-9):
            raise InputError(
                f"{block.place}: the aperture reaches {reach:g} mm from the centre of the disc of "
                f"the Zernike polynomials, which ends at {radius:g} mm (XDAT {self.count + 1}) as "
                f"PARM {self.extrapolates} (extrapolate) is 0"
            )


def _number_of_terms(block: SurfaceBlock, place: int, most: int) -> int:
    """Return a number of terms in XDAT.

    Raises:
        InputError: it is no whole number from 0 to `most`.
    """
    slot = f"XDAT {place}"
    count = block.slot(slot)
    if not (0 <= count <= most and count == int(count)):
        raise InputError(
            f"{block.place}: {slot} must be a number of terms from 0 to {most}, not "
            f"{block.slots[slot]}"
        )
    return int(count)


def named(word: str) -> bool:
    """Return whether a coefficient counts: it is not zero, or a writer's named zero."""
    return float(word) != 0.0 or word == NAMED_ZERO


def _order(block: SurfaceBlock, slot: str, may_be_0: bool) -> int:
    """Return the order of diffraction; `InputError` where it is missing, or no whole number."""
    if slot not in block.slots and may_be_0:
        raise InputError(f"{block.place}: {slot}, the order of diffraction, is missing")
    order = block.slot(slot)
    if order != int(order) or not (order or may_be_0):
        but = "" if may_be_0 else " but 0"
        raise InputError(
            f"{block.place}: {slot}, the order of diffraction, must be a whole number{but}, not "
            f"{block.slots.get(slot, '0')}"
        )
    return int(order)


def _text(value: float | None, number: Number, place: str) -> str:
    """Return a number as it is written; one that the row has and is zero is a named zero."""
    if value is None:
        return "0"
    if number.rule in (ORDER, ORDER_BUT_0):
        return str(as_integer(value, place))
    if number.shift:
        return shifted(value, -number.shift)
    return repr(value if number.rule else value or float(NAMED_ZERO))


def curvature_line(row: Mapping[str, Any], place: str) -> str:
    """Return the line of a row's `radius` or `curvature`."""
    if row.get("curvature") is not None:
        curvature = as_number(row["curvature"], f"{place}: 'curvature'")
    else:
        radius = as_number(row.get("radius", math.inf), f"{place}: 'radius'", finite=False)
        if radius == 0.0:
            raise InputError(f"{place}: 'radius' is 0; write .inf for a plane")
        curvature = 1.0 / radius
    return f'CURV {curvature!r} 0 0 0 0 ""'


def conic_line(row: Mapping[str, Any], place: str) -> str:
    """Return the line of a row's `conic`."""
    return f"CONI {as_number(row.get('conic', 0.0), place)!r}"


def _read_conic(block: SurfaceBlock) -> Row:
    return {**radius_row(block.curvature), "conic": block.number("CONI")}


def _read_plain(block: SurfaceBlock) -> Row:
    """Return a conic where CONI is given; a plane where CURV is `0`, without a decimal point.

    Zemax itself writes 0.0, and that is a curvature that an optimizer may change.
    """
    if "CONI" in block.lines:
        return {"type": "conic", **_read_conic(block)}
    if (block.words("CURV") or ["0"])[0] == "0":
        return {"type": "plane"}
    return {"type": "sphere", **radius_row(block.curvature)}


def _write_plain(row: Mapping[str, Any], place: str) -> list[str]:
    kind = str(row.get("type", "sphere"))
    if kind in ("plane", "aperture"):
        return ["CURV 0"]
    lines = [curvature_line(row, place)]
    return [*lines, conic_line(row, place)] if kind == "conic" else lines


CONIC = Base(_read_conic, lambda row, place: [curvature_line(row, place), conic_line(row, place)])
# A plane, a sphere or a conic.
PLAIN = Base(_read_plain, _write_plain)


def _read_two_curves(block: SurfaceBlock) -> Row:
    """Return radius or curvature along x (PARM 1, where 0 means infinity) and along y."""
    radius, along_x = block.slot("PARM 1", 1), {"radius_x": math.inf}
    if radius:
        # A radius with more digits than a double was written for its curvature's sake.
        curvature = curvature_in_text(block.slots["PARM 1"], f"{block.place}: PARM 1")
        exact = curvature is not None and block.factor == 1
        along_x = {"curvature_x": curvature} if exact else {"radius_x": radius}  # type: ignore[dict-item]
    along_y = {f"{key}_y": value for key, value in radius_row(block.curvature).items()}
    return {**along_x, **along_y, "conic_y": block.number("CONI")}


def _write_two_curves(row: Mapping[str, Any], place: str) -> list[str]:
    keys = ("radius", "curvature", "conic")
    along_y = {key: row[f"{key}_y"] for key in keys if f"{key}_y" in row}
    if row.get("curvature_x") is not None:
        curvature = as_number(row["curvature_x"], f"{place}: 'curvature_x'")
        word = reciprocal(curvature) if curvature else "0"
    else:
        radius = as_number(row.get("radius_x"), f"{place}: 'radius_x'", finite=False)
        word = "0" if math.isinf(radius) else repr(radius)
    return [curvature_line(along_y, place), conic_line(along_y, place), f"PARM 1 {word}"]


# A biconic or a toroid; CURV and CONI are those along y.
TWO_CURVES = Base(_read_two_curves, _write_two_curves)
