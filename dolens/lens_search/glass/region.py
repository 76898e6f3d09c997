"""The region of existing glasses, as linear inequalities that keep continuous glasses near them.

The region is the convex hull of a set of glasses in their coordinates (see
`dolens.lens_search.glass.dispersion_coordinates`), A x ≤ b with unit rows of A: A x - b is then the
distance beyond a face, in the units of the coordinates.  A hull reaches over gaps, so a glass
within it may still be far from any real one; `pull` measures that.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.errors import InputError

# Faces whose unit normals and distances agree to this are one; Qhull cuts faces into triangles.
_SAME_FACE = 1e-9
# Directions in which a set extends by less than this, in units of the coordinates, are flat.
_FLAT = 1e-6
# The outermost glasses lie on faces to within rounding, and no step may hang on that: a glass this
# near to a face leans on it.
_ON_FACE = 1e-9


@dataclass(frozen=True)
class GlassRegion:
    """The convex hull of a set of glasses: the coordinates x with A x ≤ b.

    Attributes:
        normals: A, (F, C), unit rows.
        bounds: b, (F,).
    """

    normals: Tensor
    bounds: Tensor

    def excess(self, coordinates: Tensor) -> Tensor:
        """Return A x - b, (..., F): the distances beyond the faces, negative inside."""
        return coordinates @ self.normals.T - self.bounds

    def contains(self, coordinates: Tensor, tolerance: float = _ON_FACE) -> Tensor:
        """Return whether glasses (..., C) lie in the region, (...)."""
        return (self.excess(coordinates) <= tolerance).all(-1)

    def hinges(self, coordinates: Tensor, margin: float = 0.0) -> tuple[Tensor, Tensor]:
        """Return max(0, A x - b - margin), (..., F), and its derivative, (..., F, C).

        On a face the derivative is that beyond it, so that a first step meets a wall there.

        As residuals, a row a face, they keep a glass in the region; a positive margin lets it go
        that far beyond.
        """
        excess = self.excess(coordinates) - margin
        leans = excess > -_ON_FACE
        return excess.clamp(min=0.0), leans[..., None] * self.normals

    def penalty(self, coordinates: Tensor, margin: float = 0.0) -> tuple[Tensor, Tensor]:
        """Return the root of the sum of the squared hinges, (...), and its derivative, (..., C).

        One residual a glass has the same square as all its hinges, and zero slope inside.
        """
        hinges, slopes = self.hinges(coordinates, margin)
        size = hinges.norm(dim=-1)
        direction = hinges / size.clamp(min=torch.finfo(size.dtype).tiny)[..., None]
        return size, (direction[..., None] * slopes).sum(-2)


def glass_region(coordinates: Tensor) -> GlassRegion:
    """Return the region of a set of glasses.

    Glasses that lie in a plane, on a line or at a point (fewer than C + 1 of them always do) have a
    region of no thickness: pairs of opposite inequalities hold its glasses there.

    Args:
        coordinates: (K, C) of the glasses, K at least 1.

    Raises:
        InputError: there is no glass, or a coordinate is not finite.
    """
    if coordinates.ndim != 2 or coordinates.shape[0] == 0:
        raise InputError("the region of existing glasses needs one glass at least")
    if not bool(torch.isfinite(coordinates).all()):
        raise InputError("the region of existing glasses needs finite coordinates")
    points = coordinates.detach().to("cpu", torch.float64)
    centre = points.mean(0)
    _, sizes, axes = torch.linalg.svd(points - centre, full_matrices=True)
    rank = int((sizes > _FLAT).sum())
    faces = _faces((points - centre) @ axes[:rank].T)
    normals = faces[:, :rank] @ axes[:rank]
    bounds = normals @ centre - faces[:, rank]
    flat = axes[rank:]
    normals = torch.cat([normals, flat, -flat])
    bounds = torch.cat([bounds, flat @ centre, -flat @ centre])
    return GlassRegion(normals.to(coordinates), bounds.to(coordinates))


def pull(coordinates: Tensor, glasses: Tensor) -> tuple[Tensor, Tensor]:
    """Return the vectors from the nearest of the glasses, (..., C), and its number, (...).

    As residuals their derivative is the identity, as long as the nearest glass stays the same.

    Args:
        coordinates: (..., C) of continuous glasses.
        glasses: (K, C).
    """
    number = nearest(coordinates, glasses, 1)[1][..., 0]
    return coordinates - glasses[number], number


def nearest(
    coordinates: Tensor, glasses: Tensor, count: int, weights: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return distances to the nearest glasses and their numbers, both (..., count), nearest first.

    Args:
        coordinates: (..., C) of continuous glasses.
        glasses: (K, C).
        count: how many; all K where there are no more.
        weights: (C,) of the coordinates in the distance; by default 1.
    """
    scale = torch.ones_like(glasses[0]) if weights is None else weights.to(glasses)
    flat = (coordinates * scale).reshape(-1, glasses.shape[1])
    # No matrix product: its rounding would blur the zero distance of a glass to itself.
    distances = torch.cdist(flat, glasses * scale, compute_mode="donot_use_mm_for_euclid_dist")
    found = distances.topk(min(count, glasses.shape[0]), largest=False)
    shape = (*coordinates.shape[:-1], found.indices.shape[-1])
    return found.values.reshape(shape), found.indices.reshape(shape)


def spread(glasses: Tensor, count: int) -> Tensor:
    """Return the numbers of glasses that are far from each other, (count,).

    The first is the one farthest from the mean, and each other that farthest from those before.
    """
    chosen: list[int] = []
    distance = (glasses - glasses.mean(0)).norm(dim=1)
    for _ in range(min(count, len(glasses))):
        chosen.append(int(distance.argmax()))
        away = (glasses - glasses[chosen[-1]]).norm(dim=1)
        distance = away if len(chosen) == 1 else torch.minimum(distance, away)
    return torch.tensor(chosen, dtype=torch.long, device=glasses.device)


def _faces(points: Tensor) -> Tensor:
    """Return the rows (unit normal, offset) of normal·x + offset ≤ 0 of points that fill space."""
    dimension = points.shape[1]
    if dimension == 0:
        return points.new_zeros((0, 1))
    if dimension == 1:
        low, high = points.min(), points.max()
        return torch.stack([torch.stack([-high.new_ones(()), low]),
                            torch.stack([high.new_ones(()), -high])])  # fmt: skip
    # SciPy takes 0.3 s to load, which a lens without a search need not wait for.
    from scipy.spatial import ConvexHull

    equations = torch.from_numpy(ConvexHull(points.numpy()).equations)
    kept: list[Tensor] = []
    for row in equations:
        if not any(bool((row - other).abs().max() < _SAME_FACE) for other in kept):
            kept.append(row)
    return torch.stack(kept)
