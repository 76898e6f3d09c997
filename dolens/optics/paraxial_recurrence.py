"""The recurrence of paraxial optics: refraction at a surface, transfer to the next one.

A paraxial ray at a surface is its height y and its reduced slope n·u.  Refraction leaves the height
alone, n'u' = nu - y(n' - n)c; transfer leaves the reduced slope alone, y' = y + (t/n)·nu (Welford,
ch. 3).  Any two rays give all others, so that two are traced at a time.  Everything here is
arithmetic of numbers and tensors alike.  Where light travels towards -z the index is negative.
What adds to a surface's power (n' - n)c, a diffractive phase or an ideal lens, adds to it here.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

Number = Any  # of Python's, or a tensor


class TwoRays(NamedTuple):
    """Heights y and reduced slopes n·u of two rays at one plane.

    Of the rays of unit height and of unit reduced slope, these are the rows of the matrix
    [[A, B], [C, D]] that acts on (y, n·u).

    Attributes:
        y: height of the first ray.
        y2: height of the second.
        nu: reduced slope of the first ray.
        nu2: reduced slope of the second.
    """

    y: Number
    y2: Number
    nu: Number
    nu2: Number

    def transferred(self, thickness: Number, index: Number) -> "TwoRays":
        """The rays behind a gap of a medium."""
        gap = thickness / index
        return TwoRays(self.y + gap * self.nu, self.y2 + gap * self.nu2, self.nu, self.nu2)


UNIT_RAYS = TwoRays(1.0, 0.0, 0.0, 1.0)


def through_surfaces(
    rays: TwoRays,
    curvatures: Sequence[Number],
    thicknesses: Sequence[Number],
    indices: Sequence[Number],
    powers: Sequence[Number] | None = None,
) -> Iterator[TwoRays]:
    """Trace two rays from just before the first of some surfaces to just behind the last.

    Args:
        rays: before the first surface, mm.
        curvatures: paraxial, of N surfaces, 1/mm.
        thicknesses: of the N - 1 gaps between them, mm.
        indices: of the N + 1 media around them.
        powers: of the N surfaces besides that of refraction, 1/mm; None: they have none.

    Yields:
        The rays just behind each surface, at the heights that they have on it.
    """
    y, y2, nu, nu2 = rays
    for i, curvature in enumerate(curvatures):
        before, behind = indices[i], indices[i + 1]
        if i:
            gap = thicknesses[i - 1] / before
            y, y2 = y + gap * nu, y2 + gap * nu2
        power = (behind - before) * curvature
        if powers is not None:
            power = power + powers[i]
        nu, nu2 = nu - power * y, nu2 - power * y2
        yield TwoRays(y, y2, nu, nu2)


def behind_surfaces(
    curvatures: Sequence[Number],
    thicknesses: Sequence[Number],
    indices: Sequence[Number],
    powers: Sequence[Number] | None = None,
) -> TwoRays:
    """Trace the unit rays to just behind the last of some surfaces; themselves where there is none.

    Arguments as of `through_surfaces`.
    """
    every = through_surfaces(UNIT_RAYS, curvatures, thicknesses, indices, powers)
    last = deque(every, maxlen=1)
    return last[0] if last else UNIT_RAYS
