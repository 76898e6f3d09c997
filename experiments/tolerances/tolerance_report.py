"""Tables and figures of a tolerance analysis: sensitivities, worst offenders, and yield."""

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from dolens.experiments.experiment import Figures
from dolens.experiments.tables import Row
from dolens.lens_page.lens_tolerances import yields_figure
from dolens.optics.text_tables import text_table
from dolens.plotting.style import plain_text
from dolens.plotting.tolerances import (
    matrix_figure,
    offenders_figure,
    parameter_label,
    tolerance_label,
)
from dolens.tolerancing import ToleranceAnalysis, Tolerances

# Parameters that a log is worth.
_MOST = 12


def sensitivity_rows(found: ToleranceAnalysis) -> Iterator[Row]:
    """Yield a row for every parameter and spot: derivatives, and RMS at the tolerance's ends."""
    s, t, spots = found.sensitivities, found.tolerances, found.spots
    scale = 1e3 * per_unit(t)
    motion, rms = s.centroid_jacobian * scale, s.rms_jacobian * scale
    for p, name in enumerate(t.names):
        for spot in range(spots.count):
            yield {
                "parameter": name,
                "unit": t.unit_names[p],
                "field_x": float(spots.fields[spot, 0]),
                "field_y": float(spots.fields[spot, 1]),
                "wavelength_nm": float(spots.wavelengths[spot]),
                "dx_um_per_unit": float(motion[spot, 0, p]),
                "dy_um_per_unit": float(motion[spot, 1, p]),
                "drms_um_per_unit": float(rms[spot, p]),
                "rms_um": 1e3 * float(s.rms[spot]),
                "rms_um_at_minus": 1e3 * float(s.rms_at_ends[0, p, spot]),
                "rms_um_at_plus": 1e3 * float(s.rms_at_ends[1, p, spot]),
                "refocused_rms_um": 1e3 * float(s.rms_refocused[spot]),
                "refocused_rms_um_at_minus": 1e3 * float(s.rms_at_ends_refocused[0, p, spot]),
                "refocused_rms_um_at_plus": 1e3 * float(s.rms_at_ends_refocused[1, p, spot]),
            }


def offender_rows(found: ToleranceAnalysis) -> Iterator[Row]:
    """Yield a row for every parameter, the one that adds most to the mean square radius first."""
    s, t, c = found.sensitivities, found.tolerances, found.contributions
    increase, unfocused = 1e3 * s.increase(), 1e3 * s.increase(refocused=False)
    shift = 1e3 * s.largest_centroid_shift
    for rank, p in enumerate(c.order, 1):
        share = 100.0 if t.unit_names[p] == "%" else 1.0
        yield {
            "rank": rank,
            "parameter": t.names[p],
            "half_range": share * float(t.half_range[p]),
            "unit": t.unit_names[p],
            "distribution": "normal" if bool(t.normal[p]) else "uniform",
            "share_of_increase": float(c.share[p]),
            "mean_square_increase_um2": 1e6 * float(c.increase[p]),
            "mean_square_spread_um2": 1e6 * float(c.spread[p]),
            "rms_increase_um": float(increase[p]),
            "rms_increase_um_not_refocused": float(unfocused[p]),
            "largest_centroid_shift_um": float(shift[p]),
        }


def monte_carlo_rows(found: ToleranceAnalysis) -> Iterator[Row]:
    """Yield a row for every lens: its spots before and after the compensator, and its errors."""
    columns = {}
    for name, outcome in (("", found.traced), ("linear_", found.linear)):
        for stage, squares in (("", outcome.after), ("not_refocused_", outcome.before)):
            columns[f"{name}{stage}rms_um"] = 1e3 * (squares @ outcome.weights).sqrt()
            columns[f"{name}{stage}worst_rms_um"] = 1e3 * squares.amax(-1).sqrt()
        columns[f"{name}refocus_um"] = 1e3 * outcome.refocus
    columns["failed_rays"] = found.perturbed.failed
    columns["vignetted"] = found.perturbed.vignetted
    errors = found.errors / per_unit(found.tolerances)
    for name, unit, column in zip(
        found.tolerances.names, found.tolerances.unit_names, errors.T, strict=True
    ):
        columns[f"{name} [{unit}]" if unit else name] = column
    for numbers in torch.stack(list(columns.values()), -1).tolist():
        yield dict(zip(columns, numbers, strict=True))


