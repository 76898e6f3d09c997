"""Tables of a search's forms."""

from collections.abc import Iterator, Sequence

from dolens.experiments.tables import Row
from dolens.lens_search.form_report import FormReport


def form_rows(reports: Sequence[FormReport]) -> Iterator[Row]:
    """Yield a row for each form, the best first."""
    for report in reports:
        best, sensitivity = report.form.best, report.sensitivity
        spots = {f"rms_spot_um_{n}": spot for n, spot in enumerate(best.rms_spot_um, 1)}
        yield {
            "form": report.name,
            "mean_rms_spot_um": best.mean_rms_spot_um,
            **spots,
            "made_p90_um": "" if sensitivity is None else sensitivity.ninety_percent_um,
            "powers": report.powers,
            "glasses": report.glasses,
            "holds": report.holds,
            "broken": report.broken,
            "starts": len(report.form.starts),
            "start": best.start,
            "history": ", ".join(best.history),
        }


def check_rows(reports: Sequence[FormReport]) -> Iterator[Row]:
    """Yield a row for each quantity of each form."""
    for report in reports:
        for check in () if report.verification is None else report.verification.checks:
            yield {
                "form": report.name,
                "quantity": check.name,
                "value": check.value,
                "unit": check.unit,
                "least": "" if check.least is None else check.least,
                "most": "" if check.most is None else check.most,
                "holds": "" if check.holds is None else check.holds,
                "place": check.place,
            }
