"""A surface that is an ideal thin lens: Zemax's PARAXIAL."""

from collections.abc import Mapping

from dolens.errors import InputError
from dolens.optics.surfaces.ideal_lens import IdealLens
from dolens.optics.surfaces.plane import Plane
from dolens.optics.surfaces.registry import register_surface


@register_surface
class ParaxialLens(Plane):
    """The surface is a plane that deflects as an ideal lens of power φ (1/mm) in air; see
    `IdealLens`.
    """

    kind = "paraxial_lens"
    kernel = Plane.kernel
    law = IdealLens
    rotational = True
    closed_form = True

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return the power."""
        if "power" not in keys:
            raise InputError("a paraxial lens needs 'power' (1/mm) or 'focal_length' (mm)")
        return ["power"]
