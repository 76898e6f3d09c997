"""Measurements that pose experiments simulate: of which pose, and by which draw of photons."""

import torch

from dolens.alignment.measurement import Measurement, simulated
from dolens.alignment.pose import Pose
from dolens.alignment.unmodelled import Unmodelled
from dolens.errors import InputError
from dolens.sensor.pixels import Sensor


def simulated_at(
    pose: Pose,
    wavelength: float,
    sensor: Sensor,
    photons: int,
    read_noise: float,
    generator: torch.Generator,
    full_well: float | None = None,
    unmodelled: Unmodelled | None = None,
    making: torch.Generator | None = None,
) -> Measurement:
    """What `simulated` makes of a pose's lens, sources and planes as they are stored; θ has no part
    in it.

    Args:
        pose: where all is.
        wavelength: nm.
        sensor: the pixels.
        photons: of each image.
        read_noise: RMS, electrons.
        generator: of photons and noise.
        full_well: electrons.
        unmodelled: effects besides; None: none.
        making: of the lens's errors of radius and index; needed where it has tolerances.
    """
    lens = pose.lens
    if unmodelled is not None and unmodelled.of_the_lens:
        lens = unmodelled.made(lens, making)
    return simulated(
        lens,
        pose.places,
        wavelength,
        sensor,
        photons,
        read_noise,
        generator,
        full_well,
        pose.planes,
        unmodelled,
    )


def draw(seed: int, number: int, measurement: int) -> torch.Generator:
    """Photons of one of a run's measurements.

    Args:
        seed: of the run.
        number: of the fit, or of whatever is measured.
        measurement: of it; the 1009th is the first of the next.
    """
    return torch.Generator().manual_seed(1000003 * (seed + 1) + 1009 * number + measurement)


def making(seed: int, measurement: int) -> torch.Generator:
    """Errors of the lens in one of a run's measurements: the same lens in all of its fits.

    Args:
        seed: of the run.
        measurement: of each fit.
    """
    return torch.Generator().manual_seed(7000003 * (seed + 1) + measurement)


def repetitions(monte_carlo: int) -> int:
    """Measurements by which estimates are compared with their bounds.

    Raises:
        InputError: one, which has no spread, or fewer than none.
    """
    if monte_carlo < 0 or monte_carlo == 1:
        raise InputError(f"monte_carlo: {monte_carlo}; allowed: 0 for none, or 2 or more")
    return int(monte_carlo)
