"""Surfaces that add further terms to a conic and even powers of r share this base."""

from collections.abc import Mapping

from torch import Tensor

from dolens.optics.surfaces.base import PackedShape, Parameters, Surface
from dolens.optics.surfaces.conic import check_reach
from dolens.optics.surfaces.even_asphere import EvenAsphere, even_power
from dolens.optics.surfaces.refraction import PlaneRay


class AsphereWithTerms(Surface):
    """The sag is that of an even asphere plus `added_terms`.

    A subclass offers `added_terms`, `added_names` and `added_numbers`.  Its kernels call those of
    the even asphere, and take the further numbers behind c, k, a2, a4, ....
    """

    @classmethod
    def added_terms(cls, p: Parameters, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what is added to the sag (mm) and to its slopes along x and y at points (mm)."""
        raise NotImplementedError

    @classmethod
    def added_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return the parameters of the added terms, of a surface with these keys."""
        raise NotImplementedError

    @classmethod
    def added_numbers(cls, p: Parameters) -> PackedShape:
        """Return the numbers of the added terms; `count` is the even asphere's and not used."""
        raise NotImplementedError

    def check_aperture(self) -> None:
        """Check that the clear aperture ends where the conic does: (1+k)·c²·r² ≤ 1."""
        check_reach(self)

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return curvature, conic constant, even powers, and the added terms."""
        even = {key: value for key, value in keys.items() if even_power(str(key)) is not None}
        return [*EvenAsphere.parameter_names(even), *cls.added_names(keys)]

    @classmethod
    def sag_and_gradient(
        cls, p: Parameters, x: Tensor, y: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Return sag and slopes, and the margin of the conic's branch."""
        sag, sx, sy, exists = EvenAsphere.sag_and_gradient(even_asphere(p), x, y)
        added, ax, ay = cls.added_terms(p, x, y)
        return sag + added, sx + ax, sy + ay, exists

    @classmethod
    def packed(cls, p: Parameters) -> PackedShape:
        """Return the even asphere's numbers, and then those of the added terms."""
        even, added = EvenAsphere.packed(even_asphere(p)), cls.added_numbers(p)
        return added._replace(numbers=(*even.numbers, *added.numbers), count=even.count)

    @classmethod
    def start(cls, p: Parameters, ray: PlaneRay, sense: float) -> Tensor:
        """Return the conic's own intersection, or the vertex plane where that is out of reach."""
        return EvenAsphere.start(p, ray, sense)


def even_asphere(p: Parameters) -> dict[str, Tensor]:
    """Return the parameters of the even asphere among those of a surface."""
    return {
        name: value
        for name, value in p.items()
        if name in ("curvature", "conic") or even_power(name) is not None
    }
