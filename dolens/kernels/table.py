"""Kernels see a lens as a table of numbers and codes, with one record for every step of a ray.

A variable map relates the numbers of a table to a lens's variables.

A step is a surface, or a change of axes between elements of different poses, or the sensor plane,
or a deflection: a surface whose light a law deflects has two steps, one that carries rays to it and
leaves their directions alone, and one that changes these.
Steps come in the order that light meets them, so that backward mode is another table, not another
kernel.  Every step has a row of `codes` (integers) and a record in `values` (numbers): a header of
fixed slots and then the numbers of its shape.

Positions count from the vertex at hand, along the axes of the surface at hand.
"""

import math
from dataclasses import dataclass
from enum import IntEnum

from torch import Tensor


class Kind(IntEnum):
    """The kernels' own sources tell these steps apart; after them come surfaces given by their sag.

    The numbers of a surface's shape follow the header of its record, in the order of its `packed`.
    """

    CHANGE_AXES = 0  # the ray is carried to the plane of the next vertex, then turned
    LENS_AXES = 1  # position ← turn·position + step, direction ← turn·direction
    SENSOR = 2  # carried along the line to z = 0, after the shift
    DEFLECT = 3  # where it stands on a surface, a law changes its direction and path
    PLANE = 4  # no numbers
    SPHERE = 5  # c
    CONIC = 6  # c, k
    BY_SAG = 7  # the first code of a `SurfaceKernel` of its own


class Slot:
    """A record's header holds its numbers in these slots."""

    # Of a surface and the sensor: added to z on arrival, minus the gap.
    SHIFT = 0
    # Of a change of axes: step (3) and turn (9, by rows).
    STEP = 0
    TURN = 3
    # The numbers that follow are no variables.
    LIMIT = 12  # |x|, |y| and the distance from the vertex plane are clamped to it, mm
    SCALE = 13  # mm, sets the tolerance of Newton's iteration
    EDGE = 14  # circle: its semi-diameter squared, mm²; else a number out of reach
    HALF_X = 15  # rectangle: half widths, mm; ellipse: 1/a² and 1/b²; see also HALF_Y
    HOLE_X = 16  # the obscuration; circle: its semi-diameter squared; others: as HALF_X
    HOLE_Y = 17
    SENSE = 18  # +1 for light that comes towards +z, -1 towards -z
    TAG = 19  # 4·surface number; a status is added to it where a ray fails
    HALF_Y = 20
    SENSE_BEHIND = 21  # as SENSE, of the light that leaves: the other one behind a mirror
    CENTER_X = 22  # of the rectangle, the ellipse and the obscuration, mm
    CENTER_Y = 23
    HEADER = 24  # length of the header: the shape's first number


class Code:
    """A step's row holds its codes at these places."""

    KIND = 0
    OFFSET = 1  # of the record in `values`
    LENGTH = 2  # of the record, up to data that have no cotangents
    BEFORE = 3  # row of `indices`: medium in front, in the order of travel
    AFTER = 4  # and behind
    REFRACTS = 5  # 0: the same medium on both sides, and no mirror
    EDGE = 6  # an `Outline`
    HOLE = 7
    COUNT = 8  # numbers of a series; rows of a spline
    COLUMNS = 9  # of a spline or a grid; numbers of a second series
    EXTRAS = 10  # offset in `extras`
    DEGREE = 11  # rows of a grid
    # Of a deflection.  Its record holds its surface's shape, of three numbers at least, then the
    # law's.
    LAW = 12  # the code of its `LawKernel`
    BASE = 13  # the kind of the surface that it stands on
    WAVE = 14  # row of `indices` that holds λ/2π, mm
    NUMBERS = 15  # where the law's numbers begin in the record
    FIGURES = 16  # of the aperture, in a row of numbers: where it begins in the record, or 0
    LAW_COUNT = 17  # numbers of the law's series
    LAW_EXTRAS = 18  # offset of the law's table in `extras`
    ROW = 19  # length of a row


class Outline(IntEnum):
    """An aperture's edge and its obscuration have one of these shapes."""

    NONE = 0
    CIRCLE = 1
    RECTANGLE = 2
    ELLIPSE = 3
    FIGURES = 4  # its numbers stand behind the shape's


class Figure(IntEnum):
    """Outlines that have no numbers in the header are made of figures.

    Behind the record's other numbers stand how many there are, and for each of them its kind,
    whether it blocks (1) or passes (0) light, x and y of its centre, how many numbers follow, and
    these.  Lengths are in mm, and points are told from the centre.
    """

    ELLIPTIC = 0  # a, b, low, high: the points with low ≤ a·x² + b·y² ≤ high
    ARM = 1  # c, s, half: those with c·x + s·y ≥ 0 and |c·y - s·x| ≤ half
    # x and y of both ends of each side; points with an odd number of sides towards +x, and those
    # on a side, which block light in either case.
    POLYGON = 2


class Failure:
    """One of these statuses is added to a surface's tag; see `dolens.optics.rays.Status`."""

    VIGNETTED = 1
    TOTALLY_REFLECTED = 2
    MISSED = 3
    BITS = 2  # that a tag leaves free for a status
    MASK = 3


# Steps of Newton's iteration at most, as in `dolens.optics.surfaces.newton`.
NEWTON_STEPS = 40
# After a step of √ε the next is below rounding, but for rays along a tangent, which take some more.
LAST_STEPS = 2


