"""Tables of a tolerance analysis, in the units of files: degrees, mm, per cent, and µm."""

from collections.abc import Iterator, Sequence

import torch

from dolens.experiments.tables import Row
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
    widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
    return "\n".join(_line(row, widths) for row in (heads, *rows))


def _line(row: Sequence[str], widths: Sequence[int]) -> str:
    cells = [row[0].ljust(widths[0])]
    cells += [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
    return "  ".join(cells).rstrip()
