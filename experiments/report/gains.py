"""The gain of one camera over another, with its interval."""

from collections.abc import Mapping

from dolens.experiments.camera.photograph_gain import paired_gain
from dolens.experiments.camera.photograph_scores import read_scores, statistics_of
from dolens.experiments.report.plan import Comparison
from dolens.experiments.report.results import Result

_METRIC = "psnr_db"


def compared(
    comparisons: tuple[Comparison, ...], results: Mapping[str, Result]
) -> dict[str, dict[str, float]]:
    """Return the numbers of each comparison of which both runs are finished.

    Args:
        comparisons: of the plan.
        results: finished runs by the names of their systems.
    """
    return {
        comparison.name: gain_numbers(
            results[comparison.run], results[comparison.against], comparison.judge
        )
        for comparison in comparisons
        if comparison.run in results and comparison.against in results
    }


def gain_numbers(run: Result, against: Result, judge: str | None = None) -> dict[str, float]:
    """Return the gains in PSNR, dB, with 95 % intervals paired over the test's photographs.

    The names are `gain/psnr_db/<view>`, and `…/low`, `…/high` for the ends of the interval; the
    view "" is the mean over views, and `worst` the worst view of each camera.  `gain/photographs`
    is their number.  One seed says nothing about other seeds.

    Args:
        run: the camera whose gain it is.
        against: the camera that it is compared with.
        judge: as `wave` for the scores of `test_wave`; None for those of `test`.

    Returns:
        An empty mapping where a run has no scores of photographs, or the two have other ones.
    """
    stage = f"test_{judge}" if judge else "test"
    ours, others = (read_scores(side.folder, stage) for side in (run, against))
    if ours is None:
        return {}
    numbers = {"gain/photographs": float(len(ours.photographs))}
    for view in statistics_of(ours.views):
        found = paired_gain([ours], [others], _METRIC, view)
        if found is None:
            return {}
        key = f"gain/{_METRIC}" + (f"/{view}" if view else "")
        numbers |= {key: found.estimate, f"{key}/low": found.low, f"{key}/high": found.high}
    return {name: value for name, value in numbers.items() if value == value}
