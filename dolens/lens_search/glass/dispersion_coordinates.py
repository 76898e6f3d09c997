"""A glass is a point in three coordinates, and its index at any wavelength is linear in them.

The coordinates are nd, the principal dispersion nF - nC, and (nF - nC) ΔPgF, the distance of
ng - nF from Schott's normal line; each is measured from a common centre in a unit that is about
the spread of the makers' glasses.  Conrady's formula through nd, nF - nC and ng - nF (see
`dolens.optics.model_glass`) is linear in those three, since the normal line makes

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
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.materials import INDEX_MODELS, LINE_C, LINE_D, LINE_F, Medium
from dolens.optics.model_glass import LINE_G, model_glass

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

    def derivative(self, coordinates: Tensor) -> Tensor:
        """Return ∂n/∂coordinates, (..., C, W): the same matrix for every glass, not copied."""
        return self.slopes.expand(*coordinates.shape[:-1], *self.slopes.shape)


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


def coordinates_of(nd: float, vd: float, deviation: float = 0.0) -> tuple[float, float, float]:
    """Return the coordinates of a glass with this nd, Vd and ΔPgF."""
    spread = (nd - 1.0) / vd
    values = (nd, spread, spread * deviation)
    first, second, third = ((v - c) / u for v, c, u in zip(values, CENTRE, UNIT, strict=True))
    return first, second, third


def material_text(coordinates: Sequence[float]) -> str:
    """Return nd/Vd/ΔPgF as a prescription writes a glass, with every digit of the numbers."""
    nd, vd, deviation = nd_vd_deviation(coordinates)
    return f"{nd:.15g}/{vd:.15g}/{deviation:.12f}"


def _conrady(point: Sequence[float], wavelengths: Sequence[float]) -> Tensor:
    """Return the indices of model glass at three coordinates."""
    glass = model_glass("", *nd_vd_deviation(point), INDEX_MODELS["dfc"].lines)
    return torch.tensor([float(glass.index(float(w))) for w in wavelengths], dtype=torch.float64)
