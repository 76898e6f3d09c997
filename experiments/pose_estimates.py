"""Poses that other measurements lead to, without fitting each from its beginning."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.alignment.information import Knowledge
from dolens.alignment.measurement import Measurement
from dolens.alignment.pose import Pose
from dolens.errors import InputError
from dolens.imaging.spot_image import SpotImager

# One linear step is exact enough within so many bounds; longer ones are followed by others.
_NEAR = 5.0
# Steps that are tried then, at most, and which of them is the last: a part of a bound.
_IMAGES, _SMALL = 16, 0.1


@dataclass(frozen=True)
class Held:
    """Numbers that a fit holds as an earlier one found them, in θ's units (radians, mm).

    Attributes:
        names: H of them.
        units: (H,), θ's units in those of settings.
        at: (H,), in the pose that knowledge is of.
        found: (M, H), as the earlier fit found them in each of M measurements.
        true: (H,); NaN where no truth is known.
    """

    names: tuple[str, ...]
    units: Tensor
    at: Tensor
    found: Tensor
    true: Tensor

    def values(self, measurement: int) -> dict[str, float]:
        """Of one measurement, degrees and mm."""
        found = (self.found[measurement] / self.units).tolist()
        return dict(zip(self.names, found, strict=True))


@dataclass(frozen=True)
class Estimates:
    """Poses that M measurements lead to.

    Attributes:
        values: (M, P), degrees and mm.
        chi_squared: (M,), eᵀ·C⁻¹·e of the errors that these images make by themselves, C their own
            covariance: of the χ² distribution with P degrees of freedom where the model holds, and
            independent of what is held; NaN where no truth is known.
        settled: (M,), bool: the first step went a few bounds at most, or the last was a small part
            of one.  The others are no estimates: steps ended before they were small.
    """

    values: Tensor
    chi_squared: Tensor
    settled: Tensor


@torch.no_grad()
def estimates(
    pose: Pose,
    known: Knowledge,
    imager: SpotImager,
    measured: Callable[[int], Measurement],
    draws: Sequence[int],
    truth: Mapping[str, float],
    held: Held | None = None,
) -> Estimates:
    """Find the pose of each of M measurements, from one pose that is near all of them.

    Args:
        pose: of which there is knowledge.
        known: of the pose.
        imager: makes its images.
        measured: a measurement by its number.
        draws: M numbers.
        truth: by name, degrees and mm.
        held: what the fit takes from an earlier one; None: nothing.
    """
    true = torch.tensor([truth.get(name, torch.nan) for name in pose.names], dtype=torch.float64)
    values, chi, settled = [], [], []
    for place, draw in enumerate(draws):
        theta, done = _estimate(pose, known, imager, measured(draw), held, place)
        error = theta - true * pose.units
        if held is not None:
            error = error - known.inheritance @ (held.found[place] - held.true)
        chi.append(error @ torch.linalg.solve(known.own_covariance, error))
        values.append(theta / pose.units)
        settled.append(done)
    return Estimates(torch.stack(values), torch.stack(chi), torch.tensor(settled))


def _estimate(
    pose: Pose,
    known: Knowledge,
    imager: SpotImager,
    measurement: Measurement,
    held: Held | None,
    place: int,
) -> tuple[Tensor, bool]:
    """θ (P,) by Gauss-Newton steps with the derivatives of the pose, and whether it has settled.

    A step is A⁺ of what the images lack, in units of their noise, with A as it is at the pose.  The
    first is all that an error of some bounds needs.  Where it is longer images are made anew after
    each, a step that makes them worse is halved, and the last is small.
    """
    at = pose.scale * pose.scaled.detach()
    moved = torch.zeros_like(at)
    if held is not None:
        moved = known.inheritance @ (held.found[place] - held.at)
    step = known.correction(measurement)
    if float(((moved + step).abs() / known.bounds).max()) <= _NEAR:
        return at + moved + step, True
    there = copy.deepcopy(pose)
    if held is not None:
        there.put(held.values(place))

    def lacking(theta: Tensor) -> Tensor | None:
        try:
            found = there.images(imager, theta / pose.scale)
        except InputError:
            # No light reaches the sensor from there.
            return None
        return known.lacking(measurement, torch.stack([one.image for one in found]))

    left = lacking(at + moved)
    if left is None:
        return at + moved, False
    step, share = known.correction_of(left), 1.0
    for _ in range(_IMAGES):
        if float((step.abs() / known.bounds).max()) < _SMALL:
            return at + moved + step, True
        tried = lacking(at + moved + share * step)
        if tried is not None and float(tried @ tried) < float(left @ left):
            moved, left = moved + share * step, tried
            step, share = known.correction_of(left), 1.0
        else:
            share = 0.5 * share
    return at + moved, False


def probability(chi_squared: Tensor, freedom: int) -> Tensor:
    """The chance that a χ² variable of so many degrees of freedom is larger still."""
    half = torch.full_like(chi_squared, 0.5 * freedom)
    return torch.special.gammaincc(half, 0.5 * chi_squared)
