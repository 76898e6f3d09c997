"""Coverage of pose bounds when measurements have effects that the fit's model lacks."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.alignment.unmodelled import Unmodelled, unmodelled_of
from dolens.errors import InputError, check_choice
from dolens.experiments.experiment import Analysis, Figures
from dolens.experiments.poses.accuracy_figures import draw_shares
from dolens.experiments.poses.fitting import Estimates, probability
from dolens.experiments.poses.misalignment import MisalignmentModule
from dolens.experiments.poses.pose_results import error_statistics
from dolens.experiments.tables import Row
from dolens.plotting.layout import lens_title
from dolens.plotting.style import (
    PAGE,
    SMALL,
    colours,
    draw_axes_title,
    legend_below,
    number_text,
    open_axes,
)
from dolens.tasks import TaskMap
from dolens.tasks import stage as named_stage

logger = logging.getLogger(__name__)


class PoseCoverageModule(Analysis, MisalignmentModule):
    """Compares errors of poses with their bounds over many measurements, case by case.

    Nothing is fitted from afar.  Every measurement's estimate is found by Gauss-Newton steps from
    the truth, which is where a fit weighted by noise ends (see
    `dolens.experiments.poses.fitting`), and fits hold what the measurement's own earlier fit
    found.  The first measurement, of number 0, is
    the one that `misalignment` fits with the same seed.

    Args:
        cases: name → settings of `Unmodelled`, and `fits`, names of those that the case is worked
            out for (default: all).
        draws: measurements of each fit and case.
        module: settings of `MisalignmentModule`.

    Raises:
        InputError: a setting that is unknown or out of range, or a fit without a truth.
    """

    metrics = (
        "coverage/*/*",
        "pose_rms_error/*",
        "pose_rms_over_bound/*",
    )

    def __init__(
        self, cases: Mapping[str, Mapping[str, Any] | None], draws: int, **module: Any
    ) -> None:
        super().__init__(**module)
        if draws < 2:
            raise InputError(f"draws: {draws}; allowed: 2 or more")
        if not cases or self.observations.photograph is not None:
            raise InputError("cases: give at least one, and no photograph in `measurement`")
        if self.light.unmodelled != Unmodelled():
            raise InputError("unmodelled: effects are those of `cases` here; leave it at its zeros")
        self.draws, names = int(draws), [fit.name for fit in self.fits]
        self.cases: dict[str, tuple[Unmodelled, tuple[str, ...]]] = {}
        for name, entry in cases.items():
            settings = dict(entry or {})
            fits = tuple(str(fit) for fit in settings.pop("fits", names))
            self.cases[name] = (unmodelled_of(settings, f"cases.{name}"), fits)
            for fit in fits:
                check_choice(fit, names, f"cases.{name}.fits")
                needed = self.fits[names.index(fit)].held_from
                if needed is not None and needed not in fits:
                    raise InputError(f"cases.{name}.fits: '{fit}' holds what '{needed}' finds")
        for number, pose in enumerate(self.poses):
            truth = self.truth(number)
            missing = [name for name in pose.names if name not in truth]
            if missing:
                raise InputError(f"fits.{names[number]}.truth: '{missing[0]}' is missing")
            with torch.no_grad():
                true = torch.tensor([truth[name] for name in pose.names], dtype=torch.float64)
                pose.scaled.copy_(true / pose.file_scale)
        self.found: dict[tuple[str, str], Estimates] = {}
        self.rows: list[Row] = []
        self.draw_rows: list[Row] = []

    @torch.no_grad()
    def analyse(self) -> dict[str, float]:
        """Estimate, case by case; tables are written after each."""
        for number, fit in enumerate(self.fits):
            self._hold(number)
            self.information[fit.name] = self._information(number)
        with self.workers.open() as map_tasks:
            for case in self.cases:
                try:
                    with named_stage(f"case: {case}"):
                        self._work_out(case, map_tasks)
                finally:
                    self.write_tables()
        return self._metrics()

    def tables(self) -> dict[str, list[Row]]:
        """Return `coverage`, a row for each variable, and `draws`, a row for each measurement."""
        return {"coverage": self.rows, "draws": self.draw_rows}

    def figures(self) -> Figures:
        """Return `errors_over_bounds`."""
        return {"errors_over_bounds": self._figure}

    def _figure(self) -> Figure:
        errors = {
            case: {fit: self.over_bound(case, fit) for fit in fits}
            for case, (_, fits) in self.cases.items()
        }
        title = f"{lens_title(self.lens)}\nerrors over bounds, {self.draws} measurements"
        return coverage_figure(errors, [fit.name for fit in self.fits], title)

    def over_bound(self, case: str, fit: str) -> Tensor:
        """Return errors over bounds (M, P), for the measurements whose estimates have settled."""
        found = self.found[case, fit]
        return self._every(case, fit)[found.settled]

    def _every(self, case: str, fit: str) -> Tensor:
        """Return errors over their bounds (draws, P), for all measurements."""
        number = self.plan.number(fit)
        pose, truth = self.poses[number], self.truth(number)
        true = torch.tensor([truth[name] for name in pose.names], dtype=torch.float64)
        return (self.found[case, fit].values - true) * pose.units / self.information[fit].bounds

    def _metrics(self) -> dict[str, float]:
        numbers: dict[str, float] = {}
        for row in self.rows:
            name = f"{row['case']}/{row['fit']}/{row['variable']}"
            numbers[f"pose_rms_error/{name}"] = float(row["rms_error"])
            numbers[f"pose_rms_over_bound/{name}"] = float(row["rms_over_bound"])
        for case, (_, fits) in self.cases.items():
            together = torch.cat([self.over_bound(case, fit).flatten() for fit in fits])
            for key, value in error_statistics(together).items():
                numbers[f"coverage/{case}/{key}"] = value
            freedom = sum(len(self.poses[self.plan.number(fit)].names) for fit in fits)
            total = torch.stack([self.found[case, fit].chi_squared for fit in fits]).sum(0)
            settled = torch.stack([self.found[case, fit].settled for fit in fits])
            numbers[f"coverage/{case}/chi_squared"] = float(total[settled.all(0)].mean()) / freedom
            first = probability(total[:1], freedom)
            numbers[f"coverage/{case}/first_draw_probability"] = float(first)
            numbers[f"coverage/{case}/unsettled"] = float((~settled).sum())
        return numbers

    def _work_out(self, case: str, map_tasks: TaskMap) -> None:
        effects, fits = self.cases[case]
        light = replace(self.light, unmodelled=effects)
        earlier: dict[str, Estimates] = {}
        for number, fit in enumerate(self.fits):
            if fit.name not in fits:
                continue
            self._hold(number)
            found = self._estimates(number, range(self.draws), light, earlier, map_tasks)
            earlier[fit.name] = self.found[case, fit.name] = found
            self.rows += self._variable_rows(case, fit.name)
            freedom = len(self.poses[number].names)
            chances = probability(found.chi_squared, freedom)
            self.draw_rows += [
                {
                    "case": case,
                    "fit": fit.name,
                    "draw": draw,
                    "chi_squared": float(chi),
                    "degrees_of_freedom": freedom,
                    "probability": float(chance),
                    "settled": str(bool(settled)),
                    **{
                        f"{name} over bound": float(off)
                        for name, off in zip(
                            self.poses[number].names,
                            self._every(case, fit.name)[draw],
                            strict=True,
                        )
                    },
                }
                for draw, (chi, chance, settled) in enumerate(
                    zip(found.chi_squared, chances, found.settled, strict=True)
                )
            ]
            off = error_statistics(self.over_bound(case, fit.name))
            logger.info(
                "%s, fit %s: errors of %.3g bounds (RMS); within one bound %.0f %%, within two "
                "%.0f %%; chi-squared of a degree of freedom %.3g",
                case,
                fit.name,
                off["rms_over_bound"],
                100.0 * off["within_1"],
                100.0 * off["within_2"],
                float(found.chi_squared[found.settled].mean()) / freedom,
            )

    def _variable_rows(self, case: str, fit: str) -> list[Row]:
        """Return rows of coverage.csv, one for each variable."""
        pose = self.poses[self.plan.number(fit)]
        bounds = (self.information[fit].bounds / pose.units).tolist()
        rows: list[Row] = []
        for name, bound, off in zip(
            pose.names, bounds, self.over_bound(case, fit).unbind(-1), strict=True
        ):
            rows.append(
                {
                    "case": case,
                    "fit": fit,
                    "variable": name,
                    "measurements": len(off),
                    "bound": bound,
                    "mean_error": bound * float(off.mean()),
                    "rms_error": bound * float(off.square().mean().sqrt()),
                    **error_statistics(off),
                }
            )
        return rows


def coverage_figure(
    errors: Mapping[str, Mapping[str, Tensor]], names: Sequence[str], title: str
) -> Figure:
    """Draw a row for each case: every error over its bound, in a colour for each fit.

    One bound and two are shaded; at the right are the shares of errors within them.

    Args:
        errors: case → fit → errors over their bounds.
        names: all fits, also those that no case has.
        title: the title.
    """
    figure = Figure(figsize=(PAGE, 1.7 + 0.7 * len(errors)), layout="constrained")
    axes = figure.add_subplot()
    for row, fits in enumerate(errors.values()):
        for fit, found in fits.items():
            off, place = found.flatten(), names.index(fit)
            level = row + 0.5 * ((place + 0.5) / len(names) - 0.5)
            axes.plot(
                off,
                torch.full_like(off, level),
                ".",
                color=colours(len(names))[place],
                markersize=3,
                markeredgewidth=0.0,
                alpha=0.6,
                label=f"fit {fit}" if row == 0 else None,
            )
    together = [torch.cat([off.flatten() for off in fits.values()]) for fits in errors.values()]
    draw_shares(axes, [case.replace("_", " ") for case in errors], together)
    axes.set_xscale("symlog", linthresh=3.0)
    axes.set_xlabel("error over Cramér–Rao bound (no unit)", fontsize=SMALL + 1)
    draw_axes_title(axes, title)
    open_axes(axes)
    reach = max(abs(limit) for limit in axes.get_xlim())
    powers = [10.0**power for power in range(1, 9) if 10.0**power <= reach]
    ticks = [-p for p in reversed(powers)] + [-2.0, -1.0, 0.0, 1.0, 2.0] + powers
    axes.set_xticks(ticks, [number_text(tick) for tick in ticks])
    axes.set_xticks([], minor=True)
    handles, labels = axes.get_legend_handles_labels()
    legend_below(figure, handles, 6, labels, 2.0)
    return figure
