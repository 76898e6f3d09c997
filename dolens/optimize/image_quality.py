"""The rays' term of a merit function measures image quality; this module holds what its kinds
share.

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
from dolens.optics.lens import Lens
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Status, TracedRays
from dolens.optimize.linear_least_squares import LinearModel

REFERENCES = ("centroid", "chief")
SPECTRA = ("monochromatic", "polychromatic")


def without_edges(lens: Lens) -> Lens:
    """Return a lens whose apertures clip nothing, with the very parameters and values of this one.

    A search for a better lens follows the same rays all the way: one that slips out of an aperture
    would otherwise leave its spot, and make it smaller.
    """
    shared = {id(tensor): tensor for tensor in (*lens.parameters(), *lens.buffers())}
    opened, given = copy.deepcopy(lens.as_stored(), shared), dict(lens.given)
    for number, surface in opened.surfaces.items():
        edge = given.pop(f"surfaces.{number}.semi_diameter", None)
        aperture = surface.aperture
        if edge is not None:
            aperture = aperture.resized(float(edge.detach()))
        surface.aperture = aperture.opened()
    return opened.with_values(given)


@dataclass(frozen=True)
class QualityValues:
    """Holds the rays of a lens, and the sizes of their spots or wavefront errors.

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
        """Return the RMS value (S,) of each spot: its radius in mm, or its wavefront error in
        waves.
        """
        return self.mean_squares.sqrt()


