"""The map relates the numbers of a packed table to a lens's variables."""

from dataclasses import dataclass

from torch import Tensor

# Outputs that can be differentiated, and where they lie among the numbers that the kernels keep of
# a ray, and so where their cotangents are one.
OUTPUT_ROWS = {"x": 0, "y": 1, "l": 3, "m": 4, "n": 5, "path_length": 6}


@dataclass(frozen=True, eq=False)
class IndexMap:
    """The map is d(indices)/d(variables), for variables that media depend on.

    The derivatives themselves, (E, wavelengths), are given beside it: they change with every step.

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
