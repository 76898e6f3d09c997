"""From finished runs to the file of the page."""

import datetime
from collections.abc import Mapping
from pathlib import Path

import dolens
from dolens.experiments.report.checks import Outcome, load_checks, outcomes
from dolens.experiments.report.code_version import code_fingerprint
from dolens.experiments.report.gains import compared
from dolens.experiments.report.page.material import Material
from dolens.experiments.report.page.page import page
from dolens.experiments.report.plan import Plan
from dolens.experiments.report.results import read_result


def assemble(
    plan: Plan, folders: Mapping[str, Path], failed: Mapping[str, str], file: Path
) -> tuple[Outcome, ...]:
    """Write the page, and return the outcomes of all checks.

    Args:
        plan: systems and items.
        folders: finished runs by the names of their systems.
        failed: systems whose run ended with an error → what it said last.
        file: of the page; its folder is made.

    Raises:
        InputError: a folder is not that of a finished run, or a plan or expected values are wrong.
    """
    results = {name: read_result(name, folder) for name, folder in folders.items()}
    comparisons = compared(plan.comparisons, results)
    metrics = {name: result.metrics for name, result in results.items()} | comparisons
    found = outcomes(load_checks(plan), metrics)
    material = Material(plan, results, comparisons, found, failed, _made(), code_fingerprint())
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(page(material), encoding="utf-8")
    return found


def _made() -> str:
    now = datetime.datetime.now().astimezone()
    version = getattr(dolens, "__version__", None)
    of = f"dolens {version}, code {code_fingerprint()}" if version else f"code {code_fingerprint()}"
    return f"Made on {now:%-d %B %Y at %H:%M} by {of}."
