"""What a surface is: parameters, and a few pure functions of them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from dolens.errors import InputError

Parameters = Mapping[str, Tensor]

MAX_NEWTON_STEPS = 40


class PlaneRay(NamedTuple):
    """Rays where they cross the vertex plane z = 0: x, y in mm and direction cosines."""

    x: Tensor
    y: Tensor
    l: Tensor  # noqa: E741
    m: Tensor
    n: Tensor


class Hit(NamedTuple):
    """Distance from the vertex plane (mm), unit normal towards +z, and where it was met."""

    t: Tensor
    nx: Tensor | float
    ny: Tensor | float
    nz: Tensor | float
    met: Tensor


def unit_normal(sx: Tensor, sy: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The unit normal (-s_x, -s_y, 1)/√(1 + s_x² + s_y²) of a sag with these slopes."""
    nz = torch.rsqrt(1.0 + sx * sx + sy * sy)
    return -sx * nz, -sy * nz, nz


def newton(shape: "type[Surface]", p: Parameters, ray: PlaneRay, sense: float, scale: float) -> Hit:
    """Solve sag(x + l·t, y + m·t) = n·t for t, with the derivative of the implicit function.

    The iteration runs outside the autograd graph.  One more step inside the graph leaves the
    value where it is and has the derivative of the root, ∂t = -∂F/F_t with F = sag - n·t.
    """
    x, y, l, m, n = ray  # noqa: E741
    epsilon = torch.finfo(n.dtype).eps
    with torch.no_grad():
        t = shape.start(p, ray, sense)
        for _ in range(MAX_NEWTON_STEPS):
            step = _newton_step(shape, p, ray, t).clamp(-scale, scale)
            t = t - step
            # Newton converges quadratically: after a step of √ε the next is below rounding.
            if bool((step.abs() <= math.sqrt(epsilon) * (t.abs() + scale)).all()):
                break
    step = _newton_step(shape, p, ray, t)
    converged = step.detach().abs() <= 64.0 * math.sqrt(epsilon) * (t.abs() + scale)
    t = t - torch.where(converged, step, torch.zeros_like(step))
    sag, sx, sy, inside = shape.sag_and_gradient(p, x + l * t, y + m * t)
    residual = (sag - n * t).detach().abs()
    on_surface = residual <= 64.0 * epsilon * (t.detach().abs() + sag.detach().abs() + scale)
    crosses = sense * (n - l * sx - m * sy) > 0.0
    return Hit(t, *unit_normal(sx, sy), converged & on_surface & inside & crosses)


def _newton_step(shape: "type[Surface]", p: Parameters, ray: PlaneRay, t: Tensor) -> Tensor:
    x, y, l, m, n = ray  # noqa: E741
    sag, sx, sy, _ = shape.sag_and_gradient(p, x + l * t, y + m * t)
    slope = l * sx + m * sy - n
    tangent = slope.abs() <= torch.finfo(slope.dtype).eps
    return (sag - n * t) / torch.where(tangent, torch.ones_like(slope), slope)


class Surface(nn.Module):
    """A refracting surface about its own vertex: state here, mathematics in its static methods.

    A surface holds scalar parameters (`curvature`, `a4`, `x2y`, ...).  Its static methods take
    them as a mapping, so that a trace can be given other values than the stored ones (scaled
    variables of an optimizer, a batch of perturbed lenses) without touching any state.

    A new shape is a subclass with `kind`, `parameter_names`, `sag_and_gradient`, and a better
    `start` where there is one; `newton` does the rest.  A closed form overrides `intersect`.

    Args:
        semi_diameter: mm, radius of the circular clear aperture.
        parameters: name → number; mm and inverse powers of mm.
    """

    kind: ClassVar[str] = ""
    refracts: ClassVar[bool] = True

    def __init__(
        self,
        semi_diameter: float,
        parameters: Mapping[str, float],
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        self.semi_diameter = float(semi_diameter)
        if not self.semi_diameter > 0.0:
            raise InputError(f"semi_diameter must be positive, not {semi_diameter}")
        for name, value in parameters.items():
            self.register_parameter(name, nn.Parameter(torch.tensor(float(value), dtype=dtype)))
        self.check_aperture()

    def check_aperture(self) -> None:
        """Raise `InputError` where the clear aperture reaches beyond the surface's sag branch."""

    @classmethod
    def parameter_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Which of a prescription's keys are parameters of this shape; others are errors."""
        raise NotImplementedError(f"{cls.__name__} does not say which parameters it has")

    @staticmethod
    def sag_and_gradient(p: Parameters, x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        """Sag and its slopes.

        Args:
            p: parameters.
            x: mm.
            y: mm.

        Returns:
            sag (mm), ∂sag/∂x, ∂sag/∂y, and a mask of where the sag branch exists; outside it
            the numbers are finite.
        """
        raise NotImplementedError

    @staticmethod
    def start(p: Parameters, ray: PlaneRay, sense: float) -> Tensor:
        """First guess of the distance (mm) from the vertex plane along the ray; finite."""
        return torch.zeros_like(ray.x * ray.n)

    @classmethod
    def intersect(cls, p: Parameters, ray: PlaneRay, sense: float, scale: float) -> Hit:
        """Meet the surface: Newton's iteration on the sag, unless the shape has a closed form.

        Args:
            p: parameters.
            ray: at the vertex plane, in the surface's own axes.
            sense: +1 for light travelling towards +z through the surface, -1 for backward mode.
            scale: mm, a length of the size of the aperture; it sets the tolerance near zero.

        Returns:
            The distance, unit normal (towards +z) and mask.  A ray has met the surface when the
            iteration converged onto the sag branch and crosses it in the direction of `sense`.
        """
        return newton(cls, p, ray, sense, scale)

    @staticmethod
    def paraxial_curvature(p: Parameters) -> Tensor:
        """Curvature at the vertex (1/mm), the mean over azimuth."""
        raise NotImplementedError


@dataclass(frozen=True)
class SurfaceState:
    """A surface as the pure functions see it.

    Attributes:
        shape: the `Surface` subclass, used as a namespace of pure functions.
        parameters: name → tensor.
        semi_diameter: mm.
    """

    shape: type[Surface]
    parameters: Parameters
    semi_diameter: float
