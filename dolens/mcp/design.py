"""Jobs of the server that design: lenses are optimized, searched, checked and made."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from dolens.errors import InputError
from dolens.lens_page.lens_tolerances import LensTolerances
from dolens.lens_page.overview import prepared_lens
from dolens.lens_search.glass.glass_step import GlassPlan
from dolens.lens_search.glass.trial_glasses import SnapSettings
from dolens.lens_search.short_search import LensSearch
from dolens.lens_search.short_search import search as search_lenses
from dolens.lens_search.verification import Requirements, verify
from dolens.mcp.analyses import mean_spot
from dolens.mcp.answer import Answer, Prescription, plain
from dolens.mcp.pictures import lens_of

_SHARES = (0.5, 0.8, 0.9, 0.95)
# How many real glasses are tried in the place of continuous ones.
GLASS_TRIALS = {
    "usual": SnapSettings(),
    "few": SnapSettings(neighbours=4, far=8, beam=2, pair_neighbours=0, rounds=2),
}
# Standard normal deviate of an interval of 95 %.
_DEVIATE = 1.96


def optimize(
    prescription: Prescription,
    variables: Any,
    for_: str,
    keep: Mapping[str, Any] | None,
    iterations: int,
    fields: Any,
    wavelengths: Any,
    picture: bool,
) -> Answer:
    """Optimize a lens by damped least squares; see `Lens.optimize` for the arguments."""
    lens = lens_of(prescription)
    wanted = {k: tuple(v) if isinstance(v, list) else v for k, v in (keep or {}).items()}
    better = lens.optimize(variables, for_, wanted, iterations, fields, wavelengths)
    done = better.optimization
    assert done is not None
    before, after = (mean_spot(each) for each in (lens, better))
    unit = {"spots": "um", "wavefront": "waves"}.get(for_, "merit")
    answer = Answer(
        plain(
            {
                f"{for_}_before_{unit}": done.quality[0],
                f"{for_}_after_{unit}": done.quality[1],
                "mean_rms_spot_before_um": before[0],
                "mean_rms_spot_um": after[0],
                "merit": [done.merit[0], done.reached],
                "iterations": len(done.merit) - 1,
                "ended": done.stopped,
                "kept": [
                    {
                        "operand": one.label,
                        "wanted": one.wanted,
                        "before": one.before,
                        "after": one.after,
                        "off_by": one.deviation,
                    }
                    for one in done.operands
                ],
                "variables": {one.name: [one.before, one.after] for one in done.variables},
                "at_bounds": list(done.at_bounds),
            }
        ),
        notes=list(done.notes),
    )
    answer.errs("mean_rms_spot_um", after[1], "µm", "2000 rays a spot against 1000")
    off = max((abs(one.deviation) for one in done.operands), default=0.0)
    answer.errs("kept", off, "mm, ° or %", "operands are kept by weights, not to the last digit")
    answer.show(done.draw() if picture else None, picture)
    answer.add(better)
    return answer


def search(picture: bool, forms: int, glass_trials: str, **asked: Any) -> Answer:
    """Search for lenses from a specification; see `dolens.search` for the arguments.

    Args:
        picture: whether one is wanted.
        forms: how many of the best forms get real glasses, and are answered.
        glass_trials: a name in `GLASS_TRIALS`.
        asked: the other arguments of `dolens.search`.
    """
    glass = GlassPlan(forms=forms, snapping=GLASS_TRIALS[glass_trials])
    return _found(search_lenses(forms=forms, glass=glass, **asked), "search", picture)


def neighbours(prescription: Prescription, picture: bool, **asked: Any) -> Answer:
    """Search for forms near a lens; see `Lens.search_neighbours`."""
    return _found(lens_of(prescription).search_neighbours(**asked), "near", picture)


def _found(found: LensSearch, name: str, picture: bool) -> Answer:
    """Return the answer of a search: every form with its checks, as a lens."""
    forms, errors = [], []
    for form in found:
        dense = None
        try:
            dense = mean_spot(form.lens)[0]
            errors.append(abs(dense - form.found.mean_rms_spot_um))
        except InputError:
            pass
        forms.append(
            {
                "mean_rms_spot_um": form.found.mean_rms_spot_um if dense is None else dense,
                "rms_spot_um": list(form.found.rms_spot_um),
                "powers": form.powers,
                "glasses": form.glasses,
                "keeps_all_limits": form.holds,
                "breaks": form.broken,
                "as_made_90_percent_um": form.sensitivity and form.sensitivity.ninety_percent_um,
                "worst_tolerance": form.sensitivity and form.sensitivity.worst,
            }
        )
    answer = Answer(
        plain(
            {
                "task": found.task,
                "fields_deg": list(found.specification.fields),
                "designs": found.finds.designs,
                "seconds": found.seconds,
                "forms": forms,
            }
        )
    )
    if not forms:
        raise InputError(
            f"{found.task}: no start became a lens that keeps the limits; give more seconds or "
            "starts, more elements, or wider limits"
        )
    answer.errs(
        "mean_rms_spot_um",
        max(errors, default=None),
        "µm",
        "the search's own few rays against 2000 a spot, the most of all forms",
    )
    answer.errs("forms", None, "", "a search ends with its time: longer ones may find better forms")
    answer.show(found.figure() if picture else None, picture)
    for form in found:
        answer.add(form.lens, name)
    return answer


# ---------------------------------------------------------------- checks and tolerances


def check(prescription: Prescription, picture: bool, **required: Any) -> Answer:
    """Compare a lens with limits by real rays over the whole field; see `Requirements`."""
    limits: dict[str, Any] = {
        k: tuple(v) if isinstance(v, list) else v for k, v in required.items()
    }
    lens: Any = prepared_lens(lens_of(prescription))
    mean, error = mean_spot(lens)
    most = limits.pop("mean_rms_spot_um", None)
    checks = [
        (c.name, c.value, c.unit, c.least, c.most, c.holds, c.place)
        for c in verify(lens, Requirements(**limits)).checks
    ]
    holds = None if most is None else mean <= most
    checks.append(("mean RMS spot", mean, "µm", None, most, holds, "the lens's own fields"))
    keys = ("quantity", "value", "unit", "least", "most", "holds", "place")
    broken = [row[0] for row in checks if row[5] is False]
    answer = Answer(
        plain(
            {
                "holds": not broken,
                "broken": broken,
                "checks": [dict(zip(keys, row, strict=True)) for row in checks],
            }
        )
    )
    answer.errs("mean RMS spot", error, "µm", "2000 rays a spot against 1000")
    answer.errs("limits", 1e-3, "", "a limit may be missed by this share, or by so many mm or °")
    answer.show(lens.draw() if picture else None, picture)
    return answer


def tolerance(
    prescription: Prescription,
    tolerances: Any,
    lenses: int,
    rms_spot_um: float | None,
    seed: int,
    picture: bool,
) -> Answer:
    """Find what tolerances do to a lens; see `Lens.tolerances`."""
    made: LensTolerances = lens_of(prescription).tolerances(tolerances, lenses, seed=seed)
    radii = {f"{100 * share:g}_percent_um": made.radius_of(share) for share in _SHARES}
    values: dict[str, Any] = {
        "nominal_um": made.nominal_um,
        "expected_um": made.expected_um,
        "stay_within": radii,
        "lenses": lenses,
        "failed_lenses": int((made.analysis.perturbed.failed > 0.0).sum()),
    }
    answer = Answer({}, notes=[*made.offenders.notes, *made.problems])
    if rms_spot_um is not None:
        share = made.yield_at(rms_spot_um)
        values["yield_percent"] = 100.0 * share
        values["yield_at_um"] = rms_spot_um
        answer.errs(
            "yield_percent",
            100.0 * _half_interval(share, lenses),
            "%",
            "95 % interval of so many drawn lenses (Wilson)",
        )
    table = made.table(8)
    values["worst"] = [dict(zip(table.heads, row, strict=True)) for row in table.rows]
    linear = 1e3 * float(made.analysis.linear.found(True).rms.square().mean().sqrt())
    traced = float(made.radii_um().square().mean().sqrt())
    answer.errs(
        "expected_um",
        abs(linear - traced),
        "µm",
        "the linear ray model against exactly traced lenses, root mean square of both",
    )
    answer.values = plain(values)
    answer.show(made.figure() if picture else None, picture)
    return answer


def _half_interval(share: float, count: int) -> float:
    """Return half of Wilson's interval of 95 % of a share among so many."""
    z2 = _DEVIATE**2
    inner = share * (1.0 - share) / count + z2 / (4.0 * count**2)
    return _DEVIATE * math.sqrt(inner) / (1.0 + z2 / count)
