"""The worst offenders among a lens's tolerances, for its page.

They are those of a file (see `dolens.prescriptions.files.read_tolerance_file`), or the usual ones.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from dolens.analysis.conditions import Conditions
from dolens.analysis.spot_diagram import SpotDiagram
from dolens.errors import InputError
from dolens.lens_page.tables import Table, number
from dolens.optics.fields import field_label
from dolens.optics.lens import Lens
from dolens.plotting.tolerances import offenders_figure, parameter_label, tolerance_label
from dolens.prescriptions.files import read_tolerance_file
from dolens.tolerancing import (
    Contributions,
    Sensitivities,
    Tolerances,
    contributions,
    linear_spots_over_field,
    sensitivities,
    tolerances_from,
    usual_tolerances,
    usual_tolerances_text,
    with_glass_elements,
)

DEFAULT = "default"
_MOST = 12
# Share of the brightest field's light that a field of tolerances has.
_BRIGHT = 0.1
Source = str | Path | Mapping[str, Any]


@dataclass(frozen=True)
class Offenders:
    """What tolerances do to a lens, by the linear ray model.

    Attributes:
        tolerances: P of them.
        sensitivities: of each alone.
        contributions: of each to the mean square radius of refocused lenses.
        notes: what was assumed or not read, a sentence each.
    """

    tolerances: Tolerances
    sensitivities: Sensitivities
    contributions: Contributions
    notes: list[str]

    def figure(self) -> Figure:
        """Draw the worst offenders as bars."""
        t, c, s = self.tolerances, self.contributions, self.sensitivities
        first = c.order[:_MOST]
        return offenders_figure(
            [tolerance_label(t.names[p], t.label(p)) for p in first],
            c.share[first].tolist(),
            {
                "refocused": s.increase()[first].tolist(),
                "not refocused": s.increase(refocused=False)[first].tolist(),
            },
        )

    def table(self, most: int = _MOST) -> Table:
        """Return the worst offenders, one a row, and no more than so many."""
        t, c, s = self.tolerances, self.contributions, self.sensitivities
        growth, unfocused = s.increase(), s.increase(refocused=False)
        rows = [
            (
                parameter_label(t.names[p]),
                t.label(p).replace("-", "−"),
                f"{100.0 * float(c.share[p]):.1f} %",
                number(1e3 * growth[p], 3, zeros=True),
                number(1e3 * unfocused[p], 3, zeros=True),
                number(1e3 * s.largest_centroid_shift[p], 3, zeros=True),
            )
            for p in c.order[:most]
        ]
        heads = ("parameter", "tolerance", "share", "RMS grows", "not refocused", "spot moves")
        return Table(
            heads,
            rows,
            f"The worst {len(rows)} of {len(t.names)} tolerances. RMS radius over all spots, and "
            "motion of the farthest spot, in µm, at the end of each tolerance alone; share: of the "
            "average rise of the mean square radius, refocused.",
            frozenset({0, 1}),
        )

    def summary(self) -> str:
        """Return the radius as designed, and that expected under all tolerances."""
        design = 1e3 * self.contributions.nominal**0.5
        expected = 1e3 * self.contributions.expected_rms
        return (
            f"RMS radius over all spots, refocused: {number(design, 4)} µm as designed, "
            f"{number(expected, 4)} µm expected under all tolerances together (linear ray model)."
        )


def offenders(lens: Lens, where: Conditions, source: Source) -> Offenders:
    """Find the worst offenders of a lens.

    Args:
        lens: as designed, in double precision; it stays as it is.
        where: fields, which are taken on both sides of the axis in x and in y, and wavelengths,
            with their weights.
        source: see `tolerances_of`.

    Raises:
        InputError: the file cannot be read or names what the lens does not have, or no light of
            a field passes.
    """
    lens, tolerances, notes = tolerances_of(lens, source)
    model, weights = linear_spots_over_field(lens, where, tolerances.names)
    return Offenders(
        tolerances,
        sensitivities(model, tolerances.steps, weights),
        contributions(model, tolerances, weights),
        notes,
    )


def tolerances_of(lens: Lens, source: Source) -> tuple[Lens, Tolerances, list[str]]:
    """Return a copy of a lens with the elements that may tilt and move, its tolerances, and notes.

    Args:
        lens: as designed; it stays as it is.
        source: `default`, the usual ones; a YAML file, see `read_tolerance_file`; or a mapping, see
            `dolens.tolerancing.tolerances_from`.

    Raises:
        InputError: the file cannot be read, or names what the lens does not have.
    """
    given: Mapping[str, Any]
    if isinstance(source, Mapping):
        lens = with_glass_elements(lens)
        return lens, tolerances_from(lens, source), []
    if str(source) == DEFAULT:
        lens = with_glass_elements(lens)
        return lens, tolerances_from(lens, usual_tolerances(lens)), [usual_tolerances_text(lens)]
    lens, content, unread = read_tolerance_file(lens, source)
    if "tolerances" not in content:
        raise InputError(f"{source}: 'tolerances' is missing")
    given, factor = content["tolerances"], content.get("tolerance_factor", 1.0)
    name = Path(source).name
    notes = [f"Not read from {name}: {', '.join(unread)}."] if unread else []
    return lens, tolerances_from(lens, given, factor), [*notes, f"Tolerances of {name}."]


def bright_fields(where: Conditions, spots: SpotDiagram | None) -> tuple[Conditions, list[str]]:
    """Return conditions without the fields of which little light passes, and a note of those.

    Where little of the stop is lit, tolerances say nothing of use.

    Args:
        where: the fields.
        spots: of them; None leaves all.
    """
    if spots is None:
        return where, []
    light = spots.valid.double().mean((1, 2))
    bright = light >= _BRIGHT * light.max()
    dim = [field_label(point, where.field_unit) for point in where.fields[~bright]]
    if not dim or not bool((bright & (where.field_weights > 0.0)).any()):
        return where, []
    kept = replace(where, fields=where.fields[bright], field_weights=where.field_weights[bright])
    return kept, [f"tolerances at {', '.join(dim)}: too little light passes"]
