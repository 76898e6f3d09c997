"""Rays are traced through a lens by the backend that serves them.

A backend is an implementation: PyTorch's operations as the reference, or the kernels for CPUs or
GPUs.
"""

import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from itertools import chain, zip_longest

import torch
from torch import Tensor
from torch.autograd import forward_ad

from dolens.errors import InputError
from dolens.kernels.table import LossTable
from dolens.optics.autograd import is_transformed
from dolens.optics.eager_trace import trace_by_operator, trace_eagerly, traces_eagerly
from dolens.optics.elements import to_lens_axes
from dolens.optics.losses import Losses, loss_table, loss_table_of
from dolens.optics.packing import lay_out, unsupported
from dolens.optics.rays import Components, Rays, TracedRays, finite_rays
from dolens.optics.system import OpticalSystem
from dolens.optics.trace import enter_lens, trace_surfaces, trace_to_sensor, traced_rays

# So many wavelengths are not searched for equal ones.
_FEW = 64


def trace_rays(
    system: OpticalSystem,
    rays: Rays,
    sense: float = 1.0,
    record: bool = False,
    first: int = 1,
    last: int | None = None,
    transmission: bool = False,
    losses: Losses | None = None,
) -> TracedRays:
    """Trace rays through surfaces `first` to `last`, and to the sensor where no last is given.

    Args:
        system: the lens; its `backend` says what traces, see `choose_backend`.
        rays: as users give them.
        sense: +1 towards the sensor, -1 towards the object.
        record: keep the intersections; the reference does this.
        first: number of the first surface.
        last: number of the last, or None.
        transmission: find the share of light that arrives.  The CPU's kernels take it from series
            in the cosine of incidence, which are right to 1e-11 in double precision and 1e-6 in
            single; the reference computes it of every ray.
        losses: of light, for `TracedRays.transmission`; the CPU's kernels alone take them.

    Raises:
        InputError: the lens asks for kernels by name that cannot serve, or the losses for others
            than the CPU's.
    """
    if last is None and sense < 0.0:
        rays = from_sensor(system, rays)
    end = len(system.surfaces) if last is None else last
    to_sensor = last is None and sense > 0.0
    backend = "reference" if record else choose_backend(system, rays)
    lost: LossTable | None = None
    if transmission and losses is None and backend != "reference":
        if backend == "cpu":
            waves = _few(rays.wavelength)
            if waves is not None:
                lost = loss_table_of(system, waves, sense, first, end, to_sensor)
        backend = backend if lost is not None else "reference"
    reference = backend == "reference"
    if losses is not None and backend != "cpu":
        raise InputError(f"losses as series are taken by the CPU's kernels, not by '{backend}'")
    ray = before = None
    if reference or _is_finer(rays, system.dtype):
        ray, before = enter_lens(system, rays, first if sense > 0.0 else end, sense)
    if reference:
        assert ray is not None  # it entered above
        traced = trace_surfaces(
            system, ray, rays.wavelength, sense, True, record, first, last, transmission
        )
        if to_sensor:
            traced = trace_to_sensor(system, traced, rays.wavelength)
        return traced_rays(traced, before)
    position, direction, shape = _joined(system, rays, ray, before)
    found = lay_out(system, sense, first, end, to_sensor)
    which = _columns(rays.wavelength, shape, system.device)
    if losses is not None:
        wavelengths = rays.wavelength.numel() if isinstance(rays.wavelength, Tensor) else 1
        lost = loss_table(losses, found, wavelengths, len(system.surfaces))
    more = () if lost is None else (lost.numbers,)
    eager = traces_eagerly(found, rays.wavelength, position, direction, *more)
    run = trace_eagerly if eager else trace_by_operator
    position, direction, path, status, surface, *shares = run(
        found, rays.wavelength, position, direction, which, lost
    )
    if len(shape) != 1:
        position, direction = position.reshape(*shape, 3), direction.reshape(*shape, 3)
        path, status, surface = (v.reshape(shape) for v in (path, status, surface))
        shares = [share.reshape(shape) for share in shares]
    valid = status.logical_not()  # of OK, which is zero, in half the time of a comparison
    if before is not None:
        path = torch.where(valid, path + before, path + before.detach())
    share = shares[0] if shares else None
    return TracedRays(position, direction, valid, status, surface, path, transmission=share)


