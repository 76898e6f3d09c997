"""A law of deflection stands at a surface in the place of Snell's law alone.

A surface is met as any other of its shape.  Its law then says where the light goes from there, and
by how much the optical path changes: a phase on the surface (a grating, a diffractive lens), or an
ideal lens.  A law knows nothing of the shape but the normal at the point, so that one law serves
every shape.
"""

from typing import Any, ClassVar, NamedTuple

from torch import Tensor, nn

from dolens.errors import InputError
from dolens.kernels.surface_kernel import LawKernel
from dolens.optics.surfaces.base import PackedShape, Parameters, by_names, packed_as

Number = float | Tensor
Vector = tuple[Tensor, Tensor, Tensor]


class Media(NamedTuple):
    """Light changes from one medium to another at a surface.

    Attributes:
        before: index in front, in the order of the light's travel.
        behind: index behind.
        per_radian: λ/2π in mm, the path in vacuum that stands for one radian of phase.
    """

    before: Number
    behind: Number
    per_radian: Number


class Travel(NamedTuple):
    """Light travels through a surface in this sense.

    Attributes:
        sense: of the light in front, +1 towards +z.
        behind: of the light behind; a mirror changes it.
        forward: whether the light goes from the object towards the sensor; not so of rays that are
            traced backwards.
    """

    sense: float
    behind: float
    forward: bool


class Deflected(NamedTuple):
    """A law gives direction cosines behind a surface, a margin, and an optical path.

    Attributes:
        l: direction cosine.
        m: direction cosine.
        n: direction cosine.
        transmitted: positive where the light goes on; None: everywhere.
        path: mm, what the law adds to the optical path.
    """

    l: Tensor  # noqa: E741
    m: Tensor
    n: Tensor
    transmitted: Tensor | None
    path: Tensor


class ParaxialPower(NamedTuple):
    """A law adds the power constant + per_nm·λ (1/mm, λ in nm) to a surface's own."""

    constant: Number
    per_nm: Number

    def at(self, wavelength: Number) -> Number:
        """Return the power (1/mm) at a wavelength in nm."""
        return self.constant + self.per_nm * wavelength


class Law(nn.Module):
    """A law's class holds the mathematics, in functions of its parameters.

    Attributes:
        kind: its name in messages.
        kernel: where its fast kernels are; None: it has none, and the reference traces.
        rotational: whether it looks the same from every azimuth.
    """

    kind: ClassVar[str] = ""
    kernel: ClassVar[LawKernel | None] = None
    rotational: ClassVar[bool] = False

    @classmethod
    def deflect(
        cls,
        p: Parameters,
        point: Vector,
        direction: Vector,
        normal: Vector,
        media: Media,
        travel: Travel,
    ) -> Deflected:
        """Deflect rays at points (mm) of a surface with these unit normals towards +z."""
        raise NotImplementedError

    @classmethod
    def numbers(cls, p: Parameters, forward: bool = True) -> tuple[Any, ...]:
        """Return what the functions of `kernel` take; see `Surface.numbers`.

        Args:
            p: parameters.
            forward: as of `Travel`.
        """
        return tuple(p.values())

    @classmethod
    @by_names
    def packed(cls, p: Parameters, forward: bool) -> PackedShape:
        """Return the numbers that `kernel` takes, in its order; the arguments are those of
        `numbers`.
        """
        assert cls.kernel is not None  # its layout is asked for
        return packed_as(cls.kernel.functions.layout, cls.numbers(p, forward))

    @classmethod
    def paraxial_power(cls, p: Parameters) -> ParaxialPower:
        """Return what the law adds to the power of the surface, the mean over azimuth."""
        raise NotImplementedError

    @classmethod
    def section_power(cls, p: Parameters, cosine: Number, sine: Number) -> ParaxialPower:
        """Return what the law adds to the power along (cosine, sine); here: the mean."""
        return cls.paraxial_power(p)

    @classmethod
    def fourth_order_path(cls, p: Parameters) -> Number:
        """Return the coefficient of r⁴ in the path that the law adds, over the wavelength: 1/(mm³
        nm); the mean over azimuth.

        Raises:
            InputError: Seidel sums do not describe the law.
        """
        raise InputError(f"Seidel sums do not describe a {cls.kind}")
