"""What an optimization did to a lens: numbers that show themselves, and figures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from dolens.errors import InputError, check_choice, check_keys
from dolens.optics.text_tables import html_table, printable, text_table
from dolens.optimize.merit import evaluate_operands
from dolens.optimize.operands import CLASSES, KINDS, Operand, operand
from dolens.optimize.rounds import Design

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dolens.analysis.conditions import Conditions
    from dolens.optics.lens import Lens

# Of merit functions whose square root is a mean over the spots: the name and the unit of this.
_MEANS = {"spots": ("RMS spot radius", "µm"), "wavefront": ("RMS wavefront error", "waves")}
# Per mm, degree or per cent, beside spots in µm; a magnification has smaller numbers.
_WEIGHT, _OF_MAGNIFICATION = 100.0, 1e4
# Of gaps that nobody asked for: a lens that can be made comes before what was asked for.
_OF_GAPS = 1000.0
_OTHER_NAMES = {"back_focus": "bfd"}
_KEYS = ("target", "min", "max", "weight", "field", "gaps", "state")
# On the axis they are zero.
_OF_A_FIELD = ("chief_ray_angle", "distortion")
Wanted = float | tuple[float | None, float | None] | Mapping[str, Any]


@dataclass(frozen=True)
class OperandChange:
    """An operand before and after an optimization.

    Attributes:
        label: its kind, and which gap, field or state.
        wanted: its target or its limits, in words.
        before: its value, mm, degrees or per cent.
        after: likewise.
        deviation: of the value after, from the target or beyond a limit; 0 where it is kept.
    """

    label: str
    wanted: str
    before: float
    after: float
    deviation: float


@dataclass(frozen=True)
class VariableChange:
    """A variable before and after an optimization.

    Attributes:
        name: as in a lens file.
        before: in the unit of files: mm, 1/mm for curvatures, degrees.
        after: likewise.
        lower: its bound, -inf for none.
        upper: its bound, inf for none.
        at_bound: whether it stands at one of them.
    """

    name: str
    before: float
    after: float
    lower: float
    upper: float
    at_bound: bool


@dataclass(frozen=True)
class Optimization:
    """What `lens.optimize` did; it shows itself as tables, in a notebook and when printed.

    It is a record: copies of the lens share it, and it does not follow what is done to them.

    Attributes:
        initial: the lens where the search began.
        final: the lens that was found.
        for_: the kind of the merit function.
        merit: its value before the first iteration and after each: the rays' part in µm² of
            `spots`, in squared wavelengths of `wavefront`, and (weight·deviation)² of operands.
        reached: its value at the end, over the rays that pass the final lens.
        quality: √ of the rays' part before and after: the weighted RMS radius of all spots, µm, or
            the RMS wavefront error, waves; of another kind the part itself.
        operands: what was to be kept.
        variables: what was varied.
        stopped: why the search ended, in words.
        seconds: that it took.
        where: the fields and wavelengths.
        notes: what has become worse and nothing kept, a sentence each.
    """

    initial: Lens
    final: Lens
    for_: str
    merit: tuple[float, ...]
    reached: float
    quality: tuple[float, float]
    operands: tuple[OperandChange, ...]
    variables: tuple[VariableChange, ...]
    stopped: str
    seconds: float
    where: Conditions
    notes: tuple[str, ...]

    @staticmethod
    def of(
        found: Design,
        for_: str,
        wanted: Mapping[str, Operand],
        held: Mapping[str, Operand],
        where: Conditions,
    ) -> Optimization:
        """Return the record of a design.

        Args:
            found: the design.
            for_: kind of the merit.
            wanted: the operands that were asked for, by their kinds.
            held: those of `gaps_that_stay`, which are told where they bind.
            where: the fields and wavelengths of the merit.
        """
        start, end, kinds = found.before, found.after, {**wanted, **held}
        squares = (start.quality or 0.0, end.quality or 0.0)
        return Optimization(
            start.lens,
            end.lens,
            for_,
            found.history,
            end.merit,
            (math.sqrt(squares[0]), math.sqrt(squares[1])) if for_ in _MEANS else squares,
            tuple(
                OperandChange(
                    one.label, _text(one.label, kinds), first.value, one.value, one.deviation
                )
                for first, one in zip(start.operands, end.operands, strict=True)
                if one.deviation or _kind(one.label, kinds) in wanted
            ),
            tuple(
                VariableChange(
                    name, value, end.variables[name], *found.bounds[name], name in found.at_bounds
                )
                for name, value in start.variables.items()
            ),
            found.stopped,
            found.seconds,
            where,
            tuple(_notes(start.lens, end.lens, where.object_distance)),
        )

    def __deepcopy__(self, memo: dict[int, Any]) -> Optimization:
        """Return the record itself: copies of a lens share it."""
        return self

    @property
    def at_bounds(self) -> tuple[str, ...]:
        """Return the names of the variables that stand at a bound."""
        return tuple(variable.name for variable in self.variables if variable.at_bound)

    @property
    def heading(self) -> str:
        """Return what was gained in how many iterations and seconds, and why it ended."""
        name, unit = _MEANS.get(self.for_, (f"merit of {self.for_}", ""))
        before, after = self.quality
        return printable(
            f"{self.final.name or 'Lens'}: {name} {before:.4g} → {after:.4g} {unit}".rstrip()
            + f" in {len(self.merit) - 1} iterations, {self.seconds:.2g} s; merit "
            f"{self.merit[0]:.4g} → {self.reached:.4g}; ended: {self.stopped}"
        )

    def __repr__(self) -> str:
        """Return the tables as text."""
        tables = [text_table(headings, rows, left) for headings, rows, left in self._tables()]
        return "\n\n".join([self.heading, *self.notes, *tables])

    def _repr_html_(self) -> str:
        """Return the tables as HTML, all text escaped."""
        *others, varied = self._tables()
        heading, notes = self.heading, " ".join(self.notes)
        if others:
            ((headings, rows, left),) = others
            kept, heading = html_table(headings, rows, heading, left), ""
        else:
            kept = ""
        headings, rows, left = varied
        return kept + html_table(headings, rows, heading, left, notes)

    def figure(self) -> Figure:
        """Plot the merit against the iteration."""
        from dolens.plotting.export import showing
        from dolens.plotting.layout import shown_name
        from dolens.plotting.search import history_figure

        name, unit = _MEANS.get(self.for_, ("", ""))
        label = f"merit ({unit}²)" if name == "RMS spot radius" and not self.operands else "merit"
        title = f"{shown_name(self.final)}: {self.for_}, history of the optimization"
        return showing(history_figure(self.merit, title=title, merit_label=label))

    def draw(self) -> Figure:
        """Draw the section before and after, with rays of the fields in the y-z plane."""
        from dolens.plotting.export import showing
        from dolens.plotting.lens_section import before_after_figure

        distance = self.where.object_distance
        points = self.where.fields.tolist() if distance is None else []
        angles = sorted({y for x, y in points if x == 0.0}) or [0.0]
        wave = self.final.primary_wavelength
        figure = before_after_figure(
            self.initial, self.final, wave, angles, object_distance=distance
        )
        return showing(figure)

    def _tables(self) -> list[tuple[Sequence[str], list[list[str]], set[int]]]:
        """Return headings, rows and columns that are flush left, of operands and variables."""
        kept = [
            [
                one.label,
                one.wanted,
                f"{one.before:.6g}",
                f"{one.after:.6g}",
                f"{one.deviation:+.2g}" if one.deviation else "kept",
            ]
            for one in self.operands
        ]
        varied = [
            [
                one.name,
                f"{one.before:.6g}",
                f"{one.after:.6g}",
                f"at its bound {_bound(one):g}" if one.at_bound else "",
            ]
            for one in self.variables
        ]
        found: list[tuple[Sequence[str], list[list[str]], set[int]]] = []
        if kept:
            found.append((("operand", "wanted", "before", "after", "off by"), kept, {0, 1}))
        return [*found, (("variable", "before", "after", ""), varied, {0, 3})]


# Limits that a lens must keep to be made at all, mm.
_GAPS = ("centre_thickness", "air_gap", "edge_thickness", "edge_air_gap")
# A change of the F-number by a smaller share goes without saying.
_CHANGE = 0.01


def gaps_that_stay(
    lens: Lens, wanted: Mapping[str, Operand], object_distance: float | None
) -> dict[str, Operand]:
    """Return limits of glass and air, on the axis and at the edges, that nobody asked for, by their
    kinds: half of the least that the lens has.

    Args:
        lens: as it is.
        wanted: what was asked for; its kinds are left out, and those that are negative already.
        object_distance: mm; None for infinity.
    """
    kinds = [Operand(kind, min=0.0) for kind in _GAPS if kind not in wanted]
    least: dict[str, float] = {}
    for one in evaluate_operands(kinds, lens, object_distance).numbers():
        kind = one.label.split("/")[0]
        least[kind] = min(one.value, least.get(kind, math.inf))
    return {
        kind: Operand(kind, min=0.5 * value, weight=_OF_GAPS)
        for kind, value in least.items()
        if value >= 0.0
    }


def _notes(before: Lens, after: Lens, object_distance: float | None) -> Iterator[str]:
    """Yield a sentence for what has become worse: gaps below zero, another F-number."""
    limits = [Operand(kind, min=0.0) for kind in _GAPS]

    def negative(lens: Lens) -> dict[str, float]:
        found = evaluate_operands(limits, lens, object_distance).numbers()
        return {one.label: one.value for one in found if one.deviation}

    there = negative(before)
    for label, value in negative(after).items():
        if label not in there:
            kind = label.split("/")[0]
            yield (
                f"{label} is {value:.3g} mm; keep={{'{kind}': {{'min': 0.5, 'weight': 1e5}}}} "
                "would hold it above zero."
            )
    first, last = (
        lens.first_order(lens.primary_wavelength, object_distance).working_f_number.abs().item()
        for lens in (before, after)
    )
    if abs(last / first - 1.0) > _CHANGE:
        yield f"The working F-number went from {first:.3g} to {last:.3g}: nothing held it."


def _bound(variable: VariableChange) -> float:
    """Return the bound that a variable stands at."""
    below, above = variable.after - variable.lower, variable.upper - variable.after
    return variable.lower if below <= above else variable.upper


def _kind(label: str, wanted: Mapping[str, Operand]) -> str:
    """Return the kind of the operand that a label is of, behind a state's name or not."""
    return next(kind for kind in label.split("/")[:2] if kind in wanted)