def _few(wavelength: float | Tensor) -> tuple[float, ...] | None:
    """Return wavelengths, nm, whose losses the CPU's kernels take; None where there are more."""
    if not isinstance(wavelength, Tensor):
        return (float(wavelength),)
    if wavelength.numel() > _FEW or (wavelength.requires_grad and torch.is_grad_enabled()):
        return None
    return tuple(wavelength.detach().double().reshape(-1).tolist())


def from_sensor(system: OpticalSystem, rays: Rays) -> Rays:
    """Return rays that are given in the sensor's axes, z being the sum of all thicknesses there, in
    the lens's axes; these are the same without coordinate breaks.
    """
    if not system.breaks:
        return rays
    ray = finite_rays(rays, system.dtype).components()
    # In double precision, a sensor metres away loses nothing that a surface needs.
    ray = Components(*(c.to(device=system.device, dtype=torch.float64) for c in ray))
    z = sum(gap.double() for gap in (*system.thicknesses, system.sensor_distance))
    placed = to_lens_axes(ray._replace(z=ray.z - z), system.all_axes[-1])
    return Rays.from_components(placed, rays.wavelength)


def trace_components(
    system: OpticalSystem, ray: Components, wavelength: float | Tensor, sense: float
) -> tuple[Components, Tensor]:
    """Trace rays through the whole lens without statuses and path lengths.

    Args:
        system: the lens; its `backend` says what traces.
        ray: one broadcast shape, in the lens's precision, mm, z from the first vertex.
        wavelength: nm; a tensor broadcasts with the rays.
        sense: +1 towards the sensor, -1 towards the object.

    Returns:
        The rays: on the sensor plane, or on surface 1 for a sense of -1; and bool, which of them
        are valid, as in `TracedRays`.
    """
    rays = Rays.from_components(ray, wavelength)
    if sense < 0.0 and not system.breaks and choose_backend(system, rays) == "reference":
        traced = trace_surfaces(system, ray, wavelength, sense)
        return traced.ray, traced.valid
    hit = trace_rays(system, rays, sense)
    return hit.components(), hit.valid


def _is_finer(rays: Rays, dtype: torch.dtype) -> bool:
    """Return whether rays have numbers that are lost in this precision."""
    position, direction = rays.position.dtype, rays.direction.dtype
    if position is direction is dtype:
        return False
    return torch.promote_types(torch.promote_types(position, direction), dtype) != dtype


def _joined(
    system: OpticalSystem, rays: Rays, ray: Components | None, before: Tensor | None
) -> tuple[Tensor, Tensor, tuple[int, ...]]:
    """Positions and directions (N, 3), and the leading shape; of `ray` where it was moved."""
    if ray is not None and before is not None:
        position, direction = torch.stack(ray[:3], -1), torch.stack(ray[3:], -1)
        return position.reshape(-1, 3), direction.reshape(-1, 3), tuple(ray.x.shape)
    shape = _shape(rays)
    whole, like = (*shape, 3), system.sensor_distance

    def flat(vectors: Tensor) -> Tensor:
        """As the user gave them: a view of (..., 3), which a kernel reads in place."""
        if vectors.dtype is not like.dtype or vectors.device != like.device:
            vectors = vectors.to(like.device, like.dtype)
        if vectors.ndim == 2 and vectors.shape == whole:
            return vectors
        return vectors.expand(whole).reshape(-1, 3)

    return flat(rays.position), flat(rays.direction), shape


@dataclass(frozen=True)
class FlatRays:
    """Rays before a lens as a kernel takes them, in the lens's precision.

    Attributes:
        position: (N, 3), mm.
        direction: (N, 3).
        wavelengths: nm, the distinct ones.
        column: (N,), int32: which of them a ray has, or None where there is one.
        before: (N,), mm: optical path to where the rays were moved, or None.
        shape: the leading shape that they had.
    """

    position: Tensor
    direction: Tensor
    wavelengths: Sequence[float]
    column: Tensor | None
    before: Tensor | None
    shape: tuple[int, ...]


