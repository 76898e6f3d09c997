"""The results of an alignment: numbers for metrics, a table of cases, and a figure."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from dolens.alignment.element_fit import POSE
from dolens.alignment.moments import Pixels
from dolens.experiments.tables import Row
from dolens.plotting.style import (
    DASHES,
    PAGE,
    SMALL,
    TITLE,
    colours,
    draw_title,
    log_ticks,
    ruled_axes,
)

# Numbers of a case as tables have them, of the element's pose and of the sensor's place.
COLUMNS = ("tilt_x_deg", "tilt_y_deg", "decenter_x_um", "decenter_y_um")
SENSOR_COLUMNS = {
    "sensor_x": "sensor_x_um",
    "sensor_y": "sensor_y_um",
    "sensor_distance": "focus_um",
}


@dataclass(frozen=True)
class Alignment:
    """Holds K misaligned lenses and what was found of them, in degrees and µm; the demo is the
    first.

    P numbers describe a case: tilts and decentres of its element, and what of the sensor's place
    is unknown.

    Attributes:
        elements: E names.
        columns: P names, `COLUMNS` and those of the sensor.
        element: (K,), number of the element that is off.
        true: (K, P).
        named: (K,), number of the element that fits best.
        found: (K, P), in the fit of that element.
        chi_squared: (E, K), of each element's fit.
        share: (E, K), of each hypothesis in the posterior.
        bound: (K, P), least standard deviations, were the element known.
        bound_ratio: (K, 4), the pose's bounds over those with the sensor's place known.
        correlation: (K, P, P), of the bound's covariance.
        converged: share of the fits of named elements that came to rest.
        seconds: of the fits of all hypotheses.
        checks: other numbers, by name, of what the model leaves out.
    """

    elements: Sequence[str]
    columns: Sequence[str]
    element: Tensor
    true: Tensor
    named: Tensor
    found: Tensor
    chi_squared: Tensor
    share: Tensor
    bound: Tensor
    bound_ratio: Tensor
    correlation: Tensor
    converged: float
    seconds: float
    checks: dict[str, float]

    @property
    def right(self) -> Tensor:
        """Return whether the element that is off is the one named, (K,), bool."""
        return self.named == self.element

    def errors(self, columns: slice) -> Tensor:
        """Return errors (K,) of the whole lens's pose: lengths of the difference over these columns
        of all elements.

        A wrong name counts with what it invents and with what it misses.
        """
        difference = self.true.new_zeros(len(self.true), len(self.elements), len(POSE))
        rows = torch.arange(len(self.true))
        difference[rows, self.named] += self.found[:, : len(POSE)]
        difference[rows, self.element] -= self.true[:, : len(POSE)]
        return difference[..., columns].flatten(1).norm(dim=1)

    def summary(self) -> dict[str, float]:
        """Return numbers for metrics.json, of the batch without the demo."""
        right = self.right[1:]
        numbers = {"alignment/named_right": float(right.double().mean())}
        for name, columns in (("tilt_deg", slice(0, 2)), ("decenter_um", slice(2, 4))):
            errors = self.errors(columns)
            numbers[f"pose_error/demo/{name}"] = float(errors[0])
            bound = self.bound[1:, columns].norm(dim=1)
            numbers[f"pose_bound/{name}/median"] = float(bound.median())
            for kind, chosen in (("", right), ("_all", torch.ones_like(right))):
                # Where no element is named right there is nothing to tell; NaN says so.
                some = errors[1:][chosen] if bool(chosen.any()) else errors.new_full((1,), math.nan)
                numbers[f"pose_error/{name}/median{kind}"] = float(some.quantile(0.5))
                numbers[f"pose_error/{name}/p95{kind}"] = float(some.quantile(0.95))
        for at, column in enumerate(self.columns[len(POSE) :], len(POSE)):
            errors = (self.found - self.true)[1:, at].abs()
            numbers[f"sensor_error/{column}/median_all"] = float(errors.quantile(0.5))
            numbers[f"sensor_error/{column}/p95_all"] = float(errors.quantile(0.95))
            numbers[f"sensor_bound/{column}/median"] = float(self.bound[1:, at].median())
        own = self.chi_squared[self.element, torch.arange(len(self.true))][1:]
        numbers["alignment/chi_squared/mean"] = float(own.mean())
        numbers["alignment/converged"] = self.converged
        for number in range(len(self.elements)):
            numbers |= self._of_element(number)
        return numbers | self.checks | {"cost/batch_s": self.seconds}

    def _of_element(self, number: int) -> dict[str, float]:
        """Return numbers of the cases where this element is off and is named."""
        element = self.elements[number]
        mine = (self.element == number) & self.right
        mine[0] = False
        numbers: dict[str, float] = {}
        if not bool(mine.any()):
            return numbers
        ratio = (self.found - self.true)[mine] / self.bound[mine]
        for at, column in enumerate(self.columns):
            kind = "pose_bound" if at < len(POSE) else "sensor_bound"
            numbers[f"{kind}/{element}/{column}"] = float(self.bound[mine, at].median())
            rms = float(ratio[:, at].square().mean().sqrt())
            numbers[f"alignment/error_over_bound/{element}/{column}"] = rms
        for at, column in enumerate(COLUMNS):
            lost = float(self.bound_ratio[mine, at].median())
            numbers[f"alignment/bound_ratio/{element}/{column}"] = lost
        # A tilt about x and a decentre along y move light in the same plane.
        for first, second in ((0, 3), (1, 2)):
            name = f"alignment/correlation/{element}/{POSE[first]}_{POSE[second]}"
            numbers[name] = float(self.correlation[mine, first, second].median())
        return numbers

    def rows(self) -> list[Row]:
        """Return rows of alignment.csv: the demo, and the batch."""
        rows: list[Row] = []
        for k in range(len(self.true)):
            element, named = int(self.element[k]), int(self.named[k])
            row: dict[str, float | str] = {
                "case": "demo" if k == 0 else str(k),
                "true_element": self.elements[element],
                "named_element": self.elements[named],
                "share": float(self.share[named, k]),
            }
            for what in ("true", "found", "bound"):
                values = getattr(self, what)[k].tolist()
                row |= {f"{what}_{c}": v for c, v in zip(self.columns, values, strict=True)}
            chi_squared = self.chi_squared[:, k].tolist()
            row |= {f"chi2_{e}": v for e, v in zip(self.elements, chi_squared, strict=True)}
            rows.append(row)
        return rows

    def verdict(self) -> str:
        """Return one line for a log."""
        n = self.summary()
        true, named = (self.elements[int(which[0])] for which in (self.element, self.named))
        return (
            f"demo: {true} is off, {named} is named, errors {n['pose_error/demo/tilt_deg']:.2g}° "
            f"and {n['pose_error/demo/decenter_um']:.2g} µm; of {len(self.true) - 1} others "
            f"{100.0 * n['alignment/named_right']:.1f} % are named right, median errors "
            f"{n['pose_error/tilt_deg/median_all']:.2g}° and "
            f"{n['pose_error/decenter_um/median_all']:.2g} µm, 95 % within "
            f"{n['pose_error/tilt_deg/p95_all']:.2g}° and "
            f"{n['pose_error/decenter_um/p95_all']:.2g} µm ({self.seconds:.1f} s)"
        )


_PANELS = (("tilt", slice(0, 2), "°"), ("decentre", slice(2, 4), "µm"))


@dataclass(frozen=True)
class Setup:
    """Describes the simulated measurement, for titles and lines.

    Attributes:
        lens: its name and aperture.
        fields: the number of fields.
        photons: photons of each spot.
        pixels: pixels of the sensor; None: an ideal one.
        sensor: the parts of the sensor's place that are unknown.
    """

    lens: str
    fields: int
    photons: float
    pixels: Pixels | None
    sensor: Sequence[str]


def alignment_figure(found: Alignment, setup: Setup) -> Figure:
    """Draw elements misaligned against elements named, and errors beside their bounds.

    Where the place of the sensor is unknown, its own errors are beside them.
    """
    unknown = bool(setup.sensor)
    figure = Figure(figsize=(PAGE, 6.4), layout="constrained")
    grid = figure.subplots(2, 2).flatten()
    _confusion(grid[0], found)
    for axes, (name, columns, unit) in zip(grid[1:], _PANELS, strict=False):
        _errors(axes, found, name, columns, unit, unknown)
    if unknown:
        _sensor_errors(grid[3], found, setup.sensor)
    grid[3].set_visible(unknown)
    for axes, letter in zip(grid, "abcd", strict=True):
        axes.set_title(f"({letter})", loc="left", fontsize=SMALL + 1, fontweight="bold")
    photons = f"{setup.photons:_.0f}".replace("_", "\N{NARROW NO-BREAK SPACE}")
    draw_title(
        figure,
        f"{setup.lens}\n{len(found.element) - 1} misalignments from {setup.fields} fields"
        f", {photons} photons a spot{_sensor(setup)}",
    )
    return figure


def _sensor(setup: Setup) -> str:
    """Return the pixels and the unknown parts of their place, for the title."""
    pixels, unknown = setup.pixels, setup.sensor
    text = ""
    if pixels is not None:
        text = f"\n{1e3 * pixels.pitch:.3g} µm pixels, {pixels.read_noise:.3g} e⁻ read noise"
    if unknown:
        shift, focus = "sensor_x" in unknown, "sensor_distance" in unknown
        what = " and ".join(["shift"] * shift + ["focus"] * focus)
        text += f"{', ' if text else chr(10)}sensor's {what} unknown"
    return text


def _confusion(axes: Axes, found: Alignment) -> None:
    names = found.elements
    count = len(names)
    # The demo is a case of its own, not of the batch.
    pairs = (found.element * count + found.named)[1:]
    table = torch.bincount(pairs, minlength=count * count).reshape(count, count)
    share = table / table.sum(1, keepdim=True).clamp(min=1)
    axes.imshow(share.numpy(), cmap="Blues", vmin=0.0, vmax=1.0)
    for row in range(count):
        for column in range(count):
            pale = float(share[row, column]) > 0.5
            text = str(int(table[row, column]))
            colour = "white" if pale else "black"
            axes.text(column, row, text, ha="center", va="center", color=colour, fontsize=TITLE)
    axes.set_xticks(range(count), names, fontsize=SMALL)
    axes.set_yticks(range(count), names, fontsize=SMALL)
    axes.set_xlabel("element named", fontsize=SMALL + 1)
    axes.set_ylabel("element misaligned", fontsize=SMALL + 1)


def _errors(
    axes: Axes, found: Alignment, name: str, columns: slice, unit: str, sensor_unknown: bool
) -> None:
    errors = found.errors(columns)
    # The expected square of the error's length is the sum of the variances.
    bound = found.bound[:, columns].norm(dim=1)
    known = (found.bound[:, :4] / found.bound_ratio)[:, columns].norm(dim=1)
    batch = torch.arange(len(errors)) > 0
    for number, (element, colour) in enumerate(
        zip(found.elements, colours(len(found.elements)), strict=True)
    ):
        mine = batch & (found.element == number)
        if not bool(mine.any()):
            continue
        _spread(axes, errors[mine], bound[mine], colour, element, DASHES[number % 2 * 3])
        if sensor_unknown:
            median = float(known[mine].median())
            axes.axvline(median, color=colour, linewidth=1.0, linestyle="--")
    _finish(axes, f"error of the {name} ({unit})", sensor_unknown)


def _sensor_errors(axes: Axes, found: Alignment, sensor: Sequence[str]) -> None:
    """Draw the errors of all elements together: the length across the axis, and along it."""
    pose = len(COLUMNS)
    difference = (found.found - found.true)[1:, pose:]
    bound = found.bound[1:, pose:]
    along = torch.tensor([name == "sensor_distance" for name in sensor])
    for chosen, colour, name in ((~along, "0.2", "shift"), (along, "0.6", "focus")):
        if bool(chosen.any()):
            errors = difference[:, chosen].norm(dim=1)
            _spread(axes, errors, bound[:, chosen].norm(dim=1), colour, name)
    _finish(axes, "error of the sensor's place (µm)", False)


def _spread(
    axes: Axes, errors: Tensor, bound: Tensor, colour: str, label: str, dashes: object = "-"
) -> None:
    """Draw how many of (K,) errors are below each, and the median of their bounds."""
    ordered = errors.sort().values.clamp(min=1e-12)
    share = 100.0 * torch.arange(1, len(ordered) + 1) / len(ordered)
    axes.plot(
        ordered.numpy(), share.numpy(), color=colour, linestyle=dashes, linewidth=1.5, label=label
    )
    axes.axvline(float(bound.median()), color=colour, linewidth=1.0, linestyle=":")


def _finish(axes: Axes, label: str, known: bool) -> None:
    axes.plot([], [], color="0.4", linewidth=1.0, linestyle=":", label="bound on the RMS")
    if known:
        axes.plot([], [], color="0.4", linewidth=1.0, linestyle="--", label="with the sensor known")
    axes.set_xscale("log")
    axes.set_ylim(0.0, 101.0)
    axes.set_xlabel(label, fontsize=SMALL + 1)
    axes.set_ylabel("share of misalignments (%)", fontsize=SMALL + 1)
    ruled_axes(axes)
    log_ticks(axes.xaxis)
    # Below the axes: lines of bounds cross all of them.
    axes.legend(
        frameon=False, fontsize=SMALL, loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2
    )