def per_unit(tolerances: Tolerances) -> torch.Tensor:
    """Return the table's units in the lens's (P,): π/180 for a degree, c/100 for a per cent."""
    cents = [0.01 if unit == "%" else 1.0 for unit in tolerances.unit_names]
    return tolerances.unit * torch.tensor(cents, dtype=torch.float64)


def offender_text(found: ToleranceAnalysis) -> str:
    """Return the first rows of `offender_rows` as text."""
    heads = ("parameter", "tolerance", "share", "RMS rises, µm", "not refocused", "spot moves, µm")
    rows = [
        (
            str(row["parameter"]),
            f"± {row['half_range']:g} {row['unit']}".strip(),
            f"{100 * row['share_of_increase']:.1f} %",
            f"{row['rms_increase_um']:.3f}",
            f"{row['rms_increase_um_not_refocused']:.3f}",
            f"{row['largest_centroid_shift_um']:.2f}",
        )
        for row, _ in zip(offender_rows(found), range(_MOST), strict=False)
    ]
    return text_table(heads, rows)


_MOST_OFFENDERS = 20
_UNIT_WORDS = {"deg": "µm/°", "mm": "µm/mm", "%": "µm/%", "1/mm": "µm·mm"}


def tolerance_figures(
    found: ToleranceAnalysis, title: str, spots: Sequence[str], weights: Tensor
) -> Figures:
    """Return Jacobians as matrices, yield curves, and the worst offenders.

    Args:
        found: the analysis.
        title: the lens and its aperture; what a figure shows is written below it.
        spots: labels of its S spots.
        weights: (S,), weights of the spots, of sum 1.
    """
    s, t, c = found.sensitivities, found.tolerances, found.contributions
    spots = list(spots)
    blocks = [("x", len(spots)), ("y", len(spots))]
    motion = s.centroid_jacobian.transpose(0, 1).flatten(0, 1)
    labels = [plain_text(parameter_label(parameter)) for parameter in t.names]
    with_tolerance = [tolerance_label(n, t.label(p)) for p, n in enumerate(t.names)]
    scale = 1e3 * per_unit(t)
    first = c.order[:_MOST_OFFENDERS]
    ends = s.rms_at_ends_refocused.square() - s.rms_refocused.square()
    return {
        "centroid_jacobian": lambda: matrix_figure(
            _by_unit(motion * scale, labels, t.unit_names),
            spots * 2,
            blocks,
            f"{title}\nhow spots move: Jacobian of their centroids, rays over the whole stop",
        ),
        "centroid_by_tolerance": lambda: matrix_figure(
            {"motion (µm)": (1e3 * motion * s.steps, with_tolerance)},
            spots * 2,
            blocks,
            f"{title}\nhow far a whole tolerance moves spots, rays over the whole stop",
        ),
        "rms_jacobian": lambda: matrix_figure(
            _by_unit(s.rms_jacobian * scale, labels, t.unit_names),
            spots,
            title=f"{title}\nJacobian of the spots' RMS radii, rays over the whole stop",
        ),
        "rms_by_tolerance": lambda: matrix_figure(
            {
                "growth of RMS to first order, not refocused (µm)": (
                    1e3 * s.rms_jacobian * s.steps,
                    with_tolerance,
                ),
                "RMS² at the worse end less that as designed, refocused (µm²)": (
                    1e6 * ends.amax(0).T,
                    with_tolerance,
                ),
            },
            spots,
            title=f"{title}\nwhat a whole tolerance does to the spots' RMS radii",
        ),
        "yield": lambda: yields_figure(found, title, weights),
        "worst_offenders": lambda: offenders_figure(
            [with_tolerance[p] for p in first],
            c.share[first].tolist(),
            {
                "refocused": s.increase()[first].tolist(),
                "not refocused": s.increase(refocused=False)[first].tolist(),
            },
            f"{title}\nworst offenders",
        ),
    }


def _by_unit(
    matrix: Tensor, labels: list[str], units: tuple[str, ...]
) -> dict[str, tuple[Tensor, list[str]]]:
    """Return a panel for each unit, since numbers of several units share no scale."""
    panels = {}
    for unit in dict.fromkeys(units):
        columns = [p for p, other in enumerate(units) if other == unit]
        panels[_UNIT_WORDS.get(unit, "µm per unit")] = (
            matrix[:, torch.tensor(columns)],
            [labels[p] for p in columns],
        )
    return panels
