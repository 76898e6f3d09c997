"""Seidel sums of a lens at the edge of its field, as plain numbers with their names."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.analysis.conditions import Conditions, wavelength_interval
from dolens.analysis.full_field import full_field
from dolens.analysis.ray_intercepts import in_double_precision
from dolens.optics.fields import require_from_the_front
from dolens.optics.lens import Lens
from dolens.optics.paraxial import vergence
from dolens.optics.seidel import Seidel


class Aberration(NamedTuple):
    """An `Aberration` is a Seidel sum by name.

    Attributes:
        name: in full.
        short: for the head of a narrow column.
        symbol: of its sum.
    """

    name: str
    short: str
    symbol: str


# In the order of `Seidel`.
ABERRATIONS = (
    Aberration("spherical aberration", "spherical", "S_I"),
    Aberration("coma", "coma", "S_II"),
    Aberration("astigmatism", "astigm.", "S_III"),
    Aberration("Petzval", "Petzval", "S_IV"),
    Aberration("distortion", "distort.", "S_V"),
    Aberration("axial colour", "axial", "C_L"),
    Aberration("lateral colour", "lateral", "C_T"),
)


@dataclass(frozen=True)
class SeidelSums:
    """Seidel sums of N surfaces, those of the centred lens without poses.

    Attributes:
        edge: of the field, degrees or mm.
        wavelength: nm.
        colours: nm, the shorter and the longer wavelength of the sums of colour.
        by_surface: (N,) each, mm of wave aberration, float64.
    """

    edge: float
    wavelength: float
    colours: tuple[float, float]
    by_surface: Seidel

    def waves(self) -> Tensor:
        """Return the sums in wavelengths, (N, 7)."""
        return torch.stack(list(self.by_surface), -1) / (1e-6 * self.wavelength)


@torch.no_grad()
def seidel_sums(lens: Lens, where: Conditions) -> SeidelSums:
    """Return the sums at the farthest field, or at the full field where all are on the axis.

    The sums of colour are between the outermost wavelengths; where there is one only, between those
    of `wavelength_interval`.

    Args:
        lens: of any precision.
        where: fields, wavelengths and object distance.
    """
    exact = in_double_precision(lens)
    wavelength, distance = where.reference_wavelength, where.object_distance
    edge = float(where.fields.norm(dim=-1).max()) or full_field(exact, distance)
    if vergence(distance) == 0.0:
        require_from_the_front(edge, "a paraxial chief ray")
    low, high = float(where.wavelengths.min()), float(where.wavelengths.max())
    colours = (low, high) if low < high else wavelength_interval(lens)
    found = exact.seidel(edge, wavelength, distance, colours)
    return SeidelSums(edge, wavelength, colours, Seidel(*(sums.cpu() for sums in found)))
