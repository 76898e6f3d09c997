"""Tables of a search's forms."""

from collections.abc import Iterator, Sequence

from dolens.experiments.tables import Row
from dolens.lens_search.files import form_name
from dolens.lens_search.found import FoundLens
from dolens.lens_search.verification import Verification


def form_rows(found: Sequence[FoundLens], checked: Sequence[Verification]) -> Iterator[Row]:
    """Yield a row for each form, the best first."""
    for number, (lens, verification) in enumerate(zip(found, checked, strict=True), 1):
        spots = {f"rms_spot_um_{n}": spot for n, spot in enumerate(lens.rms_spot_um, 1)}
        yield {
            "form": form_name(number),
            "mean_rms_spot_um": lens.mean_rms_spot_um,
            **spots,
            "holds": verification.holds,
            "broken": "; ".join(check.name for check in verification.broken),
            "start": lens.start,
            "history": ", ".join(lens.history),
        }


def check_rows(checked: Sequence[Verification]) -> Iterator[Row]:
    """Yield a row for each quantity of each form."""
    for number, verification in enumerate(checked, 1):
        for check in verification.checks:
            yield {
                "form": form_name(number),
                "quantity": check.name,
                "value": check.value,
                "unit": check.unit,
                "least": "" if check.least is None else check.least,
                "most": "" if check.most is None else check.most,
                "holds": "" if check.holds is None else check.holds,
                "place": check.place,
            }
