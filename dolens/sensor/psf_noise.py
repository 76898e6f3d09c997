"""Point spread functions are measured with photon noise and read noise."""

import torch
from torch import Tensor


def noisy_point_spread_functions(
    functions: Tensor, electrons: float, read_noise: float, generator: torch.Generator
) -> Tensor:
    """Return point spread functions with simulated photon noise and read noise.

    A function h of sum Σh is measured with N electrons in the whole of it: pixel i counts a Poisson
    number n_i of mean N·h_i/Σh, and a normal number of the read noise is added.  The result
    is Σh·n_i/Σn, so that the measured function has the same sum.  Nothing is cut at zero.

    Args:
        functions: (..., K, K), not negative.
        electrons: N.
        read_noise: standard deviation, electrons a pixel.
        generator: on the CPU.

    Returns:
        (..., K, K), in the functions' dtype, without gradient.
    """
    exact = functions.detach().cpu().double().clamp(min=0.0)
    total = exact.sum((-2, -1), keepdim=True)
    counts = torch.poisson(electrons * exact / total, generator=generator)
    noise = torch.randn(counts.shape, dtype=counts.dtype, generator=generator)
    counts = counts + read_noise * noise
    return (total * counts / counts.sum((-2, -1), keepdim=True)).to(functions)
