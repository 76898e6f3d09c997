"""The implementation that traces: PyTorch's operations as the reference, or the fast kernels."""

import logging
import re
from collections.abc import Iterable, Iterator
from functools import cache
from itertools import chain, zip_longest

import torch
from torch import Tensor
from torch.autograd import forward_ad

from dolens.errors import InputError
from dolens.optics.packing import unsupported
from dolens.optics.rays import Rays
from dolens.optics.system import OpticalSystem

logger = logging.getLogger("dolens.kernels")

BACKENDS = ("auto", "reference", "cpu", "cuda")
# Rays times surfaces below which a lens of backend `auto` is traced without kernels; see `is_few`.
FEW = 2048
# Before, its compiler fails on functions in tuples, or stumbles over them.
_TRITON = (3, 9)
_KERNEL_DTYPES = (torch.float32, torch.float64)


def check_backend(name: str) -> str:
    """The name itself; raises `InputError` naming the allowed ones."""
    if name not in BACKENDS:
        raise InputError(f"backend '{name}' is unknown; allowed: {', '.join(BACKENDS)}")
    return name


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
        The same lens with `reference`, `cpu` or `cuda` as its `backend`.
    """
    return system.traced_by(choose_backend(system, others=others))


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
    if not forward and torch._C._functorch.peek_interpreter_stack() is None:
        return False
    return any(
        wrapped(t) or (forward and forward_ad.unpack_dual(t).tangent is not None) for t in tensors
    )


@cache
def without_triton() -> str | None:
    """Return why Triton cannot compile the kernels; None where it can."""
    from importlib.util import find_spec

    if find_spec("triton") is None:
        return "triton is not installed"
    import triton

    found = tuple(int(part) for part in re.findall(r"\d+", triton.__version__)[:2])
    if found < _TRITON:
        least = ".".join(map(str, _TRITON))
        return f"triton is {triton.__version__}; allowed: {least} or later, as with PyTorch 2.15"
    return None


@cache
def say_once(message: str) -> None:
    """Log a message when it is first said."""
    logger.info(message)
