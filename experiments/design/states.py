"""A lens that is designed, in each of its states: pupils, edges, lost light, and spots."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from dolens.analysis.transmission import transmission
from dolens.optics.field_and_aperture import with_aperture
from dolens.optics.lens import Lens
from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture
from dolens.optimize import MeritSettings
from dolens.optimize.automatic_semi_diameters import fitted_semi_diameters, rim_rays
from dolens.optimize.rounds import spot_labels

logger = logging.getLogger(__name__)

SQUARE_GRID_COUNT = 31
_DEFAULTS = {
    "gaussian_quadrature": {"rings": 6, "arms": 12},
    "square_grid": {"count": SQUARE_GRID_COUNT},
}


@dataclass(frozen=True)
class SpotTable:
    """Holds the RMS spot radii of a lens.

    Attributes:
        radii: label of the spot, as `0,14/588nm`, → µm, about its reference.
        mean: of all, with the merit's weights.
        light: share of the beams that passes, likewise; see `SpotRays.light`.
    """

    radii: dict[str, float]
    mean: float
    light: float


def spot_table(lens: Lens, settings: MeritSettings, finer: bool = False) -> SpotTable:
    """Return the RMS spot radii of a lens, over the rays that pass it.

    Args:
        lens: initial, published or final.
        settings: of a merit of spots.
        finer: twice the rays in each direction, to see what the sampling costs.
    """
    if finer:
        settings = replace(settings, sampling_options=_doubled(settings))
    quality = settings.image_quality(lens)
    rms = 1e3 * quality.values(lens).rms
    mean = float((quality.weights.to(rms) * rms).sum())
    light = float((quality.weights.to(quality.spots.light) * quality.spots.light).sum())
    radii = dict(zip(spot_labels(quality.spots), rms.tolist(), strict=True))
    return SpotTable(radii, mean, light)


def spot_metrics(
    lens: Lens, others: Mapping[str, Lens], settings: MeritSettings
) -> dict[str, float]:
    """Return mean RMS spot radii and light of a design and others, and radii of all its spots.

    Args:
        lens: the design, `final` in the names of metrics.
        others: lenses to compare with, by their names there.
        settings: of a merit of spots.
    """
    final = spot_table(lens, settings)
    tables = {name: spot_table(other, settings) for name, other in others.items()}
    tables["final"] = final
    numbers = {}
    for name, table in tables.items():
        numbers[f"rms_spot_um/{name}"] = table.mean
        numbers[f"light/{name}"] = table.light
    for label, radius in final.radii.items():
        numbers[f"rms_spot_um/final/{label}"] = radius
    for name, one in {**others, "final": lens}.items():
        if one.system().coated:
            numbers |= light_metrics(name, one, settings)
    numbers["error/sampling_um"] = abs(spot_table(lens, settings, finer=True).mean - final.mean)
    logger.info(
        "RMS spot radius, mean of %d: %s µm",
        len(final.radii),
        ", ".join(f"{name} {table.mean:.4g}" for name, table in tables.items()),
    )
    return numbers


@torch.no_grad()
def light_metrics(name: str, lens: Lens, settings: MeritSettings) -> dict[str, float]:
    """Return what of the light passes a coated lens, the mean over fields and wavelengths."""
    where = settings.conditions_of(lens)
    found = transmission(lens, where)
    share = float(where.field_weights @ found.polychromatic)
    logger.info("Transmission, %s: %.3f %%", name, 100.0 * share)
    return {f"transmission/{name}": share}


def _doubled(settings: MeritSettings) -> dict[str, Any]:
    """Return sampling options with twice the rays along each direction."""
    given = {key: value for key, value in settings.sampling_options.items() if value is not None}
    options = {**_DEFAULTS[settings.sampling], **given}
    counts = ("rings", "arms", "count")
    return {key: 2 * value if key in counts else value for key, value in options.items()}


def views(lens: Lens, settings: MeritSettings) -> dict[str, Lens]:
    """Return the lens in each state that counts, in the order of the merit; empty without states.

    They share the lens's parameters: what the design changes is seen in all.
    """
    return {name: lens.in_state(name) for name in settings.states_of(lens)}


def entrance_pupils(lens: Lens) -> dict[str | None, float]:
    """Return the diameter (mm) of the entrance pupil of a lens in each of its states, or, under
    None, of a lens without states.
    """
    found = {}
    for name in lens.state_names or (None,):
        there = lens.in_state(name)
        with torch.no_grad():
            first = there.first_order(there.primary_wavelength, there.object_distance)
        found[name] = float(first.entrance_pupil.diameter)
    return found


def set_entrance_pupils(lens: Lens, diameters: Mapping[str | None, float]) -> None:
    """Open or close the stop of a lens, in each of its states, to entrance pupils (mm)."""
    number = str(lens.stop)
    for name, diameter in diameters.items():
        closed = with_aperture(lens.in_state(name), entrance_pupil_diameter=diameter)
        set_aperture(lens, name, number, closed.surfaces[number].aperture)


def set_aperture(lens: Lens, state: str | None, number: str, aperture: ClearAperture) -> None:
    """Replace the clear aperture of a surface, in the lens or in one of its states.

    What was noted of a stop that is replaced holds no longer.
    """
    if number == str(lens.stop):
        lens.stop_note = ""
        for own in map(lens.states.__getitem__, lens.state_names):
            own.data.given.pop("stop_note", None)
    if state is None:
        lens.surfaces[number].aperture = aperture
    else:
        lens.states[state].data.apertures[number] = aperture


def set_edges(lens: Lens, edges: Mapping[str | None, Mapping[str, float]]) -> None:
    """Put the edges of a lens where the light of its states needs them.

    The stop opens in each state as that state needs it, or stays; every other edge lets the light
    of all states pass.

    Args:
        lens: its clear apertures are replaced.
        edges: state, or None for a lens without states → number of a surface → mm.
    """
    numbers = dict.fromkeys(n for found in edges.values() for n in found)
    for number in numbers:
        sizes = {state: found[number] for state, found in edges.items() if number in found}
        largest = ClearAperture(Circle(max(sizes.values())))
        set_aperture(lens, None, number, largest)
        for state in lens.state_names:
            own = number == str(lens.stop) and state in sizes
            set_aperture(
                lens, state, number, ClearAperture(Circle(sizes[state])) if own else largest
            )


def state_metrics(
    lens: Lens, others: Mapping[str, Lens], settings: MeritSettings
) -> dict[str, float]:
    """Return mean RMS spot radii and light by state of a design and others, and over all states.

    The published lens has them once more with the sensor at the best focus of each state: its
    printed gaps are rounded.

    Args:
        lens: the design, `final` in the names of metrics, as `rms_spot_um/final/wide`.
        others: lenses to compare with, by their names there.
        settings: of a merit of spots; a lens that lacks its states is left out.
    """
    weights = settings.states_of(lens)
    numbers: dict[str, float] = {}
    text = {}
    for kind, other in {**others, "final": lens}.items():
        if not set(weights) <= set(other.state_names):
            continue
        by_state = views(other, settings)
        tables = {name: spot_table(there, settings) for name, there in by_state.items()}
        numbers[f"rms_spot_um/{kind}"] = _mean(tables, weights, "mean")
        numbers[f"light/{kind}"] = _mean(tables, weights, "light")
        for name, table in tables.items():
            numbers[f"rms_spot_um/{kind}/{name}"] = table.mean
        text[kind] = ", ".join(f"{name} {table.mean:.4g}" for name, table in tables.items())
        if kind == "published":
            own = {name: _refocused(there, settings) for name, there in by_state.items()}
            numbers[f"rms_spot_um/{kind}_refocused"] = sum(weights[n] * own[n] for n in own)
            numbers |= {f"rms_spot_um/{kind}_refocused/{name}": rms for name, rms in own.items()}
    error = 0.0
    for name, there in views(lens, settings).items():
        of_state = spot_metrics(there, {}, settings)
        for label, value in of_state.items():
            prefix = "rms_spot_um/final/"
            if label.startswith(prefix):
                numbers[f"{prefix}{name}/{label.removeprefix(prefix)}"] = value
        error += weights[name] * of_state["error/sampling_um"]
        numbers |= first_order_numbers(there, name)
    numbers["error/sampling_um"] = error
    for kind, row in text.items():
        logger.info("RMS spot radius by state, %s: %s µm", kind, row)
    return numbers


def _refocused(lens: Lens, settings: MeritSettings) -> float:
    """Return the mean RMS radius (µm) of a lens with the sensor where that is best."""
    quality = settings.image_quality(lens)
    values = quality.values(lens)
    slopes = quality.slopes(values)
    there = quality.refocused(values, slopes, quality.best_focus(values, slopes))
    return 1e3 * float((quality.weights.to(there.rms) * there.rms).sum())


@torch.no_grad()
def first_order_numbers(lens: Lens, name: str) -> dict[str, float]:
    """Return focal length (mm) and F-number of a lens in a state, and what it misses of the
    published focal length, as metrics.
    """
    first = lens.first_order(lens.primary_wavelength, lens.object_distance)
    numbers = {f"efl_mm/{name}": float(first.efl)}
    near = lens.object_distance is not None
    number = first.working_f_number if near else first.f_number
    numbers[f"{'working_' if near else ''}f_number/{name}"] = abs(float(number))
    if near:
        numbers[f"magnification/{name}"] = float(first.magnification)
    return numbers


def _mean(tables: Mapping[str, SpotTable], weights: Mapping[str, float], what: str) -> float:
    return sum(weights[name] * getattr(table, what) for name, table in tables.items())


def foci(lens: Lens, names: list[str]) -> Tensor:
    """Return distances of the sensor by the names of their parameters, (k,) or, of one, ()."""
    found = [lens.get_parameter(name).detach().clone() for name in names]
    if names == ["sensor_distance"]:
        return found[0]
    return torch.stack(found) if found else torch.zeros(0, dtype=lens.dtype)


@torch.no_grad()
def set_foci(lens: Lens, names: list[str], distances: Tensor) -> None:
    """Store distances of the sensor that `foci` has returned."""
    for name, distance in zip(names, distances.reshape(-1), strict=True):
        lens.get_parameter(name).copy_(distance)


# Rings of the quadrature that tells where the edges of the beams are.
_EDGE_RINGS = 40
# Factor of the heights of beams that pass an edge untouched.
_BESIDE = 1.005


def fit_edges(lens: Lens, initial: Lens | None, settings: MeritSettings) -> None:
    """Put every edge of a lens where the light of its beams meets it.

    Args:
        lens: its clear apertures are replaced.
        initial: decides which rays there are, those that pass it; None: those that the lens's own
            stop lets pass, aimed at its rim, with a little room beside all others.
        settings: fields and wavelengths of the rays.
    """
    settings = replace(
        settings,
        sampling="gaussian_quadrature",
        sampling_options={"rings": _EDGE_RINGS, "arms": 2 * _EDGE_RINGS, "symmetry": True},
    )
    edges = {}
    for state in settings.states_of(lens) or (None,):
        there = lens.in_state(state)
        if initial is not None:
            rays = settings.rays(initial.in_state(state))
            edges[state] = fitted_semi_diameters(there, rays)
            continue
        own = rim_rays(there, settings.conditions_of(there))
        edges[state] = fitted_semi_diameters(there, own, _BESIDE)
        edges[state].pop(str(lens.stop), None)
    set_edges(lens, edges)
