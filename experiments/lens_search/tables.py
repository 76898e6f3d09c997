"""Tables of a search's forms."""

from collections.abc import Iterator, Sequence

from dolens.experiments.tables import Row
from dolens.lens_search.form_report import FormReport


def form_rows(reports: Sequence[FormReport]) -> Iterator[Row]:
    """Yield a row for each form, the best first."""
    for report in reports:
        found, made, colour = report.found, report.sensitivity, report.colour
        spots = {f"rms_spot_um_{n}": spot for n, spot in enumerate(found.rms_spot_um, 1)}
        yield {
            "form": report.name,
            "powers": report.powers,
            "mean_rms_spot_um": found.mean_rms_spot_um,
            **spots,
            "rms_spot_um_90_percent_as_made": "" if made is None else made.ninety_percent_um,
            "worst_tolerance": "" if made is None else made.worst,
            "axial_colour_um": "" if colour is None else colour.axial_um,
            "secondary_spectrum_um": "" if colour is None else colour.secondary_um,
            "lateral_colour_um": "" if colour is None else colour.lateral_um,
            "holds": report.holds,
            "broken": report.broken,
            "glasses": report.glasses,
            "starts": report.starts,
            "designs": report.designs,
            "start": found.start,
            "history": ", ".join(found.history),
        }


def check_rows(reports: Sequence[FormReport]) -> Iterator[Row]:
    """Yield a row for each quantity of each form."""
    for report in reports:
        for check in report.verification.checks if report.verification else ():
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
