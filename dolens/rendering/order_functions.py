"""Point spread functions by rays of every order of a lens's diffractive elements."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from dolens.diffraction.element_orders import bent_to, is_phase_alone, orders_of
from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.errors import InputError
from dolens.rendering.imaging_system import ImagingSystem

# Least share of the light of an order that is traced; the rest is haze.
_TRACED = 0.02


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
        imaging: the lens, with diffractive elements, D depths and C wavelengths.
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
    for number in system.diffractive:
        if not is_phase_alone(system, number):
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
    total, haze = with_haze(total, light)
    return total, light, haze.amax()


def with_haze(functions: Tensor, light: Tensor) -> tuple[Tensor, Tensor]:
    """Return functions (..., K, K) with what their sums lack of their light (...) as haze, even
    within the window, and its share of the light (...), without gradient.
    """
    haze = (light - functions.sum((-2, -1))).clamp(min=0.0)
    share = torch.where(light > 0.0, haze / torch.where(light > 0.0, light, 1.0), 0.0)
    return functions + (haze / functions.shape[-1] ** 2)[..., None, None], share.detach()
