"""A surface that is given by its sag has three Triton functions."""

import hashlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import triton.language as tl


class SagFunctions(NamedTuple):
    """A module offers these functions, compiled by `triton.jit`, as `KERNELS`.

    Each takes a pointer to the surface's record, whose shape begins at `layout.SHAPE`, its row of
    codes, its extras, and points x, y (mm) of the block's rays; numbers take the rays' precision.

    Attributes:
        sag: `(record, codes, extras, x, y)` gives sag (mm), ∂s/∂x, ∂s/∂y, and a margin that is
            positive where the sag exists; where it does not, the numbers must be finite.
        sag_hessian: the same arguments; ∂s/∂x, ∂s/∂y, ∂²s/∂x², ∂²s/∂x∂y and ∂²s/∂y².
        add_sums: `(record, codes, extras, sums, x, y, of_sag, of_x, of_y, alive)` adds with
            `sums.add_sum` the cotangent of each number of the record to the same place of `sums`:
            of_sag·∂s/∂p + of_x·∂²s/∂x∂p + of_y·∂²s/∂y∂p; it returns nothing.
        starts_on_conic: the shape's first two numbers are a conic's, from which the iteration
            starts; else it starts on the vertex plane.
    """

    sag: Any
    sag_hessian: Any
    add_sums: Any
    starts_on_conic: bool = False


class LawKernels(NamedTuple):
    """A law has these functions, compiled by `triton.jit`.

    Both take a pointer to the law's numbers, the step's row of codes, the extras, points x, y (mm)
    of the block's rays, their directions l, m, n, the unit normal nx, ny, nz there, the index in
    front, the ratio μ, λ/2π (mm), and the sense of the light behind.

    Attributes:
        forward: gives l, m, n behind, a number that is positive where the light goes on, and what
            is added to the path.
        adjoint: takes a pointer to the sums of the law's numbers too, behind the extras, and at
            last the directions behind, the cotangents a, b, c of these and that of the path, and
            which rays count; it adds the cotangents of its numbers, and gives those of x and y, of
            the direction in front, of the normal, and of the indices in front and behind.
    """

    forward: Any
    adjoint: Any


# A law as the kernels take it: its code, its functions, and a digest of these.
LAW_CODE, LAW_FORWARD, LAW_ADJOINT = (tl.constexpr(place) for place in range(3))
LawShape = tuple[int, Any, Any, int]


def law_of(code: int, functions: LawKernels) -> LawShape:
    """Return a law's code and functions as the kernels take them."""
    return (code, *functions, _digest(functions))


# A shape as the kernels take it, a tuple of constants: its code and its functions, and at last a
# digest of these, since Triton's cache on disk goes by the names of functions in a tuple.
CODE, SAG, HESSIAN, SUMS, ON_CONIC = (tl.constexpr(place) for place in range(5))
Shape = tuple[int, Any, Any, Any, bool, int]


def shape_of(code: int, functions: SagFunctions) -> Shape:
    """Return a surface's code and functions as the kernels take them."""
    three = functions[:3]
    return (code, *three, functions.starts_on_conic, _digest(three))


def _digest(functions: Sequence[Any]) -> int:
    """Return a number that changes with the functions' sources; Triton before 3.9 takes no text."""
    # Triton's interpreter has no keys.
    keys = "".join(getattr(function, "cache_key", "") for function in functions)
    return int.from_bytes(hashlib.sha256(keys.encode()).digest()[:7])
