"""Light of the axial point behind a round element: one radius of the field says all of it.

With s² = z² + r² + ρ² the distance from a place (r, θ) of the element to one at ρ from the axis is

    R = s - r·ρ·cosθ/s - (r·ρ)²·cos²θ/(2s³) - ...,

so that the Rayleigh-Sommerfeld integral over θ leaves Bessel functions of a = 2πn·r·ρ/(λs):

    U(ρ) = 2πn·z/(iλ)·∫ U(r)·exp(i(2πn·s/λ - ε))/s²·B r dr,
    B = (1 - ε²/4)·J0 + iε·J2 - ε²/4·J4 - 2i·r·ρ/s²·J1,    ε = πn·(r·ρ)²/(2λs³),

up to ε³/24.  It takes N numbers where a plane takes N².
"""

import math

import torch
from torch import Tensor

from dolens.diffraction.free_space import Layer
from dolens.diffraction.propagation import phasor
from dolens.diffraction.wavefront import MM_PER_NM

# The largest ε, of which a twentieth of the farthest light is wrong.
MOST_BEYOND = 1.0


def beyond(edge: float, reach: float, layer: Layer, wavelength: float) -> float:
    """Return ε of light (nm) from the element's edge to a distance `reach` from the axis, mm."""
    product = (edge * reach) ** 2 / float(layer.thickness.detach()) ** 3
    return 0.5 * math.pi * layer.index * product / (MM_PER_NM * wavelength)


def by_radius(values: Tensor, r: Tensor, layer: Layer, wavelength: float, rho: Tensor) -> Tensor:
    """Carry a round field to places at distances from the axis.

    Args:
        values: (N,), complex, of the field at the middles of rings of equal width.
        r: (N,), mm, double precision.
        layer: that light goes through.
        wavelength: nm.
        rho: (P,), mm, double precision.

    Returns:
        (P,), complex, in the field's precision.
    """
    dtype = values.real.dtype
    turn, z = layer.index / (MM_PER_NM * wavelength), layer.thickness.double()
    product = rho[:, None] * r
    square = z * z + (r * r + (rho * rho)[:, None])
    s = square.sqrt()
    epsilon = 0.5 * math.pi * turn * product.square() / (square * s)
    turns = turn * s - epsilon / (2.0 * math.pi)
    a = (2.0 * math.pi * turn * product / s).to(dtype)
    beside = (2.0 * product / square).to(dtype)
    low, epsilon = a.clamp(min=0.1), epsilon.to(dtype)
    j0, j1 = torch.special.bessel_j0(a), torch.special.bessel_j1(a)
    # Where a is small these err, and ε is nothing.
    j2 = 2.0 * j1 / low - j0
    j4 = 6.0 * (4.0 * j2 / low - j1) / low - j2
    quarter = 0.25 * epsilon.square()
    weight = (r * float(r[1] - r[0])).to(dtype) / square.to(dtype)
    around = torch.complex(j0 - quarter * (j0 + j4), epsilon * j2 - beside * j1)
    carried = (phasor(turns, dtype) * around * weight) @ values
    return (-2j * math.pi * turn) * z.to(dtype) * carried
