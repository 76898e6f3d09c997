"""This module draws how good a series of lenses is by how wide its tolerances are."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure


def made_front_figure(
    arms: Mapping[str, Mapping[float, tuple[float, float, float]]],
    drawn: Mapping[str, float],
    title: str,
) -> Figure:
    """Draw the PSNR of the worst tenth of the lenses over the factor of their tolerances.

    Args:
        arms: name of a camera → factor → worst decile and its interval, dB.
        drawn: name → PSNR of its lens as drawn, dB.
        title: of the figure.
    """
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.add_subplot()
    factors: Sequence[float] = []
    for number, (name, curve) in enumerate(arms.items()):
        factors = sorted(curve)
        middle, low, high = zip(*(curve[factor] for factor in factors), strict=True)
        colour = f"C{number}"
        axes.plot(factors, middle, "o-", color=colour, label=name)
        axes.fill_between(factors, low, high, color=colour, alpha=0.2, linewidth=0.0)
        axes.axhline(drawn[name], color=colour, linestyle=":", label=f"{name}, lens as drawn")
    axes.set_xscale("log")
    axes.set_xticks(factors, [f"{factor:g}" for factor in factors])
    axes.minorticks_off()
    axes.set_xlabel("factor of all tolerances")
    axes.set_ylabel("PSNR of the worst tenth of the lenses, dB")
    above = axes.secondary_xaxis("top", functions=(_reciprocal, _reciprocal))
    above.set_xticks([1.0 / f for f in factors], [f"{1.0 / f:.2g}" for f in factors])
    above.minorticks_off()
    above.set_xlabel("cost of the tolerances, Σ a/t, relative to factor 1")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    figure.suptitle(title, fontsize="medium")
    return figure


def _reciprocal(value: Any) -> Any:
    # Matplotlib asks at zero too, of an axis that has none.
    return 1.0 / np.maximum(value, 1e-9)
