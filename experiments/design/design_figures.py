"""Figures of a lens before and after its design, and of a lens in its states."""

import math
from collections.abc import Callable, Mapping, Sequence

import torch
from matplotlib.figure import Figure

from dolens.analysis.conditions import field_scans
from dolens.analysis.field_curves import field_curves
from dolens.analysis.ray_intercepts import ray_fans
from dolens.experiments.design.merit_rays import (
    COMMON_CENTROID,
    merit_modulation,
    merit_rms_against_field,
    merit_rms_against_wavelength,
    merit_spots,
    pupil_share,
    pupil_text,
    rays_text,
    reference_text,
    whole_stop_rms,
)
from dolens.experiments.design.states import spot_table, views
from dolens.experiments.experiment import Figures
from dolens.optics.fields import field_label
from dolens.optics.lens import Lens
from dolens.optimize import MeritSettings
from dolens.plotting import (
    before_after_figure,
    history_figure,
    modulation_figure,
    ray_fans_figure,
    rms_curves_figure,
    spots_comparison_figure,
    spots_figure,
)
from dolens.plotting.field_curves import states_field_curves_figure
from dolens.plotting.layout import optics_text, shown_name
from dolens.plotting.lens_section import states_layout_figure
from dolens.plotting.style import number_text
from dolens.plotting.transmission import reflectance_figure

_FREQUENCIES = 201
# Along each diameter of the stop.
_FAN_POINTS = 101
# Beyond this over the RMS radius a spot's modulation is nearly nothing.
_BLURRED = 1.5
# Significant digits of a headline's radius.
_DIGITS = 4


