"""Edges of a lens and the light that they cut, before and after its design."""

from dataclasses import replace

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.experiments.design.states import set_edges
from dolens.experiments.design.tables import spot_labels
from dolens.optics.lens import Lens
from dolens.optimize import MeritSettings
from dolens.optimize.automatic_semi_diameters import fitted_semi_diameters, rim_rays
from dolens.optimize.image_quality import ImageQuality

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
        own = rim_rays(there, settings.fields_of(there), settings.wavelengths_of(there))
        edges[state] = fitted_semi_diameters(there, own, _BESIDE)
        edges[state].pop(str(lens.stop), None)
    set_edges(lens, edges)


def refuse_lost_light(quality: ImageQuality, initial_light: Tensor) -> None:
    """Check that no spot has lost too much light since a search began.

    Each round takes its rays from the lens as it then is, so that every one could lose some.

    Args:
        quality: that of the present round.
        initial_light: (S,), the light of its spots when the search began; see `SpotRays.light`.

    Raises:
        InputError: a spot has lost more than `max_vignetting` of its light.
    """
    least = initial_light * (1.0 - quality.max_vignetting)
    lost = quality.spots.light < least.to(quality.spots.light)
    if bool(lost.any()):
        label = spot_labels(quality.spots)[int(torch.nonzero(lost)[0])]
        raise InputError(
            f"spot {label} has lost more than merit.max_vignetting = "
            f"{quality.max_vignetting:g} of the light that it had at first"
        )
