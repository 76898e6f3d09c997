"""What photographs of a chart say of a camera: tables, numbers for metrics, and figures."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.alignment.chart import MarkWindows
from dolens.alignment.chart_fit import ChartFit
from dolens.alignment.chart_model import BLUR, ChartModel
from dolens.experiments.poses.accuracy_figures import draw_shares
from dolens.experiments.poses.chart_restoration import ARMS, Judged
from dolens.experiments.poses.pose_results import error_statistics
from dolens.experiments.tables import Row
from dolens.optics.parameter_names import DEGREE, unit_of
from dolens.plotting.style import PAGE, SMALL, colours, draw_title, open_axes, plain_text
from dolens.plotting.tolerances import parameter_label
from dolens.rendering.psf import bin_rays

# An interval of 95 % of a normal distribution.
_WITHIN = 1.959964
# Parts of a combination that are worth a column.
_LEAST_PART = 0.15


def table_unit(name: str) -> tuple[str, float]:
    """Return the unit of a parameter in tables, and the lens's unit in one of it."""
    if name == BLUR:
        return "um2", 1e-6
    last = name.rpartition(".")[2]
    if unit_of(last) is DEGREE:
        return "deg", DEGREE.factor
    if name == "mark_size":
        return "1", 1.0
    return "mm", 1.0


@dataclass(frozen=True)
class FittedSpecimen:
    """A camera, drawn or real, and its fit.

    Attributes:
        number: of the camera, from 1.
        truth: (P,), or NaN where it is not known.
        fit: to all of its photographs.
        seconds: that the fit took.
        judged: its restored photographs; None: none were taken.
    """

    number: int
    truth: Tensor
    fit: ChartFit
    seconds: float
    judged: Judged | None = None

    @property
    def off(self) -> Tensor:
        """Return errors over standard errors, (P,)."""
        return (self.fit.numbers - self.truth) / self.fit.standard_errors

    @property
    def chi_squared_of_errors(self) -> float:
        """Return eᵀ·C⁻¹·e of the errors, C their posterior covariance: P on average if right."""
        error = (self.fit.numbers - self.truth) / self.fit.prior.deviation
        return float(error @ torch.linalg.solve(self.fit.scaled_covariance, error))


def prescription_rows(designed: Tensor, one: FittedSpecimen) -> list[Row]:
    """Return a row for each parameter: found beside its interval, the design and the prior."""
    fit, rows = one.fit, list[Row]()
    errors, sizes = fit.standard_errors.tolist(), fit.prior.deviation.tolist()
    truths, found = one.truth.tolist(), fit.numbers.tolist()
    for place, name in enumerate(fit.prior.names):
        unit, factor = table_unit(name)
        value, error = found[place] / factor, errors[place] / factor
        row: dict[str, float | str] = {
            "parameter": name,
            "unit": unit,
            "design": float(designed[place]) / factor,
        }
        if math.isfinite(truths[place]):
            row["true"] = truths[place] / factor
        rows.append(
            {
                **row,
                "found": value,
                "standard_error": error,
                "low_95": value - _WITHIN * error,
                "high_95": value + _WITHIN * error,
                "prior_deviation": sizes[place] / factor,
                "error_over_prior": errors[place] / sizes[place],
            }
        )
    return rows


def combination_rows(fit: ChartFit) -> list[Row]:
    """Return the posterior's axes, those that the photographs tell least first.

    A row has the axis's standard deviation over the prior's, and the parameters that make it, each
    times its prior's deviation.
    """
    deviations, vectors = fit.combinations()
    rows: list[Row] = []
    for deviation, vector in zip(deviations.tolist(), vectors, strict=True):
        order = vector.abs().argsort(descending=True).tolist()
        parts = [
            f"{float(vector[place]):+.2f} {fit.prior.names[place]}"
            for place in order
            if abs(float(vector[place])) > _LEAST_PART
        ]
        rows.append({"error_over_prior": deviation, "combination": " ".join(parts)})
    return rows