@dataclass(frozen=True)
class SurfaceTable:
    """A lens, or some of its surfaces, is packed for rays of one sense.

    Attributes:
        values: (V,), the records one after the other, and last of all what is added to z of the
            rays that leave the last step, mm; in the rays' precision; differentiable.
        indices: (media, wavelengths), float64, in the order of travel; differentiable.  Of a lens
            with deflections a last row holds λ/2π, mm.
        codes: (steps, Code.ROW), int64, on the CPU.
        extras: (E,), int64, on the CPU.
    """

    values: Tensor
    indices: Tensor
    codes: Tensor
    extras: Tensor

    def alone(self) -> "SurfaceTable":
        """Return the table of many lenses of which there is this one."""
        return SurfaceTable(self.values[None], self.indices[None], self.codes, self.extras)


class Cosine(IntEnum):
    """The power that a surface passes is a series in the cosine of incidence that is taken here.

    It is smooth in the cosine of the medium of the lower index, up to grazing light: in the other
    medium it has the root of the critical angle.
    """

    ARRIVING = 0  # in the medium in front
    LEAVING = 1  # in the medium behind
    # At a mirror: in the medium beyond it, by Snell's law; zero past the critical angle.
    BEYOND = 2


@dataclass(frozen=True, eq=False)
class LossTable:
    """The losses of light at a table's steps and between them.

    Attributes:
        numbers: float64, contiguous: the absorption (media, wavelengths), 1/mm, with the rows of
            `SurfaceTable.indices`; of S steps the ratios (S, wavelengths), of the index in front to
            that beyond; 2/(1 - lowest cosine u_0) of each, s (S,); the coefficients (S,
            wavelengths, K) of T_k(x), x = 1 - s·(1 - u), K a multiple of 8; then, as the kernels
            sum them, the same series again, its derivative with respect to u, and the series of
            0 < x ≤ 1 as powers of 2x - 1, which has fewer terms.
        steps: (steps, 4), int64, on the CPU: which of the S, in their order, a step has, or -1; a
            `Cosine`; how many of the K terms are summed, a multiple of 8: as powers of x, which is
            faster, or, where it is negative, as T_k; and how many powers of 2x - 1, or 0.
        series: S.
        absorbs: whether any medium does.
    """

    numbers: Tensor
    steps: Tensor
    series: int
    absorbs: bool


# Powers of x are not summed where their coefficients' sizes exceed this together: digits would be
# lost, where those of T_k are not.
POWERS = 8.0

# Outputs that can be differentiated, and where they lie among the numbers that the kernels keep of
# a ray, and so where their cotangents are one.
OUTPUT_ROWS = {"x": 0, "y": 1, "l": 3, "m": 4, "n": 5, "path_length": 6}


@dataclass(frozen=True, eq=False)
class IndexMap:
    """The map is d(indices)/d(variables), for variables that media depend on.

    The derivatives themselves change with every step; see `MapOfLenses`.

    Attributes:
        rows: (E,), int64: which row of `SurfaceTable.indices`, a medium.
        columns: (E,), int64: which variable.
    """

    rows: Tensor
    columns: Tensor


@dataclass(frozen=True, eq=False)
class VariableMap:
    """The map is d(values)/d(variables), a sparse matrix in lists of its entries.

    A number that follows from several variables, or a variable that several numbers follow from,
    has as many entries.  Coefficients of a spline are variables themselves, so their weights are 1.

    Attributes:
        places: (E,), int64: which of `SurfaceTable.values`.
        columns: (E,), int64: which variable.
        weights: (E,), float64: the derivative.
        count: of variables.
        indices: what media depend on; None: they are constant.
    """

    places: Tensor
    columns: Tensor
    weights: Tensor
    count: int
    indices: IndexMap | None = None


@dataclass(frozen=True, eq=False)
class MapOfLenses:
    """The map of the variables of L lenses holds what each of them has for itself, too.

    It is new at every step; the map within stays, so that it is sorted once.

    Attributes:
        map: the same for all lenses, of E entries.
        weights: (L, E), float64, in the place of those of the map; None: they hold for all lenses.
        index_derivatives: (L, entries, wavelengths), float64, for `map.indices`; None without.
    """

    map: VariableMap
    weights: Tensor | None = None
    index_derivatives: Tensor | None = None

    @property
    def count(self) -> int:
        """Return P, the number of variables."""
        return self.map.count

    def of(self, lenses: Tensor | slice) -> "MapOfLenses":
        """Return the map of some of the lenses."""
        parts = (self.weights, self.index_derivatives)
        return MapOfLenses(self.map, *(None if p is None else p[lenses] for p in parts))


# Smallest cosine that is divided by, and its square, which is far above the smallest float32.
GRAZING, TINY = 1e-9, 1e-18
# mm; nothing that can be seen is farther away.
FARTHEST = 1e30
# No unit vector has a larger component; directions behind a surface are held there too.
LONGEST = 2.0
# An order that would turn light by more than this sine, |g_x| + |g_y|, is evanescent.
STEEPEST = 1e6
# |a·N| ≤ n/n' + |g| is below this: it holds rays in range whose directions are no unit vectors.
LONGEST_WAVEVECTOR = 2.0 * STEEPEST

# Kicks and drifts of a step in a gradient-index medium, which take turns; each reads the same
# backwards (Blanes and Moan, SRKN 11).
_HALF = (
    *(0.0414649985182624, 0.198128671918067, -0.0400061921041533),
    *(0.0752539843015807, -0.0115113874206879),
)
KICKS = (*_HALF, *(2 * (0.5 - math.fsum(_HALF),)), *_HALF[::-1])
_HALF = (
    *(0.123229775946271, 0.290553797799558, -0.127049212625417),
    *(-0.246331761062075, 0.357208872795928),
)
DRIFTS = (*_HALF, 1.0 - 2.0 * math.fsum(_HALF), *_HALF[::-1])
