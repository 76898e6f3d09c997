"""A bench of sources and a sensor: its light gives measurements, simulated or photographed."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from dolens.alignment.measurement import Light, Measurement, read_measurements, simulated
from dolens.alignment.pose import Pose
from dolens.alignment.unmodelled import Unmodelled, unmodelled_of
from dolens.errors import InputError
from dolens.experiments.poses.fit_plan import Fit
from dolens.optics.dispersion import require_wavelengths
from dolens.optics.lens import Lens
from dolens.sensor.pixels import Sensor


def check_precision(lens: Lens, use: str) -> None:
    """Refuse a lens in single precision, in which poses lose what images know of them.

    Args:
        lens: the lens.
        use: what is done with its poses, a participle.

    Raises:
        InputError: the lens is not in float64.
    """
    if lens.dtype != torch.float64:
        raise InputError(f"lens_dtype: poses are {use} in float64, not {lens.dtype}")


@dataclass(frozen=True)
class Bench:
    """Places point sources in front of a lens, and the sensor behind it.

    Attributes:
        wavelength: nm.
        sensor: the pixels.
        sources: (S, 3), mm, in the lens's axes.
        planes: where the sensor stands for the images of a source, mm from `sensor_distance`.
    """

    wavelength: float
    sensor: Sensor
    sources: Sequence[Sequence[float]] = ()
    planes: Sequence[float] = (0.0,)

    def __post_init__(self) -> None:
        require_wavelengths([self.wavelength], "wavelength")

    @property
    def images(self) -> int:
        """Return how many images a measurement has: one of each source on each plane."""
        return len(self.sources) * len(self.planes)

    def pose(
        self, lens: Lens, variables: Mapping[str, Mapping[str, Any] | None] | None = None
    ) -> Pose:
        """Return the pose of a lens on this bench.

        Args:
            lens: the lens; the pose may change it.
            variables: settings of `Pose`; None: nothing varies.
        """
        return Pose(lens, self.sources, variables or {}, self.planes)


def light_of(
    photons: float = 4_000_000,
    read_noise: float = 2.0,
    full_well: float | None = None,
    unmodelled: Mapping[str, Any] | None = None,
) -> Light:
    """Return light and noise from their settings; see `Light`.

    Raises:
        InputError: an unknown key of `unmodelled`, or a number out of range.
    """
    return Light(photons, read_noise, full_well, unmodelled_of(unmodelled))


def simulate(
    pose: Pose,
    bench: Bench,
    light: Light,
    generator: torch.Generator,
    making: torch.Generator | None = None,
) -> Measurement:
    """Simulate a measurement of a pose's lens and sources as they are stored; θ has no part in it.

    Args:
        pose: where all is; its sources and planes count.
        bench: its wavelength and its sensor count.
        light: of the measurement.
        generator: of photons and noise.
        making: of the lens's errors of radius and index; needed where it has tolerances.
    """
    effects, lens = light.unmodelled, pose.lens
    if effects.of_the_lens:
        lens = effects.made(lens, making)
    return simulated(
        lens,
        pose.places,
        bench.wavelength,
        bench.sensor,
        light,
        generator,
        pose.planes,
    )


def draw(seed: int, number: int, measurement: int) -> torch.Generator:
    """Return the generator of the photons of one of a run's measurements.

    Args:
        seed: of the run.
        number: of the fit, or of whatever is measured.
        measurement: of it; the 1009th is the first of the next.
    """
    return torch.Generator().manual_seed(1000003 * (seed + 1) + 1009 * number + measurement)


def making(seed: int, measurement: int) -> torch.Generator:
    """Return the generator of the lens's errors in one of a run's measurements.

    The lens is the same in all fits of a measurement.

    Args:
        seed: of the run.
        measurement: of each fit.
    """
    return torch.Generator().manual_seed(7000003 * (seed + 1) + measurement)


def repetitions(monte_carlo: int) -> int:
    """Return the number of measurements by which estimates are compared with their bounds.

    Raises:
        InputError: one, which has no spread, or fewer than none.
    """
    if monte_carlo < 0 or monte_carlo == 1:
        raise InputError(f"monte_carlo: {monte_carlo}; allowed: 0 for none, or 2 or more")
    return int(monte_carlo)


class Observations:
    """Gives the measurements of a run's fits, and the true numbers behind them where they are
    known.

    Args:
        lens: as designed.
        bench: where the measurements are made.
        light: of simulated measurements.
        fits: all of a run's, in their order.
        photograph: settings of `read_measurement`, for a photograph in the place of simulations,
            or a list of them, one for each source on each plane; None: simulations.
        seed: of simulations.

    Attributes:
        bench: the same, with the photograph's own sensor if there is one.
        photograph: the measurement that was read; None: the fits' are simulated.

    Raises:
        InputError: a photograph with simulated effects, or one that cannot be read.
    """

    def __init__(
        self,
        lens: Lens,
        bench: Bench,
        light: Light,
        fits: Sequence[Fit],
        photograph: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None,
        seed: int,
    ) -> None:
        self._lens = lens
        self.bench, self.light, self.fits, self.seed = bench, light, fits, seed
        self.photograph: Measurement | None = None
        if photograph is not None:
            if light.unmodelled != Unmodelled():
                raise InputError("unmodelled: a photograph has effects of its own; leave them out")
            self.photograph = read_measurements(photograph, bench.images)
            self.bench = replace(bench, sensor=self.photograph.sensor)
        self._first: dict[int, Measurement] = {}

    def truth(self, number: int) -> dict[str, float]:
        """Return what a fit's simulation has other than the lens, by name, in degrees and mm.

        Numbers that the fit holds are among them; a photograph has none.
        """
        if self.photograph is not None:
            return {}
        fit = self.fits[number]
        found: dict[str, float] = {}
        if fit.held_from is not None:
            names = [other.name for other in self.fits]
            before = self.truth(names.index(fit.held_from))
            found = {name: before[name] for name in fit.held if name in before}
        return {**found, **fit.truth}

    def true_pose(self, number: int) -> Pose:
        """Return the lens and sources that are simulated; they are as given but for the truth."""
        true = self.bench.pose(copy.deepcopy(self._lens))
        true.put(self.truth(number))
        return true

    def measured(self, number: int) -> Measurement:
        """Return what a fit is to explain; it is simulated once."""
        if self.photograph is not None:
            return self.photograph
        if number not in self._first:
            self._first[number] = self.simulated(number, 0, self.light)
        return self._first[number]

    def simulated(self, number: int, measurement: int, light: Light) -> Measurement:
        """Return one of a fit's simulated measurements; they differ in their photons.

        Args:
            number: of the fit.
            measurement: from 0, which is the one that is fitted.
            light: of it.
        """
        return simulate(
            self.true_pose(number),
            self.bench,
            light,
            draw(self.seed, number, measurement),
            making(self.seed, measurement),
        )
