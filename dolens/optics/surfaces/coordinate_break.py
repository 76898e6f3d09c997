"""A coordinate break moves and turns the axes of everything behind it; light does not meet it."""

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from dolens.optics.elements import TILTS, rotation_matrix
from dolens.optics.surfaces.base import PackedShape, Parameters
from dolens.optics.surfaces.by_names import by_names
from dolens.optics.surfaces.clear_aperture import ClearAperture, Unlimited
from dolens.optics.surfaces.plane import Plane

# What a break does, in the order of a prescription; mm and radians.
DECENTERS = ("decenter_x", "decenter_y")
BREAK = (*DECENTERS, *TILTS)
# Stands where code asks how far from the vertex light is expected, mm.
_NO_SIZE = 1e-6


class CoordinateBreak(Plane):
    """A coordinate break decentres the axes (mm), then turns them by R = Rx·Ry·Rz (radians).

    A point p in the axes behind it lies at d + R·p in the axes in front, with d = (decenter_x,
    decenter_y, 0): the axes move, then turn about x, about the new y, and about the new z, each
    right-handed.  Its thickness is along the new z.

    Args:
        parameters: any of `BREAK`; the others are zero.
        dtype: precision of the parameters.
    """

    kind = "coordinate_break"
    kernel = Plane.kernel
    closed_form = True
    changes_axes = True
    order: ClassVar[str] = "decenter_first"

    def __init__(
        self, parameters: Mapping[str, float] | None = None, dtype: torch.dtype = torch.float64
    ) -> None:
        numbers = {**dict.fromkeys(BREAK, 0.0), **dict(parameters or {})}
        super().__init__(ClearAperture(Unlimited(_NO_SIZE)), numbers, dtype)

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return the names of decenters and tilts."""
        return list(BREAK)

    @classmethod
    @by_names
    def packed(cls, p: Parameters) -> PackedShape:
        """Return no numbers: kernels see the change of axes alone."""
        return PackedShape(())

    @classmethod
    def motion(cls, p: Parameters) -> tuple[Tensor, Tensor]:
        """Return shift (3,), mm, and rotation (3, 3) of the axes, double; in those in front."""
        return _shift(p), rotation_matrix(*(p[name].double() for name in TILTS))


class TiltFirstBreak(CoordinateBreak):
    """A coordinate break turns the axes by R = Rz·Ry·Rx, then decentres them along the new axes.

    It undoes a `CoordinateBreak` of the opposite numbers: the axes turn about z, the new y and the
    new x, and then move; a point p in the axes behind it lies at R·(d + p) in the axes in front.
    """

    kind = "coordinate_break"
    kernel = Plane.kernel
    closed_form = True
    changes_axes = True
    order = "tilt_first"

    @classmethod
    def motion(cls, p: Parameters) -> tuple[Tensor, Tensor]:
        """Return shift (3,), mm, and rotation (3, 3) of the axes, double; in those in front."""
        # Rz(c)·Ry(b)·Rx(a) is the transpose of Rx(-a)·Ry(-b)·Rz(-c).
        turn = rotation_matrix(*(-p[name].double() for name in TILTS)).mT
        return turn @ _shift(p), turn


# The order of a prescription → class.
BREAKS = {shape.order: shape for shape in (CoordinateBreak, TiltFirstBreak)}


def _shift(p: Parameters) -> Tensor:
    x, y = (p[name].double() for name in DECENTERS)
    return torch.stack([x, y, torch.zeros_like(x)])
