"""Rays of pixels along the edges of apertures, at azimuths that are drawn for each pixel."""

import math

import torch

from dolens.kernels.view import View
from dolens.optics.rays import Components
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.pupil.differentiable_pupil import depends_on_parameters
from dolens.rendering.pupil.edge_rays import EdgeRays, edge_rays
from dolens.rendering.pupil.pupil_boundary import PupilBoundaryMap
from dolens.rendering.random_numbers import random_words, uniform

# Rays a pixel and wavelength, where edges cut light: as many as half the strata along a side of the
# pupil, since an edge is a line.
_FEWEST = 2


def edge_samples(pupil_samples: int) -> int:
    """Rays along edges for each pixel and wavelength, beside strata along a side of the pupil."""
    return max(_FEWEST, pupil_samples // 2)


def pixel_edge_rays(
    imaging: ImagingSystem, view: View, edges: PupilBoundaryMap | None, start: int, end: int
) -> EdgeRays | None:
    """Rays (C, pixels, samples) of pixels `start` to `end`; None where no gradient asks for them.

    Args:
        imaging: the lens, C wavelengths, the pixels, and the pupil's disc as it moves with the
            lens.
        view: of the render, for its seed.
        edges: where edges are; None where they cut nothing.
        start: number of the first pixel.
        end: number behind the last.
    """
    system = imaging.system
    if edges is None or not depends_on_parameters(system):
        return None
    pixel = torch.arange(start, end, device=system.device)[:, None]
    count = edge_samples(view.pupil_samples)
    stratum = torch.arange(count, device=system.device)
    # Beyond the numbers of the pupil's samples.
    words = random_words(view.seed, pixel, stratum + view.pupil_samples**2)
    jitter, _, *area = (uniform(word, system.dtype) for word in words)
    angle = (stratum + jitter) * (2.0 * math.pi / count)
    rows = torch.div(pixel, view.width, rounding_mode="floor").to(system.dtype)[:, 0]
    columns = (pixel % view.width).to(system.dtype)[:, 0]
    if view.pixel_area:
        # One place serves all azimuths of a pixel.
        rows, columns = rows + (area[0][:, 0] - 0.5), columns + (area[1][:, 0] - 0.5)
    points = imaging.sensor.positions(rows, columns)
    edge = edges.at(*points, angle)
    return edge_rays(system, imaging.scene.wavelengths, points, imaging.pupil, edge)


def select_wavelength(ray: Components, channel: int) -> Components:
    """Rays of one wavelength."""
    return Components(*(component[channel] for component in ray))
