"""A glass is a point in three coordinates, and its index at any wavelength is linear in them.

The coordinates are nd, the principal dispersion nF - nC, and (nF - nC) ΔPgF, the distance of
ng - nF from Schott's normal line; each is measured from a common centre in a unit that is about
the spread of the makers' glasses.  Conrady's formula through nd, nF - nC and ng - nF (see
`dolens.optics.dispersion`) is linear in those three, since the normal line makes

    ng - nF = 0.6438 (nF - nC) - 0.001682 (nd - 1) + (nF - nC) ΔPgF.

So ∂n/∂(coordinates) is a constant matrix, a glass between two others has the indices between
theirs, and a step in Vd, which is worth little to a crown and much to a flint, is worth the same
everywhere.  `conrady_basis` is that formula, and gives what a prescription's nd/Vd/ΔPgF gives.
`fitted_basis` corrects the matrix by least squares over the glasses that a search may use, at its
own wavelengths.

Over the 2405 glasses of Schott, Ohara, Hoya, CDGM, Sumita and Hikari, each given its own nd, Vd and
ΔPgF, the index errs by (rms, largest):

    nm             Conrady            fitted             fitted, two coordinates
    404.7          1.9e-4, 2.2e-3     3.0e-5, 5.1e-4     5.6e-4, 6.6e-3
    435.8-656.3    4.8e-5, 8.3e-4     7.6e-6, 8.8e-5     7.8e-5, 2.4e-3
    680-706.5      1.2e-4, 1.3e-3     2.1e-5, 1.2e-4     5.8e-5, 5.8e-4
    852.1          4.0e-4, 3.7e-3     9.5e-5, 3.8e-4     1.6e-4, 1.2e-3
    1014           7.4e-4, 6.1e-3     2.1e-4, 8.7e-4     2.7e-4, 1.8e-3

Conrady's largest errors are those of flints with Vd below 20, whose ΔPgF is above 0.03: it is
beyond 1e-4 somewhere from 435.8 to 656.3 nm for 8 % of the glasses, the fitted basis for none.
Media without visible dispersion (germanium) have no coordinates.

The region of existing glasses, as linear inequalities that keep continuous glasses near them.

The region is the convex hull of a set of glasses in their coordinates (see
`dolens.lens_search.glass.dispersion_coordinates`), A x ≤ b with unit rows of A: A x - b is then the
distance beyond a face, in the units of the coordinates.  A hull reaches over gaps, so a glass
within it may still be far from any real one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.dispersion import LINE_G, model_glass
from dolens.optics.materials import INDEX_MODELS, LINE_C, LINE_D, LINE_F, Medium

# nd, nF - nC and (nF - nC) ΔPgF at the coordinates (0, 0, 0), and of a step of 1.
CENTRE = (1.6, 0.012, 0.0)
UNIT = (0.1, 0.0075, 0.0003)
# nm.  Of a medium whose range begins above the g line (many plastics are measured from 437 nm on),
# the partial dispersion is that of Conrady's formula through the first wavelength of its range.
_LONGEST_BLUE = 470.0
# Singular values of a fit below this share of the largest are noise: the glasses are too alike.
_RANK = 1e-3


@dataclass(frozen=True)
class DispersionBasis:
    """The indices at some wavelengths as a linear function of a glass's coordinates.

    Attributes:
        wavelengths: nm.
        offset: (W,), the indices at the coordinates 0.
        slopes: (C, W), ∂n/∂coordinate; C is 3, or 2 where ΔPgF is no variable.
    """

    wavelengths: tuple[float, ...]
    offset: Tensor
    slopes: Tensor

    def index(self, coordinates: Tensor) -> Tensor:
        """Return the indices (..., W) of glasses at coordinates (..., C)."""
        return self.offset + coordinates @ self.slopes


def conrady_basis(wavelengths: Sequence[float], count: int = 3) -> DispersionBasis:
    """Return the basis of Conrady's formula, the one of a prescription's nd/Vd/ΔPgF.

    Args:
        wavelengths: nm.
        count: of coordinates: 3, or 2 for glasses on the normal line.

    Raises:
        InputError: a wavelength is not positive, or the count is neither 2 nor 3.
    """
    if count not in (2, 3):
        raise InputError(f"a glass has 2 or 3 coordinates, not {count}")
    if not wavelengths or not all(0.0 < w < math.inf for w in wavelengths):
        raise InputError(f"wavelengths {list(wavelengths)}: they must be positive")
    points = [[0.0] * 3, *([float(i == k) for i in range(3)] for k in range(3))]
    rows = torch.stack([_conrady(point, wavelengths) for point in points])
    return DispersionBasis(tuple(wavelengths), rows[0], rows[1 : count + 1] - rows[0])


def fitted_basis(
    wavelengths: Sequence[float], media: Sequence[Medium], count: int = 3
) -> DispersionBasis:
    """Return the basis that fits these media best at these wavelengths.

    The error of Conrady's formula, a function of nd - 1 and the other coordinates without a
    constant term, is fitted by least squares; where the glasses are fewer than that needs, the
    smallest correction is taken.  nd stays exact.

    Args:
        wavelengths: nm, inside the range of every medium.
        media: glasses that the search may use, at least one.
        count: of coordinates: 3, or 2; two leave what ΔPgF does on average to nd and nF - nC.

    Raises:
        InputError: a medium has no index at a wavelength, or no coordinates (see
            `glass_coordinates`).
    """
    basis = conrady_basis(wavelengths, count)
    coordinates = torch.tensor([glass_coordinates(m) for m in media], dtype=torch.float64)
    indices = medium_indices(media, wavelengths)
    error = indices - basis.index(coordinates[:, :count])
    unit = torch.tensor(UNIT[:count], dtype=torch.float64)
    # nd - 1 and nF - nC vanish with the glass itself, in air.
    zero = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)[:count]
    origin = (zero - torch.tensor(CENTRE[:count], dtype=torch.float64)) / unit
    correction = torch.linalg.pinv(coordinates[:, :count] - origin, rtol=_RANK) @ error
    return DispersionBasis(
        basis.wavelengths, basis.offset - origin @ correction, basis.slopes + correction
    )


def medium_indices(media: Sequence[Medium], wavelengths: Sequence[float]) -> Tensor:
    """Return the indices (K, W) of media at wavelengths in nm.

    Raises:
        InputError: a wavelength lies outside a medium's range.
    """
    rows = [[float(medium.index(float(w))) for w in wavelengths] for medium in media]
    return torch.tensor(rows, dtype=torch.float64).reshape(len(rows), len(wavelengths))


def glass_coordinates(medium: Medium) -> tuple[float, float, float]:
    """Return the coordinates of a glass.

    Raises:
        InputError: it has no index at the lines C, d and F or none from there to 470 nm, or its
            index does not fall from F to C.
    """
    nd, nf, nc = (float(medium.index(line)) for line in (LINE_D, LINE_F, LINE_C))
    spread = nf - nc
    if not spread > 0.0:
        raise InputError(f"glass '{medium.name}': its index does not fall from the F to the C line")
    first = getattr(medium, "wavelengths", (0.0,))[0]
    blue = min(max(LINE_G, first), _LONGEST_BLUE)
    # Conrady's n - nF at that wavelength is linear in the third coordinate.
    known = ((nd - CENTRE[0]) / UNIT[0], (spread - CENTRE[1]) / UNIT[1])
    low, high = (_conrady((*known, third), (blue, LINE_F)) for third in (0.0, 1.0))
    rise = float(medium.index(blue)) - nf
    at_0, at_1 = (float(pair[0] - pair[1]) for pair in (low, high))
    return (*known, (rise - at_0) / (at_1 - at_0))


def nd_vd_deviation(coordinates: Sequence[float]) -> tuple[float, float, float]:
    """Return nd, Vd and ΔPgF of a glass at two or three coordinates."""
    padded = (*(float(x) for x in coordinates), 0.0)[:3]
    nd, spread, third = (c + u * x for c, u, x in zip(CENTRE, UNIT, padded, strict=True))
    return nd, (nd - 1.0) / spread, third / spread


def material_text(coordinates: Sequence[float]) -> str:
    """Return nd/Vd/ΔPgF as a prescription writes a glass, with every digit of the numbers."""
    nd, vd, deviation = nd_vd_deviation(coordinates)
    return f"{nd:.15g}/{vd:.15g}/{deviation:.12f}"


def _conrady(point: Sequence[float], wavelengths: Sequence[float]) -> Tensor:
    """Return the indices of model glass at three coordinates."""
    glass = model_glass("", *nd_vd_deviation(point), INDEX_MODELS["dfc"].lines)
    return torch.tensor([float(glass.index(float(w))) for w in wavelengths], dtype=torch.float64)


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

    def hinges(self, coordinates: Tensor) -> tuple[Tensor, Tensor]:
        """Return max(0, A x - b), (..., F), and its derivative, (..., F, C): as residuals, a row a
        face, they keep a glass in the region.

        On a face the derivative is that beyond it, so that a first step meets a wall there.
        """
        excess = self.excess(coordinates)
        leans = excess > -_ON_FACE
        return excess.clamp(min=0.0), leans[..., None] * self.normals


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


def nearest(coordinates: Tensor, glasses: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return distances to the nearest glasses and their numbers, both (..., count), nearest first.

    Args:
        coordinates: (..., C) of continuous glasses.
        glasses: (K, C).
        count: how many; all K where there are no more.
    """
    flat = coordinates.reshape(-1, glasses.shape[1])
    # No matrix product: its rounding would blur the zero distance of a glass to itself.
    distances = torch.cdist(flat, glasses, compute_mode="donot_use_mm_for_euclid_dist")
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