def _text(label: str, wanted: Mapping[str, Operand]) -> str:
    """Return the target or the limits of the operand that a label is of."""
    one = wanted[_kind(label, wanted)]
    if one.target is not None:
        return f"{one.target:g}"
    if one.max is None:
        return f"at least {one.min:g}"
    return f"at most {one.max:g}" if one.min is None else f"{one.min:g} to {one.max:g}"


def operands_to_keep(
    keep: Mapping[str, Wanted], lens: Lens, fields: Sequence[Sequence[float]]
) -> dict[str, Operand]:
    """Return operands by their kinds.

    Args:
        keep: name of an operand → its target, or (min, max) of which one may be None, or its
            settings as in conf.
        lens: that they are of.
        fields: of the merit; angles of chief rays and distortion are those of the farthest.

    Raises:
        InputError: an unknown operand, or what `Operand` refuses.
    """
    if not isinstance(keep, Mapping):
        raise InputError(f"keep: {keep!r}; allowed: operands with targets, as {{'efl': 50}}")
    found: dict[str, Operand] = {}
    for name, wanted in keep.items():
        check_choice(name, (*KINDS, *CLASSES, *_OTHER_NAMES), "keep")
        kind = _OTHER_NAMES.get(name, name)
        if kind in found:
            raise InputError(f"keep: '{name}' is named twice")
        weight = _OF_MAGNIFICATION if kind == "magnification" else _WEIGHT
        given = _settings(name, wanted)
        settings = {"weight": weight, **given, "kind": kind}
        if kind in _OF_A_FIELD and given.get("field") is None:
            settings["field"] = max(fields, key=lambda point: math.hypot(*point))
        try:
            found[kind] = operand(settings, lens)
        except InputError as problem:
            raise InputError(f"keep: {problem}") from None
    return found


def _settings(name: str, wanted: Wanted) -> dict[str, Any]:
    """Return a target, limits or settings as settings of an operand."""
    if isinstance(wanted, Mapping):
        if name not in CLASSES:  # which have keys of their own
            check_keys(wanted, _KEYS, f"keep: {name}")
        return dict(wanted)
    if isinstance(wanted, int | float) and not isinstance(wanted, bool):
        return {"target": wanted}
    pair = list(wanted) if isinstance(wanted, list | tuple) else []
    if len(pair) == 2 and all(
        limit is None or (isinstance(limit, int | float) and not isinstance(limit, bool))
        for limit in pair
    ):
        return {"min": pair[0], "max": pair[1]}
    raise InputError(
        f"keep: {name}: {wanted!r}; allowed: a number, (min, max) with None for no limit, or "
        "settings of the operand"
    )
