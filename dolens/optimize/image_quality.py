"""What the terms of a merit function share that are made of rays: how sharp a lens is.

Every ray carries K numbers that a perfect lens would make zero: how far it lands from the reference
point of its spot, or how far its light runs ahead of the reference sphere.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from dolens.analysis.pupil_quadrature import SpotRays
from dolens.errors import InputError, check_choice
from dolens.optics.backend import trace_rays
from dolens.optics.lens import Lens
from dolens.optics.rays import Status, TracedRays
from dolens.optimize.linear_model import LinearModel

REFERENCES = ("centroid", "chief")
COLOURS = ("apart", "together")


def without_edges(lens: Lens) -> Lens:
    """A lens whose apertures clip nothing, with the very parameters of this one.

    A search for a better lens follows the same rays all the way: one that slips out of an aperture
    would otherwise leave its spot, and make it smaller.
    """
    shared = {id(tensor): tensor for tensor in (*lens.parameters(), *lens.buffers())}
    opened = copy.deepcopy(lens, shared)
    for surface in opened.surfaces.values():
        surface.aperture = surface.aperture.opened()
    return opened


@dataclass(frozen=True)
class QualityValues:
    """Rays of a lens, and how good their spots are.

    Attributes:
        deviations: (N, K), of every ray, double precision; mm, or wavelengths.
        growth: (N, K), how fast the deviations grow with the sensor's distance, before any
            reference is taken from them; l/n and m/n of the rays where deviations are lengths.
        mean_squares: (S,): Σ w·|deviation|² of each spot, its RMS value squared.
        merit: what the term adds to the merit function.
        failed: rays that miss a surface or are reflected totally; the rest then says nothing.
        vignetted: the largest share of a spot that the apertures clip; its rays still count.
    """

    deviations: Tensor
    growth: Tensor
    mean_squares: Tensor
    merit: float
    failed: int
    vignetted: float

    @property
    def rms(self) -> Tensor:
        """(S,), RMS value of each spot: its radius in mm, or its wavefront's error in waves."""
        return self.mean_squares.sqrt()