def specimen_rows(specimens: Sequence[FittedSpecimen]) -> list[Row]:
    """Return a row for each camera and parameter, with its error over the standard error."""
    rows: list[Row] = []
    for one in specimens:
        columns = (one.truth, one.fit.numbers, one.fit.standard_errors, one.off)
        for name, *values in zip(
            one.fit.prior.names, *(column.tolist() for column in columns), strict=True
        ):
            true, found, error, off = values
            factor = table_unit(name)[1]
            rows.append(
                {
                    "camera": str(one.number),
                    "parameter": name,
                    "true": true / factor,
                    "found": found / factor,
                    "standard_error": error / factor,
                    "error_over_standard_error": off,
                }
            )
    return rows


def coverage_metrics(specimens: Sequence[FittedSpecimen], of_lens: int) -> dict[str, float]:
    """Return how errors compare with standard errors, over all cameras.

    Args:
        specimens: whose truth is known.
        of_lens: how many parameters, the first, are the lens's.
    """
    off = torch.stack([one.off for one in specimens])
    numbers: dict[str, float] = {}
    for group, part in (("all", off), ("lens", off[:, :of_lens])):
        for key, value in error_statistics(part).items():
            short = key.replace("rms_over_bound", "rms_over_standard_error")
            numbers[f"coverage/{group}/{short}"] = value
    chi = torch.tensor([one.chi_squared_of_errors for one in specimens])
    numbers["coverage/chi_squared_of_errors"] = float(chi.mean()) / off.shape[1]
    for place, name in enumerate(specimens[0].fit.prior.names):
        numbers[f"coverage/rms/{name}"] = float(off[:, place].square().mean().sqrt())
    return numbers


def fit_metrics(specimens: Sequence[FittedSpecimen]) -> dict[str, float]:
    """Return what the fits themselves say, over all cameras."""
    ratio = [one.fit.chi_squared / one.fit.degrees_of_freedom for one in specimens]
    return {
        "fit/cameras": float(len(specimens)),
        "fit/chi_squared_per_freedom": sum(ratio) / len(ratio),
        "fit/converged": sum(one.fit.converged for one in specimens) / len(specimens),
        "cost/fit_s": sum(one.seconds for one in specimens) / len(specimens),
    }


def restored(specimens: Sequence[FittedSpecimen]) -> Tensor:
    """Return PSNRs (cameras, arms, fields), dB, each arm with the ratio of noise over signal that
    is best for it on the tuning photographs, over all cameras and fields.
    """
    seen = [one.judged for one in specimens if one.judged is not None]
    tuning = torch.stack([judged.tuning for judged in seen]).mean((0, 2))
    best = tuning.argmax(-1)
    test = torch.stack([judged.test for judged in seen])
    return torch.stack([test[:, arm, :, ratio] for arm, ratio in enumerate(best.tolist())], 1)


def gain_metrics(specimens: Sequence[FittedSpecimen]) -> dict[str, float]:
    """Return what a restoration gains by the fitted lens's functions, of what the true ones give.

    `gain/share` is the gain of the fit over that of the truth, both summed over cameras and
    fields; its interval is a bootstrap over cameras (95 %).
    """
    if not any(one.judged for one in specimens):
        return {}
    psnr = restored(specimens)
    gains = psnr[:, 1:] - psnr[:, :1]
    numbers = {f"gain/psnr_db/{arm}": float(psnr[:, at].mean()) for at, arm in enumerate(ARMS)}
    numbers["gain/fitted_db"] = float(gains[:, 0].mean())
    numbers["gain/true_db"] = float(gains[:, 1].mean())
    by_camera = gains.mean(2)
    drawn = torch.randint(
        len(gains), (4000, len(gains)), generator=torch.Generator().manual_seed(0)
    )
    shares = by_camera[drawn, 0].sum(1) / by_camera[drawn, 1].sum(1)
    numbers["gain/share"] = float(by_camera[:, 0].sum() / by_camera[:, 1].sum())
    for key, quantile in (("low", 0.025), ("high", 0.975)):
        numbers[f"gain/share_{key}_95"] = float(shares.quantile(quantile))
    for place in range(gains.shape[2]):
        numbers[f"gain/true_db/field_{place + 1}"] = float(gains[:, 1, place].mean())
        numbers[f"gain/fitted_db/field_{place + 1}"] = float(gains[:, 0, place].mean())
    return numbers


