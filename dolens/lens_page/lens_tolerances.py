"""Tolerances of a lens in one call: yield, sensitivities and worst offenders, and their figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from dolens.analysis.conditions import Conditions, conditions
from dolens.analysis.spot_diagram import spot_diagram
from dolens.errors import InputError, check_count, check_keys
from dolens.lens_page.offenders import Offenders, Source, bright_fields, tolerances_of
from dolens.lens_page.overview import prepared_lens
from dolens.lens_page.tables import Table, number
from dolens.optics.text_tables import html_table, printable, text_table
from dolens.plotting.layout import lens_title
from dolens.plotting.tolerances import yield_figure
from dolens.tolerancing import (
    Sensitivities,
    ToleranceAnalysis,
    analyse_tolerances,
    quantiles,
    share_within,
    spots_over_field,
)
from dolens.views.overview import as_lens

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dolens.analysis.fields_and_wavelengths import FieldPoints
    from dolens.optics.lens import Lens

SHARES = (0.5, 0.8, 0.9, 0.95, 0.98)
# As the overview of a lens has them, of each field and wavelength.
_RAYS = 2000


@dataclass(frozen=True)
class LensTolerances:
    """What tolerances do to a lens; it shows itself as tables, in a notebook and when printed.

    Radii are RMS radii over all spots, µm, of lenses whose sensor is refocused once for all spots,
    unless an argument says otherwise.

    Attributes:
        lens: as designed, with the elements that tilt and move.
        offenders: sensitivities and contributions of every tolerance, as `dolens show
            --tolerances` has them.
        analysis: the lenses that were drawn and traced, and the linear ray model's prediction.
        weights: (S,), of the spots.
        where: fields and wavelengths.
        problems: fields that were left out, a sentence each.
    """

    lens: Lens
    offenders: Offenders
    analysis: ToleranceAnalysis
    weights: Tensor
    where: Conditions
    problems: tuple[str, ...]

    @property
    def sensitivities(self) -> Sensitivities:
        """Return what every tolerance alone does to the spots."""
        return self.offenders.sensitivities

    @property
    def nominal_um(self) -> float:
        """Return the radius of the lens as designed, µm."""
        return 1e3 * self.offenders.contributions.nominal**0.5

    @property
    def expected_um(self) -> float:
        """Return the expected radius under all tolerances together, µm, by the linear ray model."""
        return 1e3 * self.offenders.contributions.expected_rms

    def radii_um(self, refocused: bool = True) -> Tensor:
        """Return the radii of all lenses (lenses,), µm, ascending; infinite where a lens fails."""
        return 1e3 * self.analysis.traced.found(refocused).rms

    def yield_at(self, radius_um: float, refocused: bool = True) -> float:
        """Return the share of the lenses, 0 to 1, whose radius is at most this many µm."""
        return share_within(self.radii_um(refocused), radius_um)

    def radius_of(self, share: float, refocused: bool = True) -> float:
        """Return the radius, µm, that this share of the lenses, above 0 to 1, stays within."""
        return quantiles(self.radii_um(refocused), [share])[0]

    def yield_table(self) -> Table:
        """Return the radii that shares of the lenses stay within, one share a row."""
        rows = [
            (
                f"{100 * share:g} %",
                number(self.radius_of(share), 4, zeros=True),
                number(self.radius_of(share) / self.nominal_um, 3, zeros=True),
                number(self.radius_of(share, refocused=False), 4, zeros=True),
            )
            for share in SHARES
        ]
        heads = ("lenses", "within (µm)", "over the design's", "not refocused (µm)")
        return Table(heads, rows)

    def table(self, most: int = 12) -> Table:
        """Return the worst offenders, one a row; see `Offenders.table`."""
        return self.offenders.table(most)

    def figure(self) -> Figure:
        """Plot the share of the lenses within a radius against the radius."""
        from dolens.plotting.export import showing

        title = lens_title(self.lens, self.where.object_distance)
        return showing(yields_figure(self.analysis, title, self.weights))

    def offenders_figure(self) -> Figure:
        """Draw the worst offenders as bars."""
        from dolens.plotting.export import showing

        return showing(self.offenders.figure())

    @property
    def heading(self) -> str:
        """Return the radius as designed, and that of nine lenses in ten."""
        count, failed = len(self.analysis.errors), self.analysis.perturbed.failed > 0.0
        text = (
            f"{self.lens.name or 'Lens'}: RMS radius over all spots {number(self.nominal_um, 4)} "
            f"µm as designed; 90 % of {count} lenses within {number(self.radius_of(0.9), 4)} µm"
        )
        lost = int(failed.sum())
        return printable(text + (f"; {lost} fail" if lost else ""))

    @property
    def note(self) -> str:
        """Return what was assumed or left out."""
        return " ".join([*self.offenders.notes, self.offenders.summary(), *self.problems])

    def __repr__(self) -> str:
        """Return the tables as text."""
        shares, worst = self.yield_table(), self.table()
        return "\n\n".join(
            [
                self.heading,
                text_table(shares.heads, shares.rows),
                text_table(worst.heads, worst.rows, worst.words),
                worst.caption,
                self.note,
            ]
        )

    def _repr_html_(self) -> str:
        """Return the tables as HTML, all text escaped."""
        shares, worst = self.yield_table(), self.table()
        return html_table(shares.heads, shares.rows, self.heading) + html_table(
            worst.heads, worst.rows, "Worst offenders", worst.words, f"{worst.caption} {self.note}"
        )


def yields_figure(found: ToleranceAnalysis, title: str, weights: Tensor) -> Figure:
    """Plot yields against the radius over all spots and that of the worst spot.

    Args:
        found: the lenses.
        title: the lens and its aperture.
        weights: (S,), of the spots; they sum to one.
    """
    outcomes = {
        f"{how}, {stage}": outcome.found(stage == "refocused")
        for stage in ("refocused", "not refocused")
        for how, outcome in (("Monte Carlo", found.traced), ("linear", found.linear))
    }
    design = found.sensitivities.rms_refocused.square()
    mean, worst = "RMS radius over all spots", "RMS radius of the worst spot"
    return yield_figure(
        {
            mean: {label: radii.rms for label, radii in outcomes.items()},
            worst: {label: radii.worst for label, radii in outcomes.items()},
        },
        {
            mean: float((design @ weights).sqrt()),
            worst: float(design[weights > 0.0].amax().sqrt()),
        },
        f"{title}\n{len(found.errors)} lenses drawn from the tolerances",
    )


class ToleranceMethods:
    """The method of `Lens` that finds what its tolerances do."""

    def tolerances(
        self,
        tolerances: Source = "default",
        lenses: int = 500,
        fields: FieldPoints | None = None,
        wavelengths: float | Sequence[float] | Tensor | None = None,
        seed: int = 0,
        **aperture: float,
    ) -> LensTolerances:
        """Find yield, sensitivities and worst offenders; the lens stays as it is.

        Sensitivities and offenders are those of `dolens show --tolerances`, by the linear ray
        model; the yield is that of lenses which are drawn and traced exactly.

        Args:
            tolerances: `default`, the usual ones; a YAML file, as `dolens show` takes it; or
                pattern → half-range, as `{"thicknesses.*": 0.02, "elements.*.tilt_[xy]": 0.05}`, mm
                and degrees (see `dolens.tolerancing.tolerances_from`).  Groups of cemented glass
                are elements.
            lenses: how many are drawn.
            fields: numbers along y or points (x, y): degrees, or mm on a near object; None: the
                lens's own.
            wavelengths: nm; None: the lens's own.
            seed: of the errors.
            aperture: `f_number`, or `entrance_pupil_diameter` in mm, that the stop is set to.

        Raises:
            InputError: a tolerance of what the lens does not have, a file that cannot be read, a
                number out of range, or no light of a field passes.

        Example:
            >>> lens = dolens.load_lens("cooke_triplet")
            >>> made = lens.tolerances("default", lenses=100)
            >>> made.nominal_um < made.radius_of(0.5) < made.radius_of(0.9)
            True
            >>> made.table(3).rows[0][0]
            'element 3–4 tilt x'
        """
        check_count("lenses", lenses)
        check_count("seed", seed, 0)
        allowed = ("f_number", "entrance_pupil_diameter")
        check_keys(aperture, allowed, "tolerances()")
        points: Any = fields
        lens = prepared_lens(as_lens(self), points, wavelengths, **aperture)  # type: ignore[arg-type]
        where = conditions(lens)
        with torch.no_grad():
            where, problems = bright_fields(where, spot_diagram(lens, where, _RAYS))
        if not isinstance(tolerances, str | Path | Mapping):
            raise InputError(
                f"tolerances: {tolerances!r}; allowed: 'default', a file, or pattern → half-range"
            )
        try:
            lens, given, notes = tolerances_of(lens, tolerances)
        except InputError as problem:
            raise InputError(problem.whole.removeprefix("--")) from None
        spots, weights = spots_over_field(lens, where)
        generator = torch.Generator().manual_seed(seed)
        found = analyse_tolerances(lens, spots, given, weights, lenses, generator)
        worst = Offenders(given, found.sensitivities, found.contributions, notes)
        return LensTolerances(lens, worst, found, weights, where, tuple(problems))
