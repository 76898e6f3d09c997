"""What a pose fit found, as rows of a table and as metrics: errors, bounds, spread, coverage."""

import math
from collections.abc import Mapping, Sequence

from torch import Tensor

from dolens.alignment.information import Knowledge
from dolens.alignment.pose import Pose
from experiments.tables import Row

# Of a normal distribution, 95 % lies within so many standard deviations.
_WITHIN = 1.959964


def pose_rows(
    fit: str, pose: Pose, initial: Tensor, known: Knowledge, truth: Mapping[str, float]
) -> list[Row]:
    """A row for each variable, in degrees and mm.

    Args:
        fit: its name.
        pose: what was found.
        initial: (P,), the point u where it began.
        known: of the pose.
        truth: by name; NaN stands for what is not known.

    Returns:
        `true`, `initial`, `found`, `error`, `bound`, and `own_bound`, which would be the bound if
        all that the fit holds were exact.
    """
    begun = (initial * pose.scale_in_units).tolist()
    bounds = (known.bounds / pose.units).tolist()
    own = (known.own_covariance.diagonal().sqrt() / pose.units).tolist()
    rows: list[Row] = []
    for place, (name, value) in enumerate(pose.found().items()):
        true = truth.get(name, math.nan)
        rows.append(
            {
                "fit": fit,
                "variable": name,
                "true": true,
                "initial": begun[place],
                "found": value,
                "error": value - true,
                "bound": bounds[place],
                "own_bound": own[place],
            }
        )
    return rows


def pose_metrics(rows: Sequence[Row]) -> dict[str, float]:
    """`pose/<fit>/<variable>`, `pose_bound/...` and, where there is a truth, `pose_error/...`."""
    numbers: dict[str, float] = {}
    for row in rows:
        name = f"{row['fit']}/{row['variable']}"
        numbers[f"pose/{name}"], numbers[f"pose_bound/{name}"] = row["found"], row["bound"]
        if math.isfinite(row["error"]):
            numbers[f"pose_error/{name}"] = abs(row["error"])
    return numbers


def error_over_bound(rows: Sequence[Row]) -> float | None:
    """Root mean square over all variables with a truth; None where there are none."""
    ratios = [row["error"] / row["bound"] for row in rows if math.isfinite(row["error"])]
    return math.sqrt(sum(r * r for r in ratios) / len(ratios)) if ratios else None


def spread_metrics(
    fit: str,
    names: Sequence[str],
    estimates: Tensor,
    bounds: Tensor,
    truth: Mapping[str, float],
) -> dict[str, float]:
    """How estimates from M measurements scatter: `pose_spread_over_bound/<fit>/<variable>`, which
    has a standard error of 1/√(2M); `pose_bias_over_bound/...` of their mean, 1/√M; and
    `pose_coverage/...`, the share of 95 % intervals (± 1.96 bounds) that hold the truth.

    Args:
        fit: its name.
        names: of P variables.
        estimates: (M, P), M of 2 or more.
        bounds: (P,), in their units.
        truth: by name.
    """
    numbers: dict[str, float] = {}
    spread = estimates.std(0) / bounds
    for place, name in enumerate(names):
        numbers[f"pose_spread_over_bound/{fit}/{name}"] = float(spread[place])
        if name in truth:
            off = (estimates[:, place] - truth[name]) / bounds[place]
            numbers[f"pose_bias_over_bound/{fit}/{name}"] = float(off.mean())
            numbers[f"pose_coverage/{fit}/{name}"] = float((off.abs() < _WITHIN).double().mean())
    return numbers