@dataclass(frozen=True)
class ImageQuality(ABC):
    """Measures the image quality of a lens as a term of a merit function: Σ W_s·(RMS value of spot
    s)², or another loss of its rays.

    Args:
        spots: the rays, with chief rays where those are the reference.
        weights: (S,), W of each spot.
        reference: deviations count from the spot's `centroid` or from its `chief` ray.
        reference_spectrum: `monochromatic`: every wavelength has a reference of its own;
            `polychromatic`: one for all of a field, so that lateral colour counts.
        max_vignetting: share of a spot that apertures may clip before the lens counts as failed: a
            search would else buy sharpness with light.

    Raises:
        InputError: an unknown choice, or rays without the chief rays that it needs.
    """

    spots: SpotRays
    weights: Tensor
    reference: str = "centroid"
    reference_spectrum: str = "monochromatic"
    max_vignetting: float = 0.2

    # Factor of deviations in the merit, and the unit that they then have.
    scale: ClassVar[float] = 1.0
    unit: ClassVar[str] = ""
    # Whether the sum of squares is quadratic in the sensor's distance, so that a best focus exists.
    focusable: ClassVar[bool] = True

    def __post_init__(self) -> None:
        for what, value, allowed in (
            ("reference", self.reference, REFERENCES),
            ("reference_spectrum", self.reference_spectrum, SPECTRA),
        ):
            check_choice(value, allowed, what)
        if self.reference == "chief" and self.spots.chief is None:
            raise InputError("reference 'chief': these rays hold no chief rays")

    # ---------------------------------------------------------------- what each kind says

    @abstractmethod
    def _traced(self, lens: Lens, hit: TracedRays) -> tuple[Tensor, Tensor]:
        """Return (K, N) deviations from their references, and (K, N) growth, not referenced; with
        hit's graph.
        """

    @abstractmethod
    def _rows(self, lens: Lens, names: Sequence[str]) -> Tensor:
        """Return (1 + P, K, N): deviations and their derivatives with respect to parameters of a
        lens, referenced.
        """

    @abstractmethod
    def _slopes(self, growth: Tensor) -> Tensor:
        """Return the growth (K, N) of referenced deviations with the sensor's distance."""

    # ---------------------------------------------------------------- values

    @torch.no_grad()
    def values(self, lens: Lens) -> QualityValues:
        """Evaluate a lens as it is; rays that its apertures clip count as if they did not."""
        spots = self.spots
        hit = trace_rays(lens.system(), spots.rays)
        deviations, growth = (part.T for part in self._traced(lens, hit))
        failed = (hit.status == Status.TIR) | (hit.status == Status.MISSED)
        clipped = spots.weight * (hit.status == Status.VIGNETTED)
        shares = clipped.new_zeros(spots.count).index_add(0, spots.spot, clipped)
        squares = self._mean_squares(deviations)
        found = int(failed.sum()), float(shares.amax())
        return QualityValues(deviations, growth, squares, self._merit(deviations), *found)

    def is_usable(self, values: QualityValues) -> bool:
        """Return whether every ray arrives, and apertures clip no more than they may."""
        return not values.failed and values.vignetted <= self.max_vignetting

    def slopes(self, values: QualityValues) -> Tensor:
        """Return the derivatives (N, K) of the deviations with respect to the sensor's distance."""
        return self._slopes(values.growth.T).T

    def best_focus(self, values: QualityValues, slopes: Tensor) -> float:
        """Return the shift of the sensor (mm) to where the sum of squares is least.

        Rays are straight behind the lens, so that deviations d + k·δz are linear: δz = -d·k/k·k.
        """
        weight = self.ray_weights[:, None]
        square = float((weight * slopes.square()).sum())
        if square == 0.0 or values.failed:
            return 0.0
        return -float((weight * values.deviations * slopes).sum()) / square

    def refocused(self, values: QualityValues, slopes: Tensor, shift: float) -> QualityValues:
        """Return the values on a sensor that stands farther from the lens by `shift` (mm)."""
        deviations = values.deviations + shift * slopes
        return replace(
            values,
            deviations=deviations,
            mean_squares=self._mean_squares(deviations),
            merit=self._merit(deviations),
        )

    def loss(self, lens: Lens, parameters: Mapping[str, Tensor]) -> Tensor:
        """Return the term with a graph to parameters that replace a lens's own.

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
        """Return the linear model in parameters of a lens, columns in the lens's own order.

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
        """Return W·w (N,) of every ray, the spot's weight times the ray's share."""
        return self.weights.to(self.spots.weight)[self.spots.spot] * self.spots.weight

    @property
    def _numbers(self) -> int:
        """Return K, how many numbers a ray has."""
        return 2

    @cached_property
    def group(self) -> Tensor:
        """Return the number of each ray's reference group (N,), int64: its spot, or its field."""
        spots = self.spots
        if self.reference_spectrum == "monochromatic":
            return spots.spot
        _, field = spots.fields.unique(dim=0, return_inverse=True)
        return field.to(spots.spot.device)[spots.spot]

    @cached_property
    def group_weights(self) -> Tensor:
        """Return the weight W (S,) of every group, at most S of them; they sum to one."""
        weight = self.ray_weights
        return weight.new_zeros(self.spots.count).index_add(0, self.group, weight)

    @cached_property
    def group_shares(self) -> Tensor:
        """Return the share w (N,) of every ray in its group; they sum to one over each."""
        weight, total = self.ray_weights, self.group_weights
        return weight / total.clamp(min=torch.finfo(weight.dtype).tiny)[self.group]

    def _referenced(self, points: Tensor) -> Tensor:
        """Return points (..., 2, N) on the sensor, or their derivatives, less their references."""
        return points - self._reference_points(points)

    def _reference_points(self, points: Tensor) -> Tensor:
        """Return the reference (..., 2, N) of every ray: centroid or chief ray of its group."""
        spots, group = self.spots, self.group
        if self.reference == "chief":
            return points[..., self._chief_of_rays]
        means = points.new_zeros((*points.shape[:-1], spots.count))
        means.index_add_(-1, group, points * self.group_shares)
        centred = spots.centred[spots.spot].T
        return torch.where(centred, 0.0, means[..., group])

    @cached_property
    def _chief_of_rays(self) -> Tensor:
        """Return the number of each ray's chief ray (N,), int64; for a polychromatic reference that
        of the middle wavelength.
        """
        spots = self.spots
        own = spots.chief
        assert own is not None  # the reference is the chief ray
        if self.reference_spectrum == "monochromatic":
            return own[spots.spot]
        group_of_spot = torch.zeros_like(own)
        group_of_spot[spots.spot] = self.group
        waves = spots.wavelengths.unique()
        middle = spots.wavelengths == waves[len(waves) // 2]
        chief = torch.zeros_like(own)
        chief[group_of_spot[middle]] = own[middle]
        return chief[self.group]

    def _mean_squares(self, deviations: Tensor) -> Tensor:
        squares = self.spots.weight * deviations.square().sum(-1)
        return squares.new_zeros(self.spots.count).index_add(0, self.spots.spot, squares)

    def _loss(self, deviations: Tensor) -> Tensor:
        """Return the term for deviations (K, N)."""
        squares = self.ray_weights * deviations.square().sum(0)
        return self.scale**2 * squares.sum()

    def _merit(self, deviations: Tensor) -> float:
        return float(self._loss(deviations.T))