def gain_rows(specimens: Sequence[FittedSpecimen]) -> list[Row]:
    """Return a row for each camera whose photographs were restored, and field."""
    judged = [one for one in specimens if one.judged is not None]
    if not judged:
        return []
    return [
        {
            "camera": str(one.number),
            "field": str(field + 1),
            **{f"{arm}_db": float(psnr[at, field]) for at, arm in enumerate(ARMS)},
        }
        for one, psnr in zip(judged, restored(specimens), strict=True)
        for field in range(psnr.shape[1])
    ]


# Half the side of what is drawn of a mark, in widths of its spot.
_SEEN = 4.0


def marks_figure(
    model: ChartModel, windows: MarkWindows, fit: ChartFit, designed: Tensor, title: str
) -> Figure:
    """Draw some marks: photographed, by the fitted model, their difference over the noise, and by
    the design.
    """
    shown = _shown(windows)
    figure = Figure(figsize=(PAGE, 0.55 + 1.65 * len(shown)), layout="constrained")
    grid = figure.subplots(len(shown), 4, squeeze=False)
    landed = model.landed(fit.numbers), model.landed(designed)
    centres, widths = model.spots(fit.numbers, landed[0])
    planned, _ = model.spots(designed, landed[1])
    for row, (photograph, mark) in zip(grid, shown, strict=True):
        half = int(_SEEN * float(widths[photograph, mark]) / windows.pitch) + 2
        x, y = windows.x[photograph, mark], windows.y[photograph, mark]
        part = (
            _part(y, centres[photograph, mark, 1], half),
            _part(x, centres[photograph, mark, 0], half),
        )
        counts = windows.counts[photograph, mark]
        seen = counts[part] - counts.median()
        own = _image(model, fit.numbers, landed[0], x, y, photograph, mark)[part]
        own = own * seen.sum() / own.sum()
        # The design has the mark elsewhere: it is shown as it would be there.
        apart = planned[photograph, mark] - centres[photograph, mark]
        other = _image(model, designed, landed[1], x + apart[0], y + apart[1], photograph, mark)[
            part
        ]
        other = other * seen.sum() / other.sum()
        noise = (own + counts.median().clamp(min=0.0) + windows.read_noise**2).sqrt()
        bright = float(own.max())
        for axes, image, limits, colour in (
            (row[0], seen, (0.0, bright), "viridis"),
            (row[1], own, (0.0, bright), "viridis"),
            (row[2], (seen - own) / noise, (-4.0, 4.0), "RdBu_r"),
            (row[3], other, (0.0, bright), "viridis"),
        ):
            axes.imshow(image.numpy(), vmin=limits[0], vmax=limits[1], cmap=colour, origin="lower")
            axes.set_xticks([])
            axes.set_yticks([])
        row[0].set_ylabel(f"mark {mark + 1}\nphotograph {photograph + 1}", fontsize=SMALL)
    heads = ("photograph", "fitted model", "difference over noise, ±4", "design")
    for axes, head in zip(grid[0], heads, strict=True):
        axes.set_title(head, fontsize=SMALL + 1)
    draw_title(figure, title)
    return figure