@dataclass(frozen=True)
class ImageQuality(ABC):
    """A term of a merit function: Σ W_s·(RMS value of spot s)², or another loss of its rays.

    Args:
        spots: the rays, with chief rays where those are the reference.
        weights: (S,), W of each spot.
        reference: deviations count from the spot's `centroid` or from its `chief` ray.
        colours: `apart`: every wavelength has a reference of its own; `together`: one for all of a
            field, so that lateral colour counts.
        most_vignetted: share of a spot that apertures may clip before the lens counts as failed: a
            search would else buy sharpness with light.

    Raises:
        InputError: an unknown choice, or rays without the chief rays that it needs.
    """

    spots: SpotRays
    weights: Tensor
    reference: str = "centroid"
    colours: str = "apart"
    most_vignetted: float = 0.2

    # Factor of deviations in the merit, and the unit that they then have.
    scale: ClassVar[float] = 1.0
    unit: ClassVar[str] = ""
    # Whether the sum of squares is quadratic in the sensor's distance, so that a best focus exists.
    focusable: ClassVar[bool] = True

    def __post_init__(self) -> None:
        for what, value, allowed in (
            ("reference", self.reference, REFERENCES),
            ("colours", self.colours, COLOURS),
        ):
            check_choice(value, allowed, what)
        if self.reference == "chief" and self.spots.chief is None:
            raise InputError("reference 'chief': these rays hold no chief rays")

    # ---------------------------------------------------------------- what each kind says

    @abstractmethod
    def _traced(self, lens: Lens, hit: TracedRays) -> tuple[Tensor, Tensor]:
        """(K, N) deviations, referenced, and (K, N) growth, not referenced; with hit's graph."""

    @abstractmethod
    def _rows(self, lens: Lens, names: Sequence[str]) -> Tensor:
        """(1 + P, K, N): deviations and their derivatives by parameters of a lens, referenced."""

    @abstractmethod
    def _slopes(self, growth: Tensor) -> Tensor:
        """(K, N), how fast referenced deviations grow."""

    # ---------------------------------------------------------------- values

    @torch.no_grad()
    def values(self, lens: Lens) -> QualityValues:
        """Of a lens as it is; rays that its apertures clip count as if they did not."""
        spots = self.spots
        hit = lens.trace(spots.rays)
        deviations, growth = (part.T for part in self._traced(lens, hit))
        failed = (hit.status == Status.TIR) | (hit.status == Status.MISSED)
        clipped = spots.weight * (hit.status == Status.VIGNETTED)
        shares = clipped.new_zeros(spots.count).index_add(0, spots.spot, clipped)
        squares = self._mean_squares(deviations)
        found = int(failed.sum()), float(shares.amax())
        return QualityValues(deviations, growth, squares, self._merit(deviations), *found)

    def is_usable(self, values: QualityValues) -> bool:
        """Whether every ray arrives, and apertures clip no more than they may."""
        return not values.failed and values.vignetted <= self.most_vignetted

    def slopes(self, values: QualityValues) -> Tensor:
        """(N, K), how fast the deviations grow with the distance of the sensor."""
        return self._slopes(values.growth.T).T

    def best_focus(self, values: QualityValues, slopes: Tensor) -> float:
        """How far to move the sensor (mm) to where the sum of squares is least.

        Rays are straight behind the lens, so that deviations d + k·δz are linear: δz = -d·k/k·k.
        """
        weight = self.ray_weights[:, None]
        square = float((weight * slopes.square()).sum())
        if square == 0.0 or values.failed:
            return 0.0
        return -float((weight * values.deviations * slopes).sum()) / square

    def refocused(self, values: QualityValues, slopes: Tensor, shift: float) -> QualityValues:
        """The same on a sensor that stands farther from the lens by `shift` (mm)."""
        deviations = values.deviations + shift * slopes
        return replace(
            values,
            deviations=deviations,
            mean_squares=self._mean_squares(deviations),
            merit=self._merit(deviations),
        )

    def loss(self, lens: Lens, parameters: Mapping[str, Tensor]) -> Tensor:
        """The term with a graph, where parameters replace a lens's own: for a gradient.

        Args:
            lens: one `without_edges`.
            parameters: name → value.
        """
        hit = trace_rays(lens.system(parameters), self.spots.rays)
        deviations, _ = self._traced(lens, hit)
        return self._loss(deviations)

    def linear_model(
        self, lens: Lens, names: Sequence[str], without: Tensor | None = None
    ) -> tuple[LinearModel, Tensor | None]:
        """R and b in parameters of a lens, columns in the lens's own order.

        Args:
            lens: one `without_edges`.
            names: of its parameters.
            without: (N, K), deviations by a parameter that is always put where the sum of squares
                is least, as the focus is: what it can undo is taken out of the derivatives
                (variable projection: Golub and Pereyra 1973, in Kaufman's approximation, which
                keeps the gradient exact).

        Returns:
            The model; and (P,), how the best focus moves with the parameters, or None.
        """
        root = self.ray_weights.sqrt()
        rows = (self._rows(lens, names) * (self.scale * root)).reshape(
            -1, self._numbers * len(root)
        )
        focus = None
        if without is not None:
            undone = (without.T * root).reshape(-1)
            norm = undone.norm()
            undone = undone / norm
            along = rows @ undone
            focus = -along[1:] / (self.scale * norm)
            rows = rows - torch.outer(along, undone)
        return LinearModel.of_rows(rows[0], rows[1:].T), focus

    # ---------------------------------------------------------------- weights and references

    @cached_property
    def ray_weights(self) -> Tensor:
        """(N,): W·w of every ray, the spot's weight times the ray's share."""
        return self.weights.to(self.spots.weight)[self.spots.spot] * self.spots.weight

    @property
    def _numbers(self) -> int:
        """K."""
        return 2

    @cached_property
    def group(self) -> Tensor:
        """(N,), int64: which rays have one reference: those of a spot, or of a field."""
        spots = self.spots
        if self.colours == "apart":
            return spots.spot
        _, field = spots.fields.unique(dim=0, return_inverse=True)
        return field.to(spots.spot.device)[spots.spot]

    @cached_property
    def group_weights(self) -> Tensor:
        """(S,): W of every group, of which there are S at most; they sum to one."""
        weight = self.ray_weights
        return weight.new_zeros(self.spots.count).index_add(0, self.group, weight)

    @cached_property
    def group_shares(self) -> Tensor:
        """(N,): w of every ray in its group; they sum to one over each."""
        weight, total = self.ray_weights, self.group_weights
        return weight / total.clamp(min=torch.finfo(weight.dtype).tiny)[self.group]

    def _referenced(self, points: Tensor) -> Tensor:
        """Points (..., 2, N) on the sensor, or derivatives of points, from their references."""
        return points - self._reference_points(points)

    def _reference_points(self, points: Tensor) -> Tensor:
        """(..., 2, N): centroid or chief ray of every ray's group."""
        spots, group = self.spots, self.group
        if self.reference == "chief":
            return points[..., self._chief_of_rays]
        means = points.new_zeros((*points.shape[:-1], spots.count))
        means.index_add_(-1, group, points * self.group_shares)
        centred = spots.centred[spots.spot].T
        return torch.where(centred, 0.0, means[..., group])

    @cached_property
    def _chief_of_rays(self) -> Tensor:
        """(N,), int64: each ray's chief ray; that of the middle wavelength where colours join."""
        spots = self.spots
        if self.colours == "apart":
            return spots.chief[spots.spot]
        group_of_spot = torch.zeros_like(spots.chief)
        group_of_spot[spots.spot] = self.group
        waves = spots.wavelengths.unique()
        middle = spots.wavelengths == waves[len(waves) // 2]
        chief = torch.zeros_like(spots.chief)
        chief[group_of_spot[middle]] = spots.chief[middle]
        return chief[self.group]

    def _mean_squares(self, deviations: Tensor) -> Tensor:
        squares = self.spots.weight * deviations.square().sum(-1)
        return squares.new_zeros(self.spots.count).index_add(0, self.spots.spot, squares)

    def _loss(self, deviations: Tensor) -> Tensor:
        """The term, of deviations (K, N)."""
        squares = self.ray_weights * deviations.square().sum(0)
        return self.scale**2 * squares.sum()

    def _merit(self, deviations: Tensor) -> float:
        return float(self._loss(deviations.T))
