"""A run's fits are to explain a photograph, or a simulated measurement each."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from dolens.alignment.measurement import Measurement, read_measurements
from dolens.alignment.pose import Pose
from dolens.alignment.unmodelled import Unmodelled
from dolens.errors import InputError
from dolens.experiments.poses.bench import Bench, Light, draw, making, simulate
from dolens.experiments.poses.settings import Fit
from dolens.optics.lens import Lens


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
