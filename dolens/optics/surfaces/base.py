"""A surface is a set of parameters and a few pure functions of them.

Whether a ray is valid is carried as margins: numbers that are positive where a condition holds.
The minimum of all margins decides at the end.  Comparing and selecting by masks costs five times
the arithmetic, so invalid rays are kept finite by clamps instead, at limits that no valid ray
reaches; their gradient is cut off where the trace ends.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from dolens.errors import InputError
from dolens.kernels.shapes import TABLE, Shape
from dolens.kernels.surface_kernel import SurfaceKernel
from dolens.kernels.table import GRAZING, Code
from dolens.optics.autograd import is_transformed
from dolens.optics.rays import Components
from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture
from dolens.optics.surfaces.newton import find_root
from dolens.optics.surfaces.refraction import FAR, PlaneRay, Refraction, snell

if TYPE_CHECKING:
    from dolens.optics.coatings import Coating
    from dolens.optics.diffractive import DiffractiveElement
    from dolens.optics.gradients import GradientTerms
    from dolens.optics.metasurface import Metasurface
    from dolens.optics.surfaces.deflection import Law
    from dolens.optics.surfaces.phase import Phase

_Packed = TypeVar("_Packed", bound=Callable[..., Any])


def by_names(packed: _Packed) -> _Packed:
    """Mark a `packed` that returns stored parameters, chosen by their names and shapes alone.

    What such a method returned holds for any values of the same parameters, so that a lens whose
    shapes have no other need not be asked at every trace.  Overriding a method takes its mark away.
    """
    packed.by_names = True  # type: ignore[attr-defined]
    return packed


def is_by_names(packed: Callable[..., Any]) -> bool:
    """Return whether a `packed` has the mark."""
    return getattr(packed, "by_names", False)


Parameters = Mapping[str, Tensor]

# A ray whose crossing rounding moves by this share of its distance and semi-diameter is invalid.
_UNCERTAIN = 1e-2


class PackedShape(NamedTuple):
    """A shape gives its kernel these numbers.

    Attributes:
        numbers: scalars and arrays, the latter by rows; None: zero.
        count: numbers of a series, or rows of a spline.
        columns: of a spline or a grid, or numbers of a second series.
        degree: rows of a grid, or what the kernel says.
        extras: further integers.
        data: so many numbers at the end are data, which have no cotangents.
    """

    numbers: tuple[Tensor | None, ...]
    count: int = 0  # type: ignore[assignment]  # a tuple has a method of that name
    columns: int = 0
    degree: int = 0
    extras: tuple[int, ...] = ()
    data: int = 0


def packed_as(layout: Sequence[int | None], parts: Sequence[Any], **more: Any) -> PackedShape:
    """Return the numbers of a shape of plain functions for its kernels.

    Args:
        layout: of its `Shape`, or of its law's functions.
        parts: what its functions take; a number that is no tensor is zero.
        more: further fields of `PackedShape`.

    A series is filled up to a multiple of four, and its length stands where the layout says.  A
    table makes the extras; beside it, nothing is filled up.

    Raises:
        InputError: more or fewer parts than the layout has.
    """
    if len(layout) != len(parts):
        raise InputError(f"a layout of {len(layout)} parts, where `numbers` gives {len(parts)}")
    fields = {Code.COUNT: "count", Code.COLUMNS: "columns", Code.LAW_COUNT: "count"}
    numbers: list[Any] = []
    group = 1 if TABLE in layout else 4
    for place, part in zip(layout, parts, strict=True):
        if place is None:
            numbers.append(part)
        elif place == TABLE:
            more["extras"] = (len(part), *part)
        else:
            numbers += (*part, *(-len(part) % group) * (0.0,))
            more[fields[place]] = len(part) + -len(part) % group
    tensors = (number if isinstance(number, Tensor) else None for number in numbers)
    return PackedShape(tuple(tensors), **more)


def everywhere(numbers: Sequence[Any], x: Tensor, y: Tensor) -> list[Tensor]:
    """Return numbers of as many dimensions as the points x, y, where some are the same everywhere,
    or are no tensors.
    """
    # Not torch.broadcast_shapes, whose first call imports SymPy: half a second.
    shape = torch.broadcast_tensors(x, y)[0].shape

    def full(n: Any) -> Tensor:
        there = isinstance(n, Tensor) and n.dim() >= len(shape)
        found: Tensor = n if there else x.new_zeros(shape) + n
        return found

    return [full(n) for n in numbers]


def tensor_of(value: Any, name: str, dtype: torch.dtype) -> Tensor:
    """Return a new tensor of a number, nested lists of numbers, or an array.

    Raises:
        InputError: entries that are no numbers, or rows of unequal length.
    """
    try:
        # By way of lists, arrays of any library and memory order are read alike.
        return torch.tensor(value.tolist() if hasattr(value, "tolist") else value, dtype=dtype)
    except (TypeError, ValueError):
        raise InputError(f"'{name}' must be numbers, in rows of equal length") from None


class Surface(nn.Module):
    """A surface refracts rays; it holds its parameters, and its class the mathematics.

    Most parameters are scalars (`curvature`, `a4`, `x2y`, ...).  The methods for light take them as
    a mapping, so that a trace can be given other values than the stored ones (scaled variables of
    an optimizer, a batch of perturbed lenses) without touching any state.

    A new shape is a subclass with `kind`, `parameter_names`, `sag_and_gradient` or a `shape`, and a
    better `start` where there is one; Newton's iteration does the rest.  A shape with a closed form
    overrides `intersect` and `normal`.  `register_surface` makes it known to prescriptions.

    Args:
        aperture: the clear aperture; a number is the semi-diameter of a circle, mm.
        parameters: name → number, or array of numbers; mm and inverse powers of mm.
        dtype: precision of the parameters.

    Attributes:
        kind: the `type` of a prescription.
        constants: names among the parameters that no optimizer varies (knots); they are buffers.
        arrays: names that a prescription gives as lists; every other is one number.
        optional: names that a prescription may leave out; every other is then zero.
        curvatures: names of which a prescription may give the radius instead: `radius` for
            `curvature`, `radius_x` for `curvature_x`.
        shape: the sag and its derivatives, in functions that the kernels share with the reference;
            a subclass inherits them, but no kernels.
        kernel: where its fast kernels are, those of its own `shape` if nothing is said; None: it
            has none, and the reference traces.
        rotational: whether the sag looks the same from every azimuth, whatever the parameters.
        closed_form: whether `intersect` needs no iteration, and no number that follows overflows.
        flat: whether the sag is zero.  These four are not inherited, since a subclass may have
            another sag.
        changes_axes: whether this is a coordinate break, which light does not meet.
        law: what deflects light in the place of Snell's law, by the surface's own parameters; see
            `dolens.optics.surfaces.deflection`.
        phase: a grating or a diffractive lens on this surface, or None.
        coating: what decides which share of the light passes, or None: all of it.
        diffractive: relief or cells of a diffractive element, which waves see and rays do not, or
            None.
        gradient: coefficients of a gradient of the index behind this surface, or None.
    """

    kind: ClassVar[str] = ""
    shape: ClassVar[Shape | None] = None
    kernel: ClassVar[SurfaceKernel | None] = None
    constants: ClassVar[tuple[str, ...]] = ()
    arrays: ClassVar[tuple[str, ...]] = ()
    optional: ClassVar[tuple[str, ...]] = ()
    curvatures: ClassVar[tuple[str, ...]] = ("curvature",)
    rotational: ClassVar[bool] = False
    closed_form: ClassVar[bool] = False
    flat: ClassVar[bool] = False
    changes_axes: ClassVar[bool] = False
    law: ClassVar["type[Law] | None"] = None
    phase: "Phase | None"
    coating: "Coating | None"
    diffractive: "DiffractiveElement | Metasurface | None"
    gradient: "GradientTerms | None"

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        shape: Shape | None = cls.__dict__.get("shape")
        cls.kernel = cls.__dict__.get("kernel", shape and SurfaceKernel(shape=shape))
        cls.rotational = cls.__dict__.get("rotational", False)
        cls.closed_form = cls.__dict__.get("closed_form", False)
        cls.flat = cls.__dict__.get("flat", False)

    def __init__(
        self,
        aperture: ClearAperture | float,
        parameters: Mapping[str, Any],
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        if not isinstance(aperture, ClearAperture):
            aperture = ClearAperture(Circle(float(aperture)))
        self.aperture = aperture
        self.phase = None
        self.coating = None
        self.diffractive = None
        self.gradient = None
        for name, value in parameters.items():
            tensor = tensor_of(value, name, dtype)
            if name in self.constants:
                self.register_buffer(name, tensor)
            else:
                self.register_parameter(name, nn.Parameter(tensor))
        if aperture.clips:
            self.check_aperture()

    @property
    def semi_diameter(self) -> float:
        """Return the distance of the clear aperture's farthest point from the vertex, mm."""
        return self.aperture.semi_diameter

    def check_aperture(self) -> None:
        """Raise `InputError` where the clear aperture reaches beyond the surface's sag branch."""

    @property
    def reach(self) -> float:
        """Return the distance from the axis, mm, at which the sag branch ends; `inf` where it goes
        on.
        """
        return math.inf

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return the parameters of a surface with these keys in its prescription."""
        raise NotImplementedError

    @classmethod
    def sag_and_gradient(
        cls, p: Parameters, x: Tensor, y: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Return the sag and its slopes.

        Args:
            p: parameters.
            x: mm.
            y: mm.

        Returns:
            sag (mm), ∂sag/∂x, ∂sag/∂y, and a margin that is positive where the sag branch exists
            (None: everywhere).  Where it does not, the numbers are finite.

        Here: those of `shape`.
        """
        if cls.shape is None:
            raise NotImplementedError
        *found, exists = cls.shape.sag(cls.numbers(p), x, y)
        sag, sx, sy = everywhere(found, x, y)
        return sag, sx, sy, exists.detach() if isinstance(exists, Tensor) else None

    @classmethod
    def numbers(cls, p: Parameters) -> tuple[Any, ...]:
        """Return what the functions of `shape` take: numbers, and series of them; 0.0 is none.

        Here: all parameters in the order of `parameter_names`, and then the constants.
        """
        return tuple(p.values())

    @classmethod
    @by_names
    def packed(cls, p: Parameters) -> PackedShape:
        """Return the numbers that `kernel` takes, in its order.

        Here: `numbers`, with series filled up to a multiple of four.
        """
        numbers = cls.numbers(p)
        if cls.shape is None:
            return PackedShape(numbers)
        return packed_as(cls.shape.layout, numbers)

    @classmethod
    def paraxial_curvature(cls, p: Parameters) -> Tensor | float:
        """Return the curvature at the vertex (1/mm), the mean over azimuth.

        Here: from the derivative of the slopes at the vertex, for any sag.
        """
        slope, origin = cls._slope_by_azimuth(p)
        return _derivative(slope)(origin).mean()

    @classmethod
    def section_curvature(
        cls, p: Parameters, cosine: Tensor | float, sine: Tensor | float
    ) -> Tensor | float:
        """Return the curvature at the vertex (1/mm) of the section along (cosine, sine): from the
        derivative of the slope, for any sag.
        """
        slope, origin = cls._slope_along(p, cosine, sine)
        return _derivative(slope)(origin)

    @classmethod
    def fourth_order_departure(cls, p: Parameters) -> Tensor | float:
        """Return the coefficient G (1/mm³) of r⁴ in the sag beyond the osculating sphere, c·r²/2 +
        c³·r⁴/8.

        Here: from derivatives of the slopes at the vertex, for any sag.  Along an azimuth the
        fourth derivative is 24 times the r⁴ coefficient.  Of a surface without rotational symmetry
        G is the average over azimuth, which three azimuths 60° apart give exactly, since a quartic
        form has harmonics 0, 2 and 4 only.
        """
        slope, origin = cls._slope_by_azimuth(p)
        fourth = _derivative(_derivative(_derivative(slope)))(origin)
        return fourth.mean() / 24.0 - cls.paraxial_curvature(p) ** 3 / 8.0

    @classmethod
    def _slope_by_azimuth(cls, p: Parameters) -> tuple[Callable[[Tensor], Tensor], Tensor]:
        """Return the slope along three azimuths 60° apart at distances r (3,), and zero r."""
        like = next(iter(p.values()))
        azimuth = torch.arange(3, dtype=like.dtype, device=like.device) * (math.pi / 3.0)
        slope, _ = cls._slope_along(p, torch.cos(azimuth), torch.sin(azimuth))
        return slope, torch.zeros_like(azimuth)

    @classmethod
    def _slope_along(
        cls, p: Parameters, cosine: Tensor | float, sine: Tensor | float
    ) -> tuple[Callable[[Tensor], Tensor], Tensor]:
        """Return the slope along directions (cosine, sine) at distances r, and zero r."""

        def slope(r: Tensor) -> Tensor:
            _, sx, sy, _ = cls.sag_and_gradient(p, r * cosine, r * sine)
            return sx * cosine + sy * sine

        return slope, next(iter(p.values())).new_zeros(())

    @classmethod
    def start(cls, p: Parameters, ray: PlaneRay, sense: float) -> Tensor:
        """Return a first guess of the distance (mm) from the vertex plane along the ray; finite."""
        return torch.zeros_like(ray.x)

    @classmethod
    def intersect(
        cls, p: Parameters, ray: PlaneRay, sense: float, scale: float
    ) -> tuple[Tensor, Tensor | None]:
        """Find where rays meet the surface.

        Here: Newton's iteration for F = sag(x + l·t, y + m·t) - n·t = 0, outside any graph.  Each
        further step, inside the graph, doubles the order of the derivatives that are those of the
        implicit function: one step gives ∂t = -∂F/F_t, the second, which leaves the value alone,
        makes second derivatives right.

        Args:
            p: parameters.
            ray: at the vertex plane, in the surface's own axes.
            sense: +1 for light that comes towards +z, -1 for light that comes towards -z.
            scale: mm, a length of the size of the aperture; it sets the tolerance near zero.

        Returns:
            The distance t (mm) from the vertex plane, and a margin that is positive where the ray
            meets the sag branch there and crosses it in the direction of `sense`.
        """
        epsilon = torch.finfo(ray.n.dtype).eps

        def step(values: Parameters, rays: tuple[Tensor, ...], t: Tensor) -> Tensor:
            return _newton_step(cls, values, PlaneRay(*rays), t)

        def accepts(values: Parameters, rays: tuple[Tensor, ...], t: Tensor) -> Tensor:
            """Say whether a ray is near the sag and crosses it in the direction of `sense`."""
            x, y, l, m, n = rays  # noqa: E741
            sag, sx, sy, _ = cls.sag_and_gradient(values, x + l * t, y + m * t)
            slope = l * sx + m * sy - n
            reach = slope.abs() * (t.abs() + scale)
            return (sense * slope < 0.0) & ((sag - n * t).abs() <= math.sqrt(epsilon) * reach)

        with torch.no_grad():
            start = cls.start(p, ray, sense).clamp(-FAR * scale, FAR * scale)
        t = find_root(step, accepts, p, start, ray, scale)
        # Lost rays take their derivatives, which nobody uses, at the vertex: they are finite there.
        lost = t != t
        t = t.masked_fill(lost, 0.0)
        ray = ray._replace(x=ray.x.masked_fill(lost, 0.0), y=ray.y.masked_fill(lost, 0.0))
        with torch.no_grad():
            # Read the residual off the root: convergence is checked, never assumed.
            x, y = torch.addcmul(ray.x, ray.l, t), torch.addcmul(ray.y, ray.m, t)
            sag, sx, sy, exists = cls.sag_and_gradient(p, x, y)
            z = ray.n * t
            crossing = sense * (ray.n - ray.l * sx - ray.m * sy)
            # Where the surface is steep along the ray, the rounding of t counts so much more.
            steep = crossing.abs().clamp(min=1.0)
            rounding = 64.0 * epsilon * torch.addcmul(sag.abs(), t.abs() + scale, steep)
            margin = torch.minimum(rounding - (sag - z).abs(), crossing)
            if exists is not None:
                margin = torch.minimum(margin, exists)
            # Along a tangent rounding decides where the surface is met: one step more goes far.
            change = ((sag - z) / crossing.abs().clamp(min=GRAZING)).abs()
            uncertain = ~(change <= _UNCERTAIN * (t.abs() + scale))
            # So far from the surface that its slopes' derivatives may be beyond all numbers.
            far = uncertain | ~((sag - z).abs() <= FAR * scale)
        t = t.masked_fill(far, 0.0)
        ray = ray._replace(x=ray.x.masked_fill(far, 0.0), y=ray.y.masked_fill(far, 0.0))
        t = t - _newton_step(cls, p, ray, t).clamp(-scale, scale)
        if torch.is_grad_enabled():
            last = _newton_step(cls, p, ray, t).clamp(-scale, scale)
            t = t - (last - last.detach())
        return t, margin.masked_fill(lost | far, -1.0)

    @classmethod
    def intersect_from(
        cls, p: Parameters, ray: Components, sense: float
    ) -> tuple[Tensor, Tensor] | None:
        """Find where rays from any point meet the surface, as `intersect` does from the vertex
        plane; so do rays that come along that plane or from behind it.

        Here: None, the surface is met from the vertex plane only.

        Args:
            p: parameters.
            ray: in the surface's own axes, at a point near the vertex.
            sense: as in `intersect`.
        """
        return None

    @classmethod
    def normal(
        cls, p: Parameters, x: Tensor, y: Tensor, z: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the unit normal towards +z at a point of the surface: (-s_x, -s_y, 1)/√(1 + s_x² +
        s_y²).
        """
        _, sx, sy, _ = cls.sag_and_gradient(p, x, y)
        nz = torch.rsqrt(torch.addcmul(torch.addcmul(torch.ones_like(sx), sx, sx), sy, sy))
        return -sx * nz, -sy * nz, nz

    @classmethod
    def refract(
        cls,
        p: Parameters,
        point: tuple[Tensor, Tensor, Tensor],
        direction: tuple[Tensor, Tensor, Tensor],
        ratio: float | Tensor,
        sense: float,
    ) -> Refraction:
        """Refract or reflect rays at points (mm) of the surface; see `snell`."""
        return snell(direction, cls.normal(p, *point), ratio, sense)


def _derivative(function: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """Return the derivative of an elementwise function, in reverse mode: it may be nested."""

    def derivative(r: Tensor) -> Tensor:
        if is_transformed():
            return torch.func.vjp(function, r)[1](torch.ones_like(r))[0]
        # Outside of transforms not by them: their first use imports PyTorch's compiler, 2 seconds;
        # and a derivative of anything but a sum imports SymPy.
        graph = torch.is_grad_enabled()
        with torch.enable_grad():
            at = r if r.requires_grad else r.detach().requires_grad_()
            value = function(at)
            if not value.requires_grad:
                return torch.zeros_like(r)
            (slope,) = torch.autograd.grad(
                value.sum(), at, create_graph=True, materialize_grads=True
            )
        # The graph leads to `at` anyway: it is kept where it leads further.
        return slope if graph and function(r).requires_grad else slope.detach()

    return derivative


def _newton_step(shape: type[Surface], p: Parameters, ray: PlaneRay, t: Tensor) -> Tensor:
    x, y, l, m, n = ray  # noqa: E741
    sag, sx, sy, _ = shape.sag_and_gradient(p, torch.addcmul(x, l, t), torch.addcmul(y, m, t))
    slope = torch.addcmul(torch.addcmul(-n, l, sx), m, sy)
    magnitude = slope.abs().clamp(min=GRAZING)
    return torch.addcmul(sag, n, t, value=-1.0) / torch.copysign(magnitude, slope)
