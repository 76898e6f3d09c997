"""Point spread functions by rays of every order of a lens's diffractive elements."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from dolens.diffraction.element_orders import bent_to, orders_of
from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.errors import InputError
from dolens.optics.diffractive import Relief
from dolens.optics.system import OpticalSystem
from dolens.rendering.imaging_system import ImagingSystem

# Least share of the light of an order that is traced; the rest is haze.
_TRACED = 0.02


def has_orders(system: OpticalSystem) -> bool:
    """Return whether a lens has diffractive elements, each the relief of a phase alone."""
    return bool(system.diffractive) and all(
        _phase_alone(system, number) for number in system.diffractive
    )


def _phase_alone(system: OpticalSystem, number: int) -> bool:
    surface = system.surfaces[number - 1]
    return (
        surface.deflection is not None
        and isinstance(surface.relief, Relief)
        and surface.relief.values is None
    )


def functions_of_orders(
    imaging: ImagingSystem,
    places: Tensor,
    wavelengths: Tensor,
    by_rays: Callable[[ImagingSystem], tuple[Tensor, Tensor]],
) -> tuple[Tensor, Tensor, Tensor]:
    """Return functions of all orders, each by its own rays and with its share of the light.

    Shares are those of light along the chief rays, constants; the light is that of rays' order.
    Orders of less than 2 % of the light, and light beyond the window, are haze: even within it.

    Args:
        imaging: the lens, D depths and C wavelengths.
        places: (N·D·C, 3), mm, object points of N functions.
        wavelengths: (N·D·C,), nm.
        by_rays: functions (N, D, C, K, K) and their whole light (N, 1, C) by the rays of a lens in
            one order.

    Returns:
        Functions, light, and the largest share of haze, ().

    Raises:
        InputError: an element of heights or cells, which have no orders.
    """
    system = imaging.system
    functions, light = by_rays(imaging)
    if not system.diffractive:
        whole = functions.sum((-2, -1))
        lost = torch.where(light > 0.0, 1.0 - whole / light.clamp(min=1e-30), 0.0)
        return functions, light, lost.detach().amax()
    for number in system.diffractive:
        if not _phase_alone(system, number):
            raise InputError(
                f"diffraction orders: surface {number} has heights or cells, which have no orders; "
                "allowed: wave"
            )
    laws = (system.surfaces[number - 1].deflection for number in system.diffractive)
    own = tuple(round(float(law.parameters["order"])) for law in laws if law is not None)
    total = torch.zeros_like(functions)
    for order in orders_of(system.double(), ObjectPoints.at(places), wavelengths):
        if float(order.share.max()) < _TRACED:
            continue
        part, whole = functions, light
        if order.numbers != own:
            part, whole = by_rays(replace(imaging, system=bent_to(system, order.numbers)))
        share = order.share.reshape(functions.shape[:3]).to(light)
        scale = torch.where(whole > 0.0, share * light / torch.where(whole > 0.0, whole, 1.0), 0.0)
        total = total + part * scale[..., None, None]
    haze = (light - total.sum((-2, -1))).clamp(min=0.0)
    total = total + (haze / total.shape[-1] ** 2)[..., None, None]
    lost = torch.where(light > 0.0, haze / light.clamp(min=1e-30), 0.0)
    return total, light, lost.detach().amax()
