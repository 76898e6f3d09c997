"""Errors of traces and gradients against the float64 reference, from the same rays."""

from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.cases import Case, load, part_of
from dolens import Rays

# Rays are random, so that the first of them stand for all.
COMPARED = 20_000


def compared_rays(case: Case) -> Rays:
    """The first rays of a case."""
    return part_of(case.rays, 0, COMPARED)


def reference_case(case: Case) -> Case:
    """The float64 reference on the CPU, with the first rays as they are in the case's precision."""
    rays = compared_rays(case)
    cpu = torch.device("cpu")
    options = {"dtype": torch.float64, "device": cpu}
    rays = Rays(rays.position.to(**options), rays.direction.to(**options), rays.wavelength)
    return Case(case.name, load(case.name, torch.float64, "reference", cpu), rays)


@torch.no_grad()
def sensor_error(case: Case, reference: Case) -> tuple[float, float, int]:
    """Return the largest distance of sensor points, mm, of rays valid in both.

    Returns:
        The error, the share of valid rays, and the number of rays valid in one only.
    """
    hit = case.lens.trace(compared_rays(case))
    expected = reference.lens.trace(reference.rays)
    valid = hit.valid.cpu()
    both = valid & expected.valid
    error = (hit.position.cpu().double() - expected.position).norm(dim=-1)[both]
    differ = int((valid != expected.valid).sum())
    return float(error.max()), float(valid.double().mean()), differ


Gradient = Callable[[Case, Rays], dict[str, Tensor]]


def gradient_error(case: Case, reference: Case, gradient: Gradient) -> tuple[float, str]:
    """Largest relative error of a parameter's gradient (arrays by their norm), and whose it is."""
    found = gradient(case, compared_rays(case))
    expected = gradient(reference, reference.rays)
    worst, where = 0.0, ""
    for name, value in expected.items():
        scale = float(value.norm())
        error = float((found[name].cpu().double() - value).norm())
        if scale > 0.0 and error / scale > worst:
            worst, where = error / scale, name
        elif scale == 0.0 and error > 0.0:
            return float("inf"), name
    return worst, where
