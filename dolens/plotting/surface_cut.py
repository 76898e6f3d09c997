"""The meridional plane cuts a surface in a curve, whose points are found by Newton's iteration."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.system import OpticalSystem

Profile = tuple[np.ndarray, np.ndarray]

SAMPLES = 201
# Places along a cut, where outlines may be of several parts.
_GRID = 2001
BISECTIONS = 60
_NEWTON_STEPS = 20


class SurfaceCut:
    """The plane x = 0 of the lens cuts a surface in a curve, along which a place is a number (mm).

    Raises:
        InputError: the surface faces along x.
    """

    def __init__(self, system: OpticalSystem, number: int) -> None:
        self.system, self.number = system, number
        self.rotation, self.origin = place_of(system, number)
        # In the surface's axes the plane is a·p + o = 0, with a the lens's x seen from the surface.
        ax, ay, self.az = self.rotation[0]
        self.offset = self.origin[0]
        self.across = torch.hypot(ax, ay)
        if float(self.across) < 1e-9:
            raise InputError(
                f"layout: surface {number} faces along x and has no meridional section"
            )
        self.ux, self.uy = ax / self.across, ay / self.across
        # Along the cut, y of the lens grows.
        rotation = self.rotation
        grows = float(rotation[1, 1] * self.ux - rotation[1, 0] * self.uy) >= 0.0
        sign = 1.0 if grows else -1.0
        self.vx, self.vy = -sign * self.uy, sign * self.ux

    def along(self, x: float, y: float) -> float:
        """Return the place nearest to a point of the surface's axes."""
        return float(self.vx) * x + float(self.vy) * y

    def points(self, q: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return x, y, sag in the surface's axes at places q, and where the sag exists."""
        across, offset, az = self.across, self.offset, self.az
        w = (-offset / across).expand_as(q)
        for _ in range(_NEWTON_STEPS if float(az.abs()) > 0.0 else 1):
            x, y = self.vx * q + self.ux * w, self.vy * q + self.uy * w
            sag, sx, sy, _ = sag_of(self.system, self.number, x, y)
            slope = across + az * (sx * self.ux + sy * self.uy)
            w = w - (across * w + offset + az * sag) / torch.where(slope == 0.0, across, slope)
        x, y = self.vx * q + self.ux * w, self.vy * q + self.uy * w
        sag, _, _, exists = sag_of(self.system, self.number, x, y)
        return x, y, sag, exists

    def profile(self, low: float, high: float) -> Profile:
        """Return z and y, mm, of the lens between two places."""
        share = torch.linspace(0.0, 1.0, SAMPLES, dtype=torch.float64)
        x, y, sag, exists = self.points(low * (1.0 - share) + high * share)
        points = torch.stack([x, y, sag]).T[exists] @ self.rotation.T + self.origin
        return points[:, 2].numpy(), points[:, 1].numpy()


def runs(inside: Callable[[Tensor], Tensor], reach: float) -> list[tuple[float, float]]:
    """Return from where to where along a cut points are inside; gaps below a grid's are not seen.

    Args:
        inside: of places along the cut.
        reach: how far from the middle to look.
    """
    grid = torch.linspace(-1.01 * reach, 1.01 * reach, _GRID, dtype=torch.float64)
    state = inside(grid)
    change = torch.nonzero(state[1:] != state[:-1])[:, 0]
    low, high, first = grid[change], grid[change + 1], state[change]
    for _ in range(BISECTIONS):
        half = 0.5 * (low + high)
        same = inside(half) == first
        low, high = torch.where(same, half, low), torch.where(same, high, half)
    rims = torch.where(first, low, high).tolist()
    return list(zip(rims[::2], rims[1::2], strict=False))


def sag_of(
    system: OpticalSystem, number: int, x: Tensor, y: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return sag (mm) and slopes in double precision, and where they exist."""
    surface = system.surfaces[number - 1]
    parameters = {name: p.detach().double().cpu() for name, p in surface.parameters.items()}
    sag, sx, sy, exists = surface.shape.sag_and_gradient(parameters, x, y)
    exists = torch.ones_like(sag, dtype=torch.bool) if exists is None else exists >= 0.0
    return sag, sx, sy, exists


def place_of(system: OpticalSystem, number: int) -> tuple[Tensor, Tensor]:
    """Return rotation (3, 3) and origin (3,), mm, of a surface's axes."""
    axes = system.axes[number - 1]
    if axes.rotation is None:
        z = float(axes.z)
        return torch.eye(3, dtype=torch.float64), torch.tensor([0.0, 0.0, z], dtype=torch.float64)
    assert axes.origin is not None  # as there is a rotation
    return axes.rotation.detach().double().cpu(), axes.origin.detach().double().cpu()