def design_figures(
    lens: Lens,
    initial: Lens,
    settings: MeritSettings,
    history: Sequence[Mapping[str, float]],
    max_frequency: float | None = None,
    merit_unit: str = "",
    initial_merit: float = math.nan,
    others: Mapping[str, Lens] | None = None,
) -> Figures:
    """Return the layout, spots, ray fans, MTF and RMS curves of a design, and its history.

    All are over the rays of `rms_spot_um`; where those do not fill the stop, titles give the
    number over the whole stop besides, and ray fans show what lies beyond.

    Args:
        lens: the design.
        initial: the lens where the search began.
        settings: fields and wavelengths, and the rays of `rms_spot_um`.
        history: a row of numbers for every iteration; empty if nothing was trained.
        max_frequency: the end of the MTF curves, cycles/mm; None: half of the diffraction limit, or
            less, where the spots of the design leave no contrast.
        merit_unit: of the merit function, for the history; empty where it has none.
        initial_merit: before the first iteration; NaN where it is not known.
        others: lenses that the design is compared with, whose coatings are drawn beside its own.
    """
    where = settings.conditions_of(lens)
    fields, waves = [tuple(field) for field in where.fields.tolist()], where.wavelengths.tolist()
    distance = where.object_distance

    def spots() -> Figure:
        title = titled(lens, "final", _radius(lens, settings))
        return spots_figure(merit_spots(lens, settings), len(waves) == 1, title)

    def compared() -> Figure:
        both = {"initial": initial, "final": lens}
        first, last = (number_text(spot_table(of, settings).mean, _DIGITS) for of in both.values())
        rows = [f"mean RMS radius {first} → {last} µm, {_rays(settings)}"]
        if len(waves) > 1 and reference_text(settings) != COMMON_CENTROID:
            rows.append("panels: all wavelengths about their common centroid")
        return spots_comparison_figure(
            {name: merit_spots(of, settings) for name, of in both.items()},
            _titled_both(initial, lens, "\n".join(rows)),
        )

    def layouts() -> Figure:
        # Drawn in the y-z plane: fields beside it would be drawn elsewhere than they are.
        angles = sorted({y for x, y in fields if x == 0.0}) if distance is None else []
        return before_after_figure(
            initial, lens, lens.primary_wavelength, angles or [0.0], object_distance=distance
        )

    def transfer() -> Figure:
        most = max_frequency
        if most is None:
            most = _contrast_end(lens, settings)
        frequencies = torch.linspace(0.0, most, _FREQUENCIES, dtype=torch.float64)
        found = {
            name: merit_modulation(of, settings, frequencies)
            for name, of in (("initial", initial), ("final", lens))
        }
        rows = [f"MTF with diffraction, {pupil_text(settings)}"]
        panels = {name: mtf for name, (mtf, _) in found.items()}
        if all(len(products) == len(fields) for _, products in found.values()):
            rows.append("contrast of the rays × diffraction limit")
        elif any(products for _, products in found.values()):
            # A panel says of which fields it has no wave-optical function.
            rows.append("¹ contrast of the rays × diffraction limit, not by wave optics")
            panels = {
                f"{name}\n{_products(products, len(fields))}": mtf
                for name, (mtf, products) in found.items()
            }
        return modulation_figure(panels, _titled_both(initial, lens, "\n".join(rows)))

    def curves() -> Figure:
        edge = max(fields, key=_size)
        opposite = (-edge[0], -edge[1])
        start = opposite if opposite in fields else (0.0, 0.0)
        what = f"RMS spot radius, {rays_text(settings)}"
        along = None
        if _size(edge) > 0.0:
            along = merit_rms_against_field(lens, settings, edge, start)
            # Over the wavelength each is about its own.
            note = reference_text(settings)
            what += f"\nat the left {note}" if note else ""
        over = merit_rms_against_wavelength(lens, settings, _interval(waves))
        return rms_curves_figure(along, over, titled(lens, "final", what))

    def fans() -> Figure:
        share = pupil_share(lens, settings)
        beyond = f"; shaded: beyond {pupil_text(settings)}" if share < 1.0 else ""
        return ray_fans_figure(
            ray_fans(lens, where, _FAN_POINTS),
            titled(lens, "final", f"ray fans across the whole stop{beyond}"),
            share,
        )

    figures: dict[str, Callable[[], Figure]] = {
        "layout": layouts,
        "spots": spots,
        "spots_before_after": compared,
        "ray_fans": fans,
        "modulation": transfer,
        "rms_curves": curves,
    }
    compared_with = {**(others or {}), "final": lens}
    coated = {name: one for name, one in compared_with.items() if one.system().coated}
    if coated:
        title = f"{shown_name(lens)}: what the coatings reflect"
        figures["reflectance"] = lambda: reflectance_figure(coated, title)
    return figures | history_figures(lens, history, initial_merit, merit_unit)


def history_figures(
    lens: Lens, history: Sequence[Mapping[str, float]], initial_merit: float, merit_unit: str
) -> Figures:
    """Return the figure of a design's history; none where nothing was trained.

    Arguments are those of `design_figures`.
    """
    if not history:
        return {}
    damping = [row.get("train/damping", float("nan")) for row in history]
    return {
        "history": lambda: history_figure(
            [initial_merit, *(row["train/merit"] for row in history)],
            [math.nan, *damping] if any(value == value for value in damping) else None,
            title=": ".join(filter(None, [shown_name(lens), "history of the design"])),
            merit_label=f"merit ({merit_unit})" if merit_unit else "merit",
        )
    }


def titled(lens: Lens, stage: str | None, rest: str) -> str:
    """Return a title: name of the lens, stage, focal length and aperture; and the rest below."""
    optics = optics_text(lens.system(), lens.primary_wavelength, lens.object_distance)
    name = ", ".join(part for part in (shown_name(lens), stage) if part)
    return f"{name}: {optics}\n{rest}" if name else f"{optics}\n{rest}"