@torch.no_grad()
def flat_rays(system: OpticalSystem, rays: Rays) -> FlatRays:
    """Rays towards the first surface, without a graph; wavelengths that repeat are one."""
    ray = before = None
    if torch.promote_types(rays.position.dtype, system.dtype) != system.dtype:
        ray, before = enter_lens(system, rays, 1, 1.0)
    position, direction, shape = _joined(system, rays, ray, before)
    wavelength = rays.wavelength
    if isinstance(wavelength, Tensor) and wavelength.numel() > _FEW:
        wavelength, column = wavelength.unique(return_inverse=True)
        column = column.to(device=system.device, dtype=torch.int32)
        column = column.expand(shape).reshape(-1).contiguous()
    else:
        column = _columns(wavelength, shape, system.device)
    if before is not None:
        before = before.expand(shape).reshape(-1)
    several = wavelength.reshape(-1).tolist() if isinstance(wavelength, Tensor) else (wavelength,)
    return FlatRays(position, direction, several, column, before, shape)


def _shape(rays: Rays) -> tuple[int, ...]:
    """The common leading shape of a bundle."""
    if rays.position.shape == rays.direction.shape and not isinstance(rays.wavelength, Tensor):
        return tuple(rays.position.shape[:-1])
    return tuple(rays.components().x.shape)


def _columns(
    wavelength: float | Tensor, shape: tuple[int, ...], device: torch.device
) -> Tensor | None:
    """Each ray's column of the table's indices, (N,) int32; None where there is but one."""
    if not isinstance(wavelength, Tensor) or wavelength.numel() == 1:
        return None
    columns = torch.arange(wavelength.numel(), dtype=torch.int32, device=device)
    return columns.reshape(wavelength.shape).expand(shape).reshape(-1).contiguous()


logger = logging.getLogger("dolens.kernels")

BACKENDS = ("auto", "reference", "cpu", "cuda")
# Rays times surfaces below which a lens of backend `auto` is traced without kernels; see `is_few`.
FEW = 2048
_KERNEL_DTYPES = (torch.float32, torch.float64)


def choose_backend(
    system: OpticalSystem, rays: Rays | None = None, others: Iterable[Tensor] = ()
) -> str:
    """Choose which of `reference`, `cpu` and `cuda` traces a lens.

    A lens whose `backend` is `auto` takes the kernels of its device where they serve: for its
    surfaces and precision, outside torch.func's transforms and forward mode, which only the
    reference can follow.  The log says what was taken, once for each reason.

    Args:
        system: the lens; its `backend` is one of `BACKENDS`.
        rays: the rays that are traced.
        others: tensors besides that enter the computation.

    Raises:
        InputError: kernels are asked for by name and cannot serve; the message says why.
    """
    requested = system.backend
    if requested == "reference":
        return "reference"
    device = system.device.type
    reason = unsupported(system)
    if system.from_the_side:
        reason = "kernels trace no light at 90 degrees to the axis and more"
    if device not in ("cpu", "cuda"):
        reason = f"there are no kernels for {device}"
    elif system.dtype not in _KERNEL_DTYPES:
        reason = f"kernels are of float32 and float64, not {system.dtype}"
    elif device == "cuda" and (lack := without_triton()) is not None:
        reason = lack
    elif (
        requested == "auto"
        and reason is None
        and _transformed(chain(_tensors(system, rays), others))
    ):
        reason = "kernels do not follow torch.func or forward mode"
    elif reason is None and rays is not None and _differs_by_colour(system, rays):
        reason = "kernels give no derivatives of a diffractive lens with respect to wavelengths"
    if requested != "auto":
        if device != requested:
            raise InputError(f"backend '{requested}' cannot trace a lens on {device}")
        if reason is not None:
            raise InputError(f"backend '{requested}': {reason}")
        return requested
    if reason is None:
        say_once(f"backend auto: {device} kernels")
        return device
    say_once(f"backend auto: the reference in PyTorch, since {reason}")
    return "reference"


