"""The top of the report's page, what holds and what does not; numbers as the page shows them."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence

from dolens.experiments.report.checks import SOURCES, Check, Material, Outcome, State
from dolens.html import Child, Markup, element, joined, prose, table
from dolens.plotting.style import with_minus

_ORDER = (State.FAILS, State.NOT_RUN, State.HOLDS)
_TITLES = {
    State.FAILS: "Does not hold",
    State.NOT_RUN: "Not run",
    State.HOLDS: "Holds",
}
# Words of the column; SOURCES has them in full.
_KINDS = {"printed": "printed", "exact": "exact", "measured": "measured", "statement": "claim"}
_COLUMNS = ("Statement", "Expected", "Found", "Expected value from")


def overview(material: Material) -> Markup:
    """Return the counts, a table for each state, and what cannot be compared at all."""
    counts = Counter(outcome.state for outcome in material.outcomes)
    badges = [
        element(
            "span",
            f"{counts[state]} {_count_words(state, counts[state])}",
            class_=f"badge {css_class(state)}",
        )
        for state in _ORDER
    ]
    return element(
        "section",
        element("h2", "What holds and what does not"),
        element("p", *_spaced(badges)),
        element("p", f"Sources: {_legend()}.", class_="quiet"),
        *(_of_state(material, state) for state in _ORDER),
        _gains(material),
        _runs_that_failed(material),
        _not_compared(material),
        id="checks",
    )


def css_class(state: State) -> str:
    """Return the class that colours a state."""
    return {State.HOLDS: "holds", State.FAILS: "fails", State.NOT_RUN: "not-run"}[state]


def anchor(item: str) -> str:
    """Return the id of an item's section."""
    return "".join(c if c.isalnum() else "-" for c in item.lower())


def expected_text(check: Check) -> str:
    """Return what passes, as `4.29 ± 0.01 µm`, `at most 5 nm` or `2 to 3`."""
    if check.expected is not None and check.tolerance is not None:
        expected = value_text(check.expected, check.tolerance)
        return _with_unit(f"{expected} ± {limit_text(check.tolerance)}", check.unit)
    if check.low is None:
        return _with_unit(f"at most {limit_text(float(check.high))}", check.unit)
    if check.high is None:
        return _with_unit(f"at least {limit_text(check.low)}", check.unit)
    return _with_unit(f"{limit_text(check.low)} to {limit_text(check.high)}", check.unit)


def found_text(outcome: Outcome) -> str:
    """Return the value that was found, with its unit, or why there is none."""
    if outcome.value is None:
        return outcome.note or "not run"
    tolerance = outcome.check.tolerance
    text = value_text(outcome.value, tolerance) if tolerance else number_text(outcome.value, 3)
    return _with_unit(text, outcome.check.unit)


def _with_unit(text: str, unit: str) -> str:
    return f"{text}{unit}" if unit in ("", "°") else f"{text} {unit}"


def checks_table(outcomes: Sequence[Outcome]) -> Markup:
    """Return the checks of several items in a table."""
    return table(_COLUMNS, [_row(outcome) for outcome in outcomes], "checks", named_cells=True)


def _row(outcome: Outcome) -> tuple[Child, ...]:
    check = outcome.check
    return (
        joined(
            element("a", check.item, href=f"#{anchor(check.item)}"),
            ": ",
            prose(check.what),
            " ",
            element("code", f"{check.run}: {check.metric}", class_="metric"),
        ),
        expected_text(check),
        element("span", found_text(outcome), class_=css_class(outcome.state)),
        joined(element("b", _KINDS[check.kind]), f": {check.source}"),
    )


def _of_state(material: Material, state: State) -> Markup | None:
    found = [outcome for outcome in material.outcomes if outcome.state is state]
    if not found:
        return element("p", "Every check that was run holds.") if state is State.FAILS else None
    summary = element("summary", f"{_TITLES[state]} ({len(found)})")
    return element(
        "details", summary, checks_table(found), open=None if state is State.NOT_RUN else ""
    )


def gain_sentence(numbers: Mapping[str, float]) -> str:
    """Say in words what a comparison shows at the worst view, and whether it is significant.

    Args:
        numbers: of `gain_numbers`.
    """
    if "gain/psnr_db/worst" not in numbers:
        return "The two runs were tested on other photographs, so there is no gain to speak of."
    low, high = (numbers.get(f"gain/psnr_db/worst/{end}", math.nan) for end in ("low", "high"))
    found = f"{_gain_text(numbers, 'gain/psnr_db/worst')} at the worst view"
    # The field's own quality where the run has it, else the mean of the views.
    whole = "gain/psnr_db/field" if "gain/psnr_db/field" in numbers else "gain/psnr_db"
    if whole in numbers:
        found += f" and {_gain_text(numbers, whole)} over all views"
    over = f"over {numbers['gain/photographs']:.0f} photographs with one seed"
    if low > 0.0:
        verdict = "At the worst view the interval lies above zero: a gain on these photographs."
    elif high < 0.0:
        verdict = "At the worst view the interval lies below zero: a loss."
    else:
        verdict = "The interval at the worst view includes zero: this run does not show a gain."
    return f"{found}, {over}. {verdict}"