def _titled_both(initial: Lens, final: Lens, rest: str) -> str:
    """Return a title of a comparison, with the focal lengths and apertures of both lenses."""
    first, last = (
        optics_text(lens.system(), lens.primary_wavelength, lens.object_distance)
        for lens in (initial, final)
    )
    if first == last:
        return titled(final, None, rest)
    wave = f" at {final.primary_wavelength:.4g} nm"
    pairs = zip(
        first.removesuffix(wave).split(", "), last.removesuffix(wave).split(", "), strict=False
    )
    changes = [
        one if one == other else f"{one} → {other.removeprefix('f = ')}" for one, other in pairs
    ]
    return f"{shown_name(final)}: {', '.join(changes)}{wave}\n{rest}".removeprefix(": ")


def _products(labels: Sequence[str], count: int) -> str:
    """Return a note about the fields of a panel whose MTF is a product; a blank line for none."""
    if not labels:
        return " "
    return "all fields¹" if len(labels) == count else f"product¹: {', '.join(labels)}"


def _radius(lens: Lens, settings: MeritSettings) -> str:
    """Return the headline's number and rays; and the number of the whole stop, if that differs."""
    number = number_text(spot_table(lens, settings).mean, _DIGITS)
    text = f"mean RMS radius {number} µm, {_rays(settings)}"
    whole = whole_stop_rms(lens, settings)
    if whole is None:
        return text
    return f"{text}\n(over the whole stop: {number_text(whole)} µm)"


def _rays(settings: MeritSettings) -> str:
    note = reference_text(settings)
    return f"{rays_text(settings)}\n{note}" if note else rays_text(settings)


def _size(field: tuple[float, float]) -> float:
    return field[0] ** 2 + field[1] ** 2


def _interval(wavelengths: list[float]) -> tuple[float, float]:
    """Return the range of wavelengths; about a single one, 5 % both ways."""
    low, high = min(wavelengths), max(wavelengths)
    return (low, high) if high > low else (0.95 * low, 1.05 * low)


_FREQUENCIES_OF_STATES = 101


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
    frequencies = torch.linspace(0.0, most, _FREQUENCIES_OF_STATES, dtype=torch.float64)
    found = {name: merit_modulation(lens, settings, frequencies) for name, lens in there.items()}
    rows = f"{title}\nMTF with diffraction"
    if any(products for _, products in found.values()):
        rows += "; where spots are many Airy discs large, contrast of the rays × diffraction limit"
    panels = {name: mtf for name, (mtf, _) in found.items()}
    return modulation_figure(panels, rows, field_names(there, settings))


def _contrast_end(lens: Lens, settings: MeritSettings) -> float:
    """Return the frequency (cycles/mm) up to which a lens has contrast."""
    first = lens.first_order(lens.primary_wavelength, lens.object_distance)
    number = abs(float(first.working_f_number))
    limit = 0.5 / (1e-6 * lens.primary_wavelength * number)
    return min(limit, _BLURRED / max(1e-3 * spot_table(lens, settings).mean, 1e-12))


def _curves(there: Mapping[str, Lens], title: str) -> Figure:
    found = {}
    for name, lens in there.items():
        scan = field_scans(lens, lens.object_distance)[0]
        # A test runs without gradients, which the slopes of these curves are.
        with torch.inference_mode(False), torch.enable_grad():
            found[name] = field_curves(lens, scan, [lens.primary_wavelength])
    wave = next(iter(there.values())).primary_wavelength
    what = f"field curvature and distortion at {wave:.4g} nm"
    return states_field_curves_figure(found, f"{title}\n{what}")


def field_names(there: Mapping[str, Lens], settings: MeritSettings) -> Sequence[str]:
    """Return names of the fields that hold in all states: their places, where these are the same;
    else shares of the edge of each state's field.
    """
    each = [settings.conditions_of(lens) for lens in there.values()]
    places = [[field_label(p, where.field_unit) for p in where.fields.tolist()] for where in each]
    if all(found == places[0] for found in places):
        return places[0]
    sizes = [math.hypot(*point) for point in each[0].fields.tolist()]
    shares = [size / max(max(sizes), 1e-12) for size in sizes]
    return ["axis" if s < 1e-6 else "edge" if s > 0.999 else f"{s:.2f} of edge" for s in shares]