def _shown(windows: MarkWindows) -> list[tuple[int, int]]:
    """Return photographs and marks: the first, a middle and the last of each."""
    photographs, marks = windows.counts.shape[:2]
    middle = (photographs // 2, marks // 2)
    pairs = [(0, 0), middle, (photographs // 2, marks - 1), (photographs - 1, 0)]
    return list(dict.fromkeys(pairs))


def _part(middles: Tensor, centre: Tensor, half: int) -> slice:
    """Return the pixels about a place, in a row of pixels' middles (mm)."""
    place = int(((centre - middles[0]) / (middles[1] - middles[0])).round())
    return slice(max(place - half, 0), place + half + 1)


def _image(
    model: ChartModel,
    numbers: Tensor,
    landed: Tensor,
    x: Tensor,
    y: Tensor,
    photograph: int,
    mark: int,
) -> Tensor:
    """Return a mark's light by the model's rays on pixels at x (W,) and y (H,), of any
    brightness.
    """
    points = model.on_sensor(numbers, landed, photograph).points[mark]
    columns = (points[:, 0] - x[0]) / (x[1] - x[0])
    rows = (points[:, 1] - y[0]) / (y[1] - y[0])
    return bin_rays(rows, columns, landed[4, mark], len(y), len(x), 1)


def intervals_figure(fits: Sequence[tuple[int, ChartFit]], title: str) -> Figure:
    """Draw posterior over prior deviations of every parameter, for numbers of photographs."""
    whole = fits[-1][1]
    names = [name for name in whole.prior.names if not name.startswith("planes.")]
    figure = Figure(figsize=(PAGE, 1.2 + 0.19 * len(names)), layout="constrained")
    axes = figure.add_subplot()
    for (count, fit), colour, marker in zip(fits, colours(len(fits)), "osDv^P", strict=False):
        share = dict(
            zip(
                fit.prior.names,
                (fit.standard_errors / fit.prior.deviation).tolist(),
                strict=True,
            )
        )
        axes.plot(
            [share[name] for name in names],
            range(len(names)),
            marker,
            color=colour,
            markersize=4,
            label=f"{count} photograph{'s' if count > 1 else ''}",
        )
    axes.set_yticks(
        range(len(names)), [plain_text(parameter_label(name)) for name in names], fontsize=SMALL
    )
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xscale("log")
    axes.axvline(1.0, color="0.6", linewidth=0.8)
    axes.set_xlabel("standard error over the prior's deviation (no unit)", fontsize=SMALL + 1)
    axes.grid(axis="y", color="0.93")
    axes.legend(fontsize=SMALL, loc="lower left")
    open_axes(axes)
    draw_title(figure, title)
    return figure


def coverage_figure(specimens: Sequence[FittedSpecimen], title: str) -> Figure:
    """Draw every error over its standard error, a row for each parameter."""
    names = specimens[0].fit.prior.names
    off = torch.stack([one.off for one in specimens])
    figure = Figure(figsize=(PAGE, 1.2 + 0.17 * len(names)), layout="constrained")
    axes = figure.add_subplot()
    for row in range(len(names)):
        axes.plot(off[:, row], [row] * len(off), ".", color=colours(1)[0], markersize=4, alpha=0.6)
    labels = [plain_text(parameter_label(name)) for name in names]
    draw_shares(axes, labels, off.unbind(1), SMALL - 1)
    reach = max(3.2, 1.05 * float(off.abs().max()))
    axes.set_xlim(-reach, reach)
    axes.set_xlabel("error over standard error (no unit)", fontsize=SMALL + 1)
    open_axes(axes)
    draw_title(figure, title)
    return figure


def restoration_figure(specimens: Sequence[FittedSpecimen], title: str) -> Figure:
    """Draw what the fitted functions gain against what the true ones do, a point for each camera
    and field.
    """
    psnr = restored(specimens)
    gains = psnr[:, 1:] - psnr[:, :1]
    figure = Figure(figsize=(0.62 * PAGE, 0.6 * PAGE), layout="constrained")
    axes = figure.add_subplot()
    fields = gains.shape[2]
    for field, colour in enumerate(colours(fields)):
        axes.plot(
            gains[:, 1, field],
            gains[:, 0, field],
            "o",
            color=colour,
            markersize=4,
            label=f"field {field + 1}",
        )
    low, high = min(0.0, float(gains.min())), 1.05 * float(gains.max())
    axes.plot([low, high], [low, high], color="0.6", linewidth=0.8)
    axes.set_xlabel(f"gain by the {ARMS[2]} functions over the design's (dB)", fontsize=SMALL + 1)
    axes.set_ylabel(f"gain by the {ARMS[1]} ones (dB)", fontsize=SMALL + 1)
    axes.legend(fontsize=SMALL)
    open_axes(axes)
    draw_title(figure, title)
    return figure
