"""Figures of a design of a lens with states: all of them at one scale."""

import math
from collections.abc import Callable, Mapping, Sequence

import torch
from matplotlib.figure import Figure

from dolens.analysis.conditions import field_scans
from dolens.analysis.field_curves import field_curves
from dolens.analysis.spot_diagram import working_f_numbers
from dolens.experiments.design.merit_rays import merit_modulation, merit_spots
from dolens.experiments.design.states import views
from dolens.experiments.design.tables import spot_table
from dolens.experiments.experiment import Figures
from dolens.optics.fields import field_label
from dolens.optics.lens import Lens
from dolens.optimize import MeritSettings
from dolens.plotting import modulation_figure, spots_comparison_figure
from dolens.plotting.layout import shown_name
from dolens.plotting.lens_section import states_field_curves_figure, states_layout_figure
from dolens.plotting.style import number_text

_FREQUENCIES = 101
# Beyond this over the RMS radius a spot's modulation is nearly nothing.
_BLURRED = 1.5


def state_figures(
    lens: Lens,
    others: Mapping[str, Lens],
    settings: MeritSettings,
    max_frequency: float | None,
) -> Figures:
    """Return layouts, spots, MTF and field curves of a lens in its states, and of others.

    Of the lens where the search began, layouts alone.

    Args:
        lens: the design.
        others: by their names in titles: the lens where the search began, the published one.
        settings: the states, and the rays of `rms_spot_um`.
        max_frequency: the end of the MTF curves, cycles/mm; None: as far as the worst state has
            contrast.
    """
    figures: dict[str, Callable[[], Figure]] = {}
    names = set(settings.states_of(lens))
    shown = {"final": lens} | {n: one for n, one in others.items() if names <= set(one.state_names)}
    for kind, one in shown.items():
        there = views(one, settings)
        title = f"{shown_name(one)}, {kind}" if kind != "published" else shown_name(one)
        last = "" if kind == "final" else f"_{kind}"
        figures[f"layout{last}"] = lambda there=there, title=title: states_layout_figure(
            there, title=title
        )
        if kind == "initial":
            continue
        figures[f"spots{last}"] = lambda there=there, title=title: _spots(there, settings, title)
        figures[f"modulation{last}"] = lambda there=there, title=title: _modulation(
            there, settings, max_frequency, title
        )
        figures[f"field_curves{last}"] = lambda there=there, title=title: _curves(there, title)
    return figures


def _spots(there: Mapping[str, Lens], settings: MeritSettings, title: str) -> Figure:
    spots = {name: merit_spots(lens, settings) for name, lens in there.items()}
    means = [number_text(spot_table(lens, settings).mean) for lens in there.values()]
    rows = f"{title}\nmean RMS radius by state {', '.join(means)} µm"
    return spots_comparison_figure(spots, rows, field_names(there, settings))


def _modulation(
    there: Mapping[str, Lens], settings: MeritSettings, most: float | None, title: str
) -> Figure:
    if most is None:
        most = min(_contrast_end(lens, settings) for lens in there.values())
    frequencies = torch.linspace(0.0, most, _FREQUENCIES, dtype=torch.float64)
    found = {name: merit_modulation(lens, settings, frequencies) for name, lens in there.items()}
    rows = f"{title}\nMTF with diffraction"
    if any(products for _, products in found.values()):
        rows += "; where spots are many Airy discs large, contrast of the rays × diffraction limit"
    panels = {name: mtf for name, (mtf, _) in found.items()}
    return modulation_figure(panels, rows, field_names(there, settings))


def _contrast_end(lens: Lens, settings: MeritSettings) -> float:
    """Return the frequency (cycles/mm) up to which a lens has contrast."""
    wave = torch.tensor([lens.primary_wavelength], dtype=torch.float64)
    number = float(working_f_numbers(lens, wave, lens.object_distance)[0])
    limit = 0.5 / (1e-6 * lens.primary_wavelength * number)
    return min(limit, _BLURRED / max(1e-3 * spot_table(lens, settings).mean, 1e-12))


def _curves(there: Mapping[str, Lens], title: str) -> Figure:
    found = {}
    for name, lens in there.items():
        distance = lens.object_distance
        scan = field_scans(lens, distance)[0]
        # A test runs without gradients, which the slopes of these curves are.
        with torch.inference_mode(False), torch.enable_grad():
            found[name] = field_curves(lens, scan, [lens.primary_wavelength], distance)
    wave = next(iter(there.values())).primary_wavelength
    what = f"field curvature and distortion at {wave:.4g} nm"
    return states_field_curves_figure(found, f"{title}\n{what}")


def field_names(there: Mapping[str, Lens], settings: MeritSettings) -> Sequence[str]:
    """Return names of the fields that hold in all states: their places, where these are the same;
    else shares of the edge of each state's field.
    """
    places = []
    for lens in there.values():
        unit = "°" if lens.object_distance is None else "mm"
        places.append([field_label(point, unit) for point in settings.fields_of(lens)])
    if all(found == places[0] for found in places):
        return places[0]
    sizes = [math.hypot(*point) for point in settings.fields_of(next(iter(there.values())))]
    shares = [size / max(max(sizes), 1e-12) for size in sizes]
    return ["axis" if s < 1e-6 else "edge" if s > 0.999 else f"{s:.2f} of edge" for s in shares]
