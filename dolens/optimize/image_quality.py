"""The rays' term of a merit function measures image quality: what its kinds share, and the kind of
RMS wavefront errors (`ray_intercept_quality` has the others).

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
from dolens.optics.jacobian import ray_jacobian
from dolens.optics.lens import Lens
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Status, TracedRays
from dolens.optics.system import require_plane_sensor
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


_OUTPUTS = ("x", "y", "path_length", "l", "m")
_MM_PER_NM = 1e-6


class WavefrontResiduals(ImageQuality):
    """Gives residuals √(W_s·w_i)·(OPD_i - mean OPD of spot s), in wavelengths.

    Their sum of squares is Σ W_s·(RMS wavefront error)².  The optical path difference is the path
    from the object's wavefront to a sphere about the reference point (X, Y) on the sensor, centroid
    or chief ray.  The sphere is taken as very large: with the ray's sensor point (x, y), direction
    (l, m), path V and the index n' before the sensor,

        OPD = V - n'·((x - X)·l + (y - Y)·m) - its mean,

    which differs from that on a sphere of radius R by n'·|p - p̄|²/2R at most, some hundredths of a
    wavelength for spots of 20 µm and R = 50 mm, and nothing for good lenses.

    Raises:
        InputError: a lens in single precision, whose paths are known to a few wavelengths only.
    """

    unit: ClassVar[str] = "waves"

    @property
    def _numbers(self) -> int:
        return 1

    def _traced(self, lens: Lens, hit: TracedRays) -> tuple[Tensor, Tensor]:
        self._check(lens)
        position, direction = hit.position[:, :2].T, hit.direction[:, :2].T
        path = hit.path_length + self._path_before(lens)
        deviations = self._differences(lens, position, direction, path)
        # Moving the sensor by δz moves the sphere's centre along the chief ray: OPD grows by
        # n'·(l·c_x + m·c_y + n)·δz, with c the reference point's own tangents.
        tangents = (hit.direction[:, :2] / hit.direction[:, 2:]).T
        centre = self._reference_points(tangents)
        growth = (direction * centre).sum(0) + hit.direction[:, 2]
        return deviations, (self._index(lens) / self._waves * growth)[None]

    def _slopes(self, growth: Tensor) -> Tensor:
        return self._without_piston(growth)

    def _rows(self, lens: Lens, names: Sequence[str]) -> Tensor:
        self._check(lens)
        found = ray_jacobian(lens, self.spots.rays, names, _OUTPUTS)
        values = found.values.T
        jacobian = found.derivatives.permute(2, 1, 0)
        position, path, direction = values[:2], values[2], values[3:]
        opd = self._differences(lens, position, direction, path + self._path_before(lens))
        away = self._referenced(position)
        # d(OPD) = dV - n'·(dp - dp̄)·(l, m) - n'·(p - p̄)·d(l, m)
        moved = self._referenced(jacobian[:, :2]) * direction + away * jacobian[:, 3:]
        change = (jacobian[:, 2] - self._index(lens) * moved.sum(1)) / self._waves
        return torch.cat([opd[None], self._without_piston(change)[:, None]])

    # ---------------------------------------------------------------- the path difference

    def _differences(self, lens: Lens, position: Tensor, direction: Tensor, path: Tensor) -> Tensor:
        """Return the optical path differences (1, N), wavelengths."""
        tilt = (self._referenced(position) * direction).sum(0)
        return self._without_piston((path - self._index(lens) * tilt) / self._waves)[None]

    def _without_piston(self, values: Tensor) -> Tensor:
        """Return values (..., N) less their mean over each spot."""
        spots = self.spots
        means = values.new_zeros((*values.shape[:-1], spots.count))
        means.index_add_(-1, spots.spot, values * spots.weight)
        return values - means[..., spots.spot]

    def _index(self, lens: Lens) -> Tensor:
        """Return the index n' (N,) before the sensor."""
        return torch.as_tensor(lens.system().materials[-1].index(self._wavelengths))

    def _path_before(self, lens: Lens) -> Tensor:
        """Return the path (N,), mm, from the object's wavefront to where the rays begin."""
        spots = self.spots
        position, direction = spots.rays.position, spots.rays.direction
        index = lens.materials[0].index(self._wavelengths)
        if lens.object_distance is None:
            return index * (position * direction).sum(-1)
        point = torch.nn.functional.pad(spots.fields, (0, 1), value=-lens.object_distance)
        return index * (position - point.to(position)[spots.spot]).norm(dim=-1)

    @property
    def _wavelengths(self) -> Tensor:
        return self.spots.wavelengths.to(self.spots.weight)[self.spots.spot]

    @cached_property
    def _waves(self) -> Tensor:
        """Return each ray's wavelength (N,), mm."""
        return _MM_PER_NM * self._wavelengths

    def _check(self, lens: Lens) -> None:
        if lens.dtype != torch.float64:
            raise InputError("merit.quality 'wavefront' needs double precision: lens_dtype=float64")
        require_plane_sensor(lens.system(), "merit.quality 'wavefront'")
