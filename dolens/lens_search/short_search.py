"""A search for lenses in one call: forms with their lenses, spots and checks, as objects."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dolens.errors import InputError, check_count, check_keys
from dolens.lens_page.tables import number
from dolens.lens_search.finds import Finds, course_picture, starts_and_designs
from dolens.lens_search.form_report import FormReport, report_form, write_form
from dolens.lens_search.glass.choice import GlassChoice
from dolens.lens_search.glass.glass_step import GlassPlan
from dolens.lens_search.search import SearchPlan, Step
from dolens.lens_search.search import search as steps_of
from dolens.lens_search.search_report import sections_figure
from dolens.lens_search.specification import Limits, Specification
from dolens.lens_search.verification import Requirements
from dolens.optics.text_tables import html_table, text_table
from dolens.tasks import OwnThreads, TaskMap

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dolens.optics.lens import Lens

# The lines C, d and F.
_VISIBLE = (656.2725, 587.5618, 486.1327)
# Of the field's angle, besides the axis and the edge.
_ZONE = 0.7
_NOTE = (
    "Spots: RMS radii in µm, by field. As made: what 90 % of lenses stay within, refocused, with "
    "the tolerances of the search. Limits: the first that real rays find broken."
)
# Lengths over the focal length, where nothing else is said; see `search`.
_GLASS, _AIR, _GLASS_EDGE, _BACK_FOCUS, _TRACK = (0.02, 0.2), (0.002, 0.4), 0.01, 0.2, 2.0
_DISTORTION = 0.02
# SCHOTT's glasses of today, without their equals of other transmission or hardness.
_CHOSEN: Any = {"catalogues": ("SCHOTT",), "names": ("N-*",), "without": ("*HT*", "*Q2")}
# Starts of one task: time is looked at between tasks.
_BATCH = 100
# Of a limited time, the share in which lenses grow where glasses are to become real afterwards.
_GROWTH = 0.6
_MOST = 20


@dataclass(frozen=True, eq=False)
class LensSearch:
    """What a search found; it shows itself as a table, in a notebook and when printed.

    It is a sequence of its forms, the best first: `found[0].lens` is an ordinary lens.

    Attributes:
        specification: what was asked for.
        forms: different designs, the best first; each has its `lens`, `found.rms_spot_um` by field,
            `verification` (the checks with real rays), `holds`, `sensitivity` to the usual
            tolerances and `powers`.
        finds: all designs, and the search's course.
        seconds: that the search took, its checks included.
    """

    specification: Specification
    forms: tuple[FormReport, ...]
    finds: Finds
    seconds: float

    def __len__(self) -> int:
        """Return the number of forms."""
        return len(self.forms)

    def __getitem__(self, place: int) -> FormReport:
        """Return a form by its place, from 0, the best."""
        return self.forms[place]

    def __iter__(self) -> Iterator[FormReport]:
        """Go through the forms, the best first."""
        return iter(self.forms)

    @property
    def lenses(self) -> list[Lens]:
        """Return the lens of each form, the best first."""
        return [form.lens for form in self.forms]

    @property
    def best(self) -> Lens:
        """Return the best lens that keeps every check, or the best of all where none does.

        Raises:
            InputError: nothing was found.
        """
        if not self.forms:
            raise InputError(
                "search: no start became a lens that keeps the specification; give more starts or "
                "seconds, or wider limits"
            )
        return next((form for form in self.forms if form.holds), self.forms[0]).lens

    @property
    def task(self) -> str:
        """Return what was asked for."""
        asked, many = self.specification, self.specification.elements > 1
        return (
            f"{asked.elements} element{'s' * many}, f = {asked.focal_length:.4g} mm, "
            f"F/{asked.f_number:.3g}, ±{max(asked.fields):.4g}°"
        )

    @property
    def heading(self) -> str:
        """Return what was asked for, and how much was found in which time."""
        return (
            f"{self.task}: {len(self.forms)} forms of {self.finds.designs} designs in "
            f"{self.seconds:.0f} s"
        )

    def save(self, folder: str | Path) -> Path:
        """Write every form in every format of lens files into a folder, and return the folder.

        Raises:
            InputError: a file cannot be written.
        """
        for form in self.forms:
            write_form(form.lens, folder, form.number)
        return Path(folder)

    def figure(self) -> Figure | None:
        """Draw the sections of all forms with their mean RMS spots; None where there is none."""
        from dolens.plotting.export import showing

        found = sections_figure(self.forms, f"{self.task}: mean RMS spots")
        return None if found is None else showing(found)

    def course_figure(self) -> Figure:
        """Plot the mean RMS spot of the best form, and the forms, against time."""
        from dolens.plotting.export import showing

        if not self.forms:
            raise InputError("search: nothing was found, so that it has no course")
        return showing(course_picture(self.finds, self.task))

    def __repr__(self) -> str:
        """Return the forms as text."""
        return f"{self.heading}\n\n{text_table(*self._table())}\n\n{_NOTE}"

    def _repr_html_(self) -> str:
        """Return the forms as HTML, all text escaped."""
        headings, rows, left = self._table()
        return html_table(headings, rows, self.heading, left, _NOTE)

    def _table(self) -> tuple[list[str], list[list[str]], set[int]]:
        """Return headings, rows and columns that are flush left."""
        fields = [f"{angle:g}°" for angle in self.specification.fields]
        rows = []
        for form in self.forms:
            made = form.sensitivity
            rows.append(
                [
                    str(form.number),
                    form.powers,
                    number(form.found.mean_rms_spot_um, 3, zeros=True),
                    *(number(spot, 3, zeros=True) for spot in form.found.rms_spot_um),
                    "" if made is None else number(made.ninety_percent_um, 3, zeros=True),
                    form.broken or "all met",
                    form.glasses,
                ]
            )
        headings = ["form", "powers", "mean spot", *fields, "as made", "limits", "glasses"]
        return headings, rows, {1, 5 + len(fields) - 1, 5 + len(fields)}


def search(
    efl: float,
    f_number: float,
    field: float | Sequence[float],
    elements: int | Sequence[int],
    glasses: Sequence[str] = (),
    wavelengths: Sequence[float] = _VISIBLE,
    limits: Mapping[str, Any] | None = None,
    aspheres: int = 0,
    starts: int = 500,
    seconds: float | None = None,
    forms: int = 10,
    seed: int = 0,
    **plan: Any,
) -> LensSearch:
    """Search for lenses from nothing but what they must do; see docs/lens_search.md.

    It is the search of `dolens train experiment=search_triplet`: with the same specification and
    plan it finds the same lenses.  Four elements at f/2.8 whose glasses are chosen take two minutes
    of a core, of given glasses half of one.

    Args:
        efl: focal length, mm.
        f_number: focal length over the diameter of the entrance pupil.
        field: degrees from the axis to the edge, where the axis and 0.7 of it count too; or all
            angles that count, the first 0, as aspheres at a wide field need.
        elements: how many, all in air; or elements of each cemented group from the front, as
            (1, 2, 2, 1).
        glasses: one for all elements or one for each, as a prescription names them
            (`SCHOTT:N-BK7`, `1.6204/60.31`); none: they are chosen among SCHOTT's `N-*`.
        wavelengths: nm, the middle one of the list is the reference.
        limits: of `dolens.lens_search.specification.Limits`, mm, as `{"track": 70, "back_focus":
            20}`.  Where they are not given: glass 0.02 to 0.2 of the focal length thick, 0.01 at
            the edge, air 0.002 to 0.4, back focus 0.2 at least, track 2 at most, distortion 2 %.
        aspheres: coefficients from r⁴ on of both surfaces of every element; 0: spheres.
        starts: random starts, over all places of the stop.
        seconds: after so many no further task begins, and what was found is checked; those that
            have begun, and the compilation of a first call, take up to half a minute more.  None:
            all starts.
        forms: how many of the best forms are checked and returned.
        seed: of the starts.
        plan: other settings of `dolens.lens_search.search.SearchPlan`, as `escapes`.

    Raises:
        InputError: a number out of range, or an unknown glass or setting.

    Example:
        >>> found = dolens.search(
        ...     efl=50, f_number=6, field=5, elements=1, glasses=["1.5168/64.17"], starts=20
        ... )
        >>> round(found.best.first_order().efl.item(), 3)
        50.0
    """
    started = time.perf_counter()
    asked = specification(
        efl, f_number, field, elements, glasses, wavelengths, limits or {}, aspheres
    )
    known = sorted(set(SearchPlan.__dataclass_fields__) - {"starts", "seed"})
    check_keys(plan, known, "search()")
    check_amounts(starts, forms, seed, seconds)
    usual = {"batch": _BATCH, "glass": GlassPlan(forms=forms)}
    how = SearchPlan(**{**usual, **plan, "starts": starts, "seed": seed})
    return collected(asked, how, partial(steps_of, asked, how), forms, started, seconds)


def check_amounts(starts: int, forms: int, seed: int, seconds: float | None) -> None:
    """Refuse amounts out of range; see `search`."""
    for name, value, least in (("starts", starts, 1), ("forms", forms, 1), ("seed", seed, 0)):
        check_count(name, value, least)
    if seconds is not None and not (isinstance(seconds, int | float) and seconds > 0.0):
        raise InputError(f"seconds: {seconds!r}; allowed: a positive number, or None")


def collected(
    asked: Specification,
    plan: SearchPlan,
    steps: Callable[[TaskMap], Iterator[Step]],
    forms: int,
    started: float,
    seconds: float | None,
) -> LensSearch:
    """Search, and check the best forms.

    Args:
        asked: of every lens.
        plan: of the search.
        steps: map of tasks → what each finds.
        forms: how many are checked.
        started: time of `time.perf_counter` when it began.
        seconds: see `search`.
    """
    finds = Finds(asked, plan)
    with OwnThreads().open() as map_tasks:
        mapped = map_tasks
        if seconds is not None:
            growth = seconds * (1.0 if asked.glass_choice is None else _GROWTH)
            mapped = _limited(map_tasks, started + growth, started + seconds)
        for step in steps(mapped):
            finds.add(step, time.perf_counter() - started)
    finds.rank(forms)
    required = Requirements.of(asked)
    course = finds.course() if finds.found else None
    reports = tuple(
        report_form(
            found,
            place,
            required,
            None,
            *((None, None) if course is None else starts_and_designs(course, found)),
        )
        for place, found in enumerate(finds.found, 1)
    )
    return LensSearch(asked, reports, finds, time.perf_counter() - started)


def specification(
    efl: float,
    f_number: float,
    field: float | Sequence[float],
    elements: int | Sequence[int],
    glasses: Sequence[str],
    wavelengths: Sequence[float],
    limits: Mapping[str, Any],
    aspheres: int = 0,
) -> Specification:
    """Return the specification of a search; see `search` for the arguments.

    Raises:
        InputError: a number out of range, or an unknown limit.
    """
    several = isinstance(field, list | tuple)
    angles = tuple(field) if isinstance(field, list | tuple) else (field,)
    fields = (("field", angle) for angle in angles)
    for name, value in (("efl", efl), ("f_number", f_number), *fields):
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise InputError(f"{name}: {value!r}; allowed: a number")
    for angle in angles:
        if not 0.0 <= angle < 80.0:
            raise InputError(f"field: {angle:g}; allowed: 0 to below 80 degrees from the axis")
    check_count("aspheres", aspheres, 0)
    if not efl > 0.0:
        raise InputError(f"efl: {efl:g}; allowed: a positive focal length in mm")
    if isinstance(elements, int) and not isinstance(elements, bool) and elements > 0:
        groups: tuple[int, ...] = (1,) * elements
    elif isinstance(elements, list | tuple) and all(isinstance(n, int) for n in elements):
        groups = tuple(elements)
    else:
        raise InputError(
            f"elements: {elements!r}; allowed: a number of 1 or more, or elements of each group, "
            "as (1, 2, 2, 1)"
        )
    check_keys(limits, sorted(Limits.__dataclass_fields__), "limits")
    lengths: dict[str, Any] = {
        "glass": tuple(efl * share for share in _GLASS),
        "air": tuple(efl * share for share in _AIR),
        "glass_edge": efl * _GLASS_EDGE,
        "back_focus": efl * _BACK_FOCUS,
        "track": efl * _TRACK,
        "distortion": _DISTORTION,
    }
    named = [glasses] if isinstance(glasses, str) else list(glasses)
    return Specification(
        focal_length=float(efl),
        f_number=float(f_number),
        fields=angles if several or not angles[0] else (0.0, _ZONE * angles[0], angles[0]),
        wavelengths=tuple(wavelengths),
        groups=groups,
        glasses=tuple(named),
        limits=Limits(**{**lengths, **limits}),
        asphere_terms=(aspheres,),
        glass_choice=None if named else GlassChoice(**_CHOSEN),
    )


def _limited(map_tasks: TaskMap, grown: float, ended: float) -> TaskMap:
    """Return a map that begins no further task when its time is over, and makes one at least.

    Args:
        map_tasks: runs the tasks.
        grown: time of `time.perf_counter` when starts are no longer grown.
        ended: when nothing else begins.
    """

    def mapped(function: Callable[[Any], Any], tasks: Sequence[Any], name: str) -> Iterator[Any]:
        until = grown if name == "batches of starts" else ended
        for found in map_tasks(function, tasks, name):
            yield found
            if time.perf_counter() > until:
                return

    return mapped