def _gain_text(numbers: Mapping[str, float], key: str) -> str:
    low, high = (_signed(numbers.get(f"{key}/{end}", math.nan)) for end in ("low", "high"))
    return f"{_signed(numbers[key])} dB (95 %: {low} to {high} dB)"


def _gains(material: Material) -> Markup | None:
    sentences = [
        element(
            "li",
            element("b", comparison.title),
            f": {gain_sentence(material.comparisons[comparison.name])}",
        )
        for comparison in material.plan.comparisons
        if comparison.name in material.comparisons
    ]
    if not sentences:
        return None
    return joined(element("h3", "Gains of learned optics"), element("ul", *sentences))


def _signed(value: float) -> str:
    return with_minus(f"{value:+.2f}")


def _runs_that_failed(material: Material) -> Markup | None:
    if not material.failed:
        return None
    return joined(
        element("h3", "Runs that ended with an error"),
        *(
            joined(element("p", element("b", name)), element("pre", words))
            for name, words in material.failed.items()
        ),
    )


def _not_compared(material: Material) -> Markup | None:
    items = [item for item in material.plan.items() if item.not_compared]
    if not items:
        return None
    return joined(
        element("h3", "What is printed but cannot be compared"),
        element(
            "ul",
            *(
                element(
                    "li",
                    element("a", item.item, href=f"#{anchor(item.item)}"),
                    ": ",
                    prose(item.not_compared),
                )
                for item in items
            ),
        ),
    )


def _legend() -> str:
    return "; ".join(f"{_KINDS[kind]} – {words}" for kind, words in SOURCES.items())


def _count_words(state: State, count: int) -> str:
    one = {State.HOLDS: "holds", State.FAILS: "does not hold", State.NOT_RUN: "was not run"}
    more = {State.HOLDS: "hold", State.FAILS: "do not hold", State.NOT_RUN: "were not run"}
    return (one if count == 1 else more)[state]


def _spaced(children: Sequence[Markup]) -> list[Child]:
    return [part for child in children for part in (child, " ")]


_MINUS = "\N{MINUS SIGN}"
_SUPERSCRIPTS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


def number_text(value: float, digits: int = 4) -> str:
    """Return a number with so many significant digits, a true minus and no exponent letter."""
    if not math.isfinite(value):
        return "no number"
    text = f"{value:#.{digits}g}"
    if "e" in text:
        mantissa, exponent = text.split("e")
        text = f"{mantissa.rstrip('.')}·10{str(int(exponent)).translate(_SUPERSCRIPTS)}"
    text = text.rstrip(".")
    return text.replace("-", _MINUS)


def value_text(value: float, tolerance: float) -> str:
    """Return a number with as many decimals as its tolerance has, and one more."""
    decimals = max(0, 1 - math.floor(math.log10(tolerance))) if tolerance > 0.0 else 6
    return f"{value:.{decimals}f}".replace("-", _MINUS)


def limit_text(value: float) -> str:
    """Return a limit as it was written, without zeros at its end."""
    return number_text(value, 6).rstrip("0").rstrip(".") if _plain(value) else number_text(value, 1)


def seconds_text(seconds: float) -> str:
    """Return a duration as `4.2 s`, `3 min 20 s` or `2 h 5 min`."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def step_text(seconds: float) -> str:
    """Return the time of a step as `4.7 ms`, `470 ms` or `1.5 s`."""
    milliseconds = 1e3 * seconds
    if milliseconds >= 1000.0:
        return seconds_text(seconds)
    return f"{milliseconds:.0f} ms" if milliseconds >= 9.95 else f"{milliseconds:.2g} ms"


def memory_text(megabytes: float) -> str:
    """Return a size as `830 MB` or `1.2 GB`."""
    return f"{megabytes:.0f} MB" if megabytes < 1000.0 else f"{megabytes / 1024.0:.1f} GB"


def count_text(count: float) -> str:
    """Return a count with thin spaces between thousands."""
    return f"{count:,.0f}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def _plain(value: float) -> bool:
    return "e" not in f"{value:.6g}"
