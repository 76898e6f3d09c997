"""The report's page, with a section for each item of the supplement; numbers as it shows them."""

import base64
import io
import math
import os
import shlex
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import quote

from markupsafe import Markup, escape
from PIL import Image

from dolens.experiments.report.checks import SOURCES, Check, Material, Outcome, State
from dolens.experiments.report.plan import Item, Row
from dolens.experiments.report.runs import Result, shown_command, telling_overrides
from dolens.html import rendered, shown
from dolens.photograph_page.page import PAGE as PHOTOGRAPHS
from dolens.plotting.style import with_minus
from dolens.sensor.image_files import opened_image

_TITLE = "dolens: the dO supplement, run again"
# As the page has them, with words for one check and for more.
_STATES = (
    (State.FAILS, "does not hold", "do not hold"),
    (State.NOT_RUN, "was not run", "were not run"),
    (State.HOLDS, "holds", "hold"),
)
# Words of the column; SOURCES has them in full.
_KINDS = {"printed": "printed", "exact": "exact", "measured": "measured", "statement": "claim"}


def page(material: Material, folder: Path | None = None) -> str:
    """Return the page as one HTML file, which needs no other files.

    Args:
        material: what is on it.
        folder: that the page is written to, from where it links to the photographs of runs; None:
            it links to none.
    """
    results = material.results

    def cost(name: str, otherwise: str) -> str:
        return cost_text(results[name]) if name in results else otherwise

    return rendered(
        Path(__file__).with_name("page.html"),
        filters={
            "anchor": anchor,
            "embedded": embedded,
            "expected_text": expected_text,
            "found_text": found_text,
            "gain_sentence": gain_sentence,
            "prose": prose,
            "size_of": size_of,
            "style": _style,
        },
        title=_TITLE,
        material=material,
        plan=material.plan,
        states=_STATES,
        by_state={
            state: [outcome for outcome in material.outcomes if outcome.state is state]
            for state in State
        },
        kinds=_KINDS,
        sources=SOURCES,
        badge=lambda item: _badge(material, item),
        command=lambda name: command_of(material, name),
        cost=cost,
        figure=lambda picture: (
            results[picture.run].figure(picture.name) if picture.run in results else None
        ),
        ours=lambda row: ours_text(material, row),
        photographs=lambda name: (
            photographs_of(results[name], folder) if folder and name in results else None
        ),
        version=lambda name: _version(material, name),
    )


def photographs_of(result: Result, folder: Path) -> str | None:
    """Return the address of a run's page of photographs from a folder; None where it has none."""
    found = result.folder / PHOTOGRAPHS
    if not found.is_file():
        return None
    return quote(Path(os.path.relpath(found.resolve(), folder.resolve())).as_posix())


def prose(text: str) -> Markup:
    """Return text in which what stands between backticks is code."""
    parts = escape(shown(text)).split("`")
    code = Markup("<code>{}</code>")
    return Markup().join(code.format(part) if n % 2 else part for n, part in enumerate(parts))


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


def _signed(value: float) -> str:
    return with_minus(f"{value:+.2f}")


def _version(material: Material, name: str) -> str:
    result = material.results.get(name)
    if result is None:
        return "–"
    code = result.record.get("code")
    if code == material.code:
        return "this version"
    git = result.info.get("git") or {}
    commit = str(git.get("commit") or "")[:10]
    return f"another version{f' ({commit})' if commit else ''}"


_BADGES = {
    State.FAILS: "does not hold",
    State.HOLDS: "its checks hold",
    State.NOT_RUN: "not run",
}


def _style(state: State) -> str:
    """Return the name of a state in the rules of the page."""
    return state.name.lower().replace("_", "-")


def _badge(material: Material, item: Item) -> tuple[str, str]:
    """Return what is said beside an item's title, and its style."""
    states = {outcome.state for outcome in material.outcomes_of(item.item)}
    for state, words in _BADGES.items():
        if state in states:
            return words, _style(state)
    return "shown, no check" if item.runs else "held by tests", "quiet"


def ours_text(material: Material, row: Row) -> str:
    """Return our number with its standard error or its interval, or `not run`."""
    metrics = material.metrics(row.run)
    if metrics is None:
        return "not run"
    value = metrics.get(row.metric) if row.metric else _lens_value(material, row)
    if value is None:
        return "not in this run"
    text = number_text(value, row.digits)
    if row.bound in metrics:
        text += f" ± {number_text(metrics[row.bound], 2)}"
    if row.low in metrics and row.high in metrics:
        low, high = (number_text(metrics[name], row.digits) for name in (row.low, row.high))
        text += f" (95 %: {low} to {high})"
    return text


def cost_text(result: Result) -> str:
    """Return seconds, rays and memory of a run, as far as it knows them."""
    metrics, record = result.metrics, result.record
    parts = []
    wall = record.get("wall_s", metrics.get("cost/wall_s"))
    if wall is not None:
        parts.append(seconds_text(wall))
    if "cpu_s" in record:
        parts[-1] += f" ({seconds_text(record['cpu_s'])} of processor time)"
    if "cost/step_s" in metrics:
        step = metrics["cost/step_s"]
        parts.append(f"{step_text(step)} a step")
    if "cost/rays" in metrics:
        parts.append(f"{count_text(metrics['cost/rays'])} rays")
    if "cost/peak_memory_mb" in metrics:
        parts.append(f"{memory_text(metrics['cost/peak_memory_mb'])} of memory")
    return ", ".join(parts)


def command_of(material: Material, name: str) -> str:
    """Return the command of a run: its own where it has settings of its own."""
    result = material.results.get(name)
    system = material.plan.system(name)
    if result is None or not result.overrides:
        return shown_command(system)
    return shlex.join(["dolens", "train", *telling_overrides(result.overrides)])


def _lens_value(material: Material, row: Row) -> float | None:
    result = material.results.get(row.run)
    return result.lens_value(row.lens) if result and row.lens else None


# Twice what the page is wide, for sharp screens and for enlarging.
_WIDEST = 1600
_QUALITY = 90


def embedded(path: Path) -> str:
    """Return a picture as an address that holds its bytes.

    A picture wider than 1600 pixels is reduced.  Of WebP without loss and with quality 90 the
    smaller is taken: drawings are smaller without loss, photographs with it.

    Args:
        path: BMP, GIF, JPEG, PNG, PPM, TIFF or WebP.
    """
    with opened_image(path) as image:
        picture = image.convert("RGB")
    if picture.width > _WIDEST:
        height = round(picture.height * _WIDEST / picture.width)
        picture = picture.resize((_WIDEST, height), Image.Resampling.LANCZOS)
    written = []
    for options in ({"lossless": True}, {"quality": _QUALITY}):
        stream = io.BytesIO()
        picture.save(stream, "WEBP", **options)
        written.append(stream.getvalue())
    return "data:image/webp;base64," + base64.b64encode(min(written, key=len)).decode("ascii")


def size_of(path: Path) -> tuple[int, int]:
    """Return width and height of a picture in pixels."""
    with opened_image(path) as image:
        return image.size


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
