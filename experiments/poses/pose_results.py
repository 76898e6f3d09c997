"""The results of a pose fit are rows of a table and metrics: errors, bounds, spread, coverage."""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from dolens.alignment.information import FisherInformation
from dolens.alignment.pose import Pose
from dolens.experiments.poses.fit_plan import Stage
from dolens.experiments.tables import Row

# Of a normal distribution, 95 % lies within so many standard deviations.
_WITHIN = 1.959964


def history_row(
    fit: str,
    place: int,
    stage: Stage,
    pose: Pose,
    terms: Mapping[str, Tensor],
    optimizer: torch.optim.Optimizer,
    seconds: float,
) -> dict[str, float | str]:
    """Return a row of history.csv: an iteration, with the values that it reached.

    Args:
        fit: its name.
        place: number of the stage, from 0.
        stage: its settings.
        pose: after the iteration.
        terms: of the loss, by name.
        optimizer: of the stage, whose damping is told where it has one.
        seconds: that the iteration took.
    """
    row: dict[str, float | str] = {
        "fit": fit,
        "stage": place + 1,
        "optimizer": stage.optimizer,
        "loss": float(sum(terms.values())),
        **{f"loss/{name}": float(value) for name, value in terms.items()},
        **pose.file_values(),
        "seconds": seconds,
    }
    last = getattr(optimizer, "last", None)
    if last is not None:
        row["damping"] = last.damping
    return row


def pose_rows(
    fit: str,
    pose: Pose,
    initial: Tensor,
    information: FisherInformation,
    truth: Mapping[str, float],
) -> list[Row]:
    """Return a row for each variable, in degrees and mm.

    Args:
        fit: its name.
        pose: what was found.
        initial: (P,), the point u where it began.
        information: on the pose.
        truth: by name; NaN stands for what is not known.

    Returns:
        `true`, `initial`, `found`, `error`, `bound`, and `own_bound`, which would be the bound if
        all that the fit holds were exact.
    """
    begun = (initial * pose.file_scale).tolist()
    bounds = (information.bounds / pose.units).tolist()
    own = (information.own_covariance.diagonal().sqrt() / pose.units).tolist()
    rows: list[Row] = []
    for place, (name, value) in enumerate(pose.file_values().items()):
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
    """Return `pose/<fit>/<variable>`, `pose_bound/...` and, where there is a truth,
    `pose_error/...`.
    """
    numbers: dict[str, float] = {}
    for row in rows:
        name = f"{row['fit']}/{row['variable']}"
        numbers[f"pose/{name}"], numbers[f"pose_bound/{name}"] = row["found"], row["bound"]
        if math.isfinite(row["error"]):
            numbers[f"pose_error/{name}"] = abs(row["error"])
    return numbers


def error_over_bound(rows: Sequence[Row]) -> float | None:
    """Return the root mean square over all variables with a truth; None where there are none."""
    ratios = [row["error"] / row["bound"] for row in rows if math.isfinite(row["error"])]
    return math.sqrt(sum(r * r for r in ratios) / len(ratios)) if ratios else None


def spread_columns(
    rows: Sequence[Row],
    names: Sequence[str],
    estimates: Tensor,
    bounds: Tensor,
    truth: Mapping[str, float],
) -> list[Row]:
    """Return rows of `pose_rows` with what estimates from M measurements say of each variable.

    Further columns are `measurements`, their number; `rms_over_bound` of the errors; and
    `within_1`, `within_2` and `within_95`, the shares of them within one bound, within two, and
    within 1.96.  A normal error without bias has 0.683, 0.954 and 0.95 there.

    Args:
        rows: of the fit.
        names: of P variables.
        estimates: (M, P).
        bounds: (P,), in their units.
        truth: by name.
    """
    wide: list[Row] = []
    for place, (row, name) in enumerate(zip(rows, names, strict=True)):
        off = (estimates[:, place] - truth.get(name, math.nan)) / bounds[place]
        wide.append({**row, "measurements": float(len(off)), **error_statistics(off)})
    return wide


def error_statistics(off: Tensor) -> dict[str, float]:
    """Return the root mean square of errors over their bounds, and how many of them lie within some
    bounds.

    Args:
        off: of any shape; NaN where there is no truth.
    """
    within = {"within_1": 1.0, "within_2": 2.0, "within_95": _WITHIN}
    shares = {key: float((off.abs() < times).double().mean()) for key, times in within.items()}
    known = bool(off.isfinite().all())
    return {
        "rms_over_bound": float(off.square().mean().sqrt()),
        **{key: share if known else math.nan for key, share in shares.items()},
    }


def spread_metrics(
    fit: str,
    names: Sequence[str],
    estimates: Tensor,
    bounds: Tensor,
    truth: Mapping[str, float],
) -> dict[str, float]:
    """Return how estimates from M measurements scatter.

    The numbers are `pose_spread_over_bound/<fit>/<variable>`, which has a standard error of
    1/√(2M); `pose_bias_over_bound/...` of their mean, 1/√M; `pose_coverage/...`, the share of 95 %
    intervals (± 1.96 bounds) that hold the truth; and `pose_within_1_bound/...` and
    `pose_within_2_bounds/...`, of narrower and wider ones.

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
            found = error_statistics(off)
            numbers[f"pose_coverage/{fit}/{name}"] = found["within_95"]
            numbers[f"pose_within_1_bound/{fit}/{name}"] = found["within_1"]
            numbers[f"pose_within_2_bounds/{fit}/{name}"] = found["within_2"]
    return numbers