def is_few(system: OpticalSystem, rays: Rays) -> bool:
    """Return whether PyTorch traces a user's rays at once, sooner than kernels are compiled.

    They are few if a lens of backend `auto` has fewer than `FEW` surfaces times rays to trace: 300
    rays through a triplet.  PyTorch then takes some milliseconds, and a first use of kernels some
    tenths of a second, or some seconds where they must be compiled.

    It depends on nothing but the number of rays and surfaces.  The kernels on disk, and calls
    before this one, must not show in the last digits of a result.

    Args:
        system: the lens.
        rays: as users give them.
    """
    if system.backend != "auto" or rays.position.numel() >= 3 * FEW:
        return False
    shapes = [rays.position.shape[:-1], rays.direction.shape[:-1]]
    if isinstance(rays.wavelength, Tensor):
        shapes.append(rays.wavelength.shape)
    # Not torch.broadcast_shapes, whose first call imports SymPy: half a second.
    rays_of_shape = 1
    for sizes in zip_longest(*map(reversed, shapes), fillvalue=1):
        rays_of_shape *= 0 if 0 in sizes else max(sizes)
    return rays_of_shape * len(system.surfaces) < FEW


def with_chosen_backend(system: OpticalSystem, others: Iterable[Tensor] = ()) -> OpticalSystem:
    """Choose the implementation once, for every trace of a computation.

    Args:
        system: the lens.
        others: tensors that enter the computation besides the lens's own.

    Returns:
        The same lens with `reference`, `cpu` or `cuda` as its `backend`; itself where a medium is a
        gradient, whose kernel is a part of the reference's trace.
    """
    if system.gradients and system.backend == "auto":
        return system
    return system.traced_by(choose_backend(system, others=others))


def traced_by_operations(system: OpticalSystem) -> OpticalSystem:
    """Return a lens as `torch.func` can follow its trace: by the reference, whose kernel of
    gradients it follows too.
    """
    follows = system.gradients and system.backend == "auto"
    return system if follows else system.traced_by("reference")


def cpu_kernels_serve(system: OpticalSystem, others: Iterable[Tensor] = ()) -> bool:
    """Return whether what is done with a lens's rays is done by the CPU's fused kernels too.

    These render, splat and look up images; on other devices PyTorch's operations do.
    """
    return choose_backend(system, others=others) == "cpu"


def _tensors(system: OpticalSystem, rays: Rays | None) -> Iterator[Tensor]:
    for surface in system.surfaces:
        yield from surface.parameters.values()
        if surface.deflection is not None:
            yield from surface.deflection.parameters.values()
    yield from system.thicknesses
    yield system.sensor_distance
    if system.image is not None:
        yield from system.image.parameters.values()
    for element in system.elements:
        yield from element.parameters.values()
    if rays is not None:
        given = (rays.position, rays.direction, rays.wavelength)
        yield from (t for t in given if isinstance(t, Tensor))


def _differs_by_colour(system: OpticalSystem, rays: Rays) -> bool:
    """Return whether wavelengths ask for a gradient that passes through a law of deflection."""
    wavelength = rays.wavelength
    asked = isinstance(wavelength, Tensor) and wavelength.requires_grad
    return asked and any(s.deflection is not None for s in system.surfaces)


def _transformed(tensors: Iterable[Tensor]) -> bool:
    """Return whether any tensor is seen through torch.func, or carries a tangent."""
    wrapped = torch._C._functorch.is_functorch_wrapped_tensor
    forward = forward_ad._current_level >= 0
    if not forward and not is_transformed():
        return False
    return any(
        wrapped(t) or (forward and forward_ad.unpack_dual(t).tangent is not None) for t in tensors
    )


@cache
def without_triton() -> str | None:
    """Return why Triton cannot compile the kernels; None where it can."""
    return None if find_spec("triton") is not None else "triton is not installed"


@cache
def say_once(message: str) -> None:
    """Log a message when it is first said."""
    logger.info(message)
