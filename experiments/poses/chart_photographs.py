"""A camera's own prescription, from photographs of a chart."""

import logging
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import torch

from dolens.alignment.chart import Chart, MarkWindows
from dolens.alignment.chart_fit import ChartFit, Prior, fit_chart
from dolens.alignment.chart_model import ChartModel, ChartRays
from dolens.alignment.chart_photons import ChartLight
from dolens.alignment.spot_moments import one_thread
from dolens.analysis.fields_and_wavelengths import spectral_shares
from dolens.errors import InputError, check_count
from dolens.experiments.experiment import Analysis, Figures
from dolens.experiments.poses.bench import check_precision
from dolens.experiments.poses.chart_restoration import Judged, judged
from dolens.experiments.poses.chart_result import (
    FittedSpecimen,
    combination_rows,
    coverage_figure,
    coverage_metrics,
    fit_metrics,
    gain_metrics,
    gain_rows,
    intervals_figure,
    marks_figure,
    prescription_rows,
    restoration_figure,
    specimen_rows,
)
from dolens.experiments.poses.chart_simulation import (
    CameraPriors,
    ChartEffects,
    Restoration,
    Specimen,
    Windows,
    drawn,
    photograph_settings,
    read_windows,
    simulated,
    spread_evenly,
    with_numbers,
)
from dolens.experiments.settings import PupilRays, numbers_of
from dolens.experiments.tables import Row
from dolens.optics.lens import Lens
from dolens.optics.system import require_plane_sensor
from dolens.plotting.layout import lens_title
from dolens.tasks import stage as named_stage
from dolens.tolerancing import tolerances_from

logger = logging.getLogger(__name__)

# Rays of the first passes, which need not be right to the noise.
_COARSE = PupilRays(4, 12)


class ChartPhotographsModule(Analysis):
    """Fits the parameters of a camera to photographs of a chart: its own, or of cameras drawn.

    Args:
        lens: as designed; the fitted numbers are put into it.
        chart: the marks.
        planes: where the sensor stands for each photograph, mm from `sensor_distance`.
        wavelengths: nm, of the chart's light.
        tolerances: of the lens, see `tolerances_from`: its priors.
        camera: priors of all else.
        pupil: rays of each point of a mark.
        order: of the derivatives of Gaussians that marks are summed with.
        windows: about the marks.
        photographs: settings of `read_measurement`, one of each plane; None: they are simulated.
        light: of simulated photographs.
        unmodelled: what these have and the model has not.
        cameras: drawn; each is fitted to photographs of its own.
        subsets: numbers of photographs that the first camera is fitted to besides.
        restoration: of scenes by the fitted lenses.
        seed: of the cameras.

    Raises:
        InputError: a setting out of range.
    """

    digits: ClassVar[int] = 9

    metrics = (
        "fit/cameras",
        "fit/chi_squared_per_freedom",
        "fit/converged",
        "coverage/*",
        "error_over_prior/*",
        "gain/*",
    )

    def __init__(
        self,
        lens: Lens,
        chart: Chart,
        planes: Sequence[float],
        wavelengths: Sequence[float],
        tolerances: Mapping[str, Any],
        camera: CameraPriors,
        pupil: PupilRays,
        order: int,
        windows: Windows,
        photographs: Sequence[Mapping[str, Any]] | None,
        light: Mapping[str, float],
        unmodelled: ChartEffects,
        cameras: int,
        subsets: Sequence[int],
        restoration: Restoration,
        seed: int,
    ) -> None:
        super().__init__(lens)
        check_precision(lens, "fitted")
        require_plane_sensor(lens.system(), "photographs of a chart")
        check_count("order", order, 2)
        check_count("cameras", cameras)
        places = tuple(numbers_of("planes", planes))
        if not places:
            raise InputError("planes: none is given; allowed: one or more places of the sensor, mm")
        waves = tuple(numbers_of("wavelengths", wavelengths))
        self.tolerances = tolerances_from(lens, tolerances)
        self.photographs = photograph_settings(photographs, places)
        self.windows, self.unmodelled, self.restoration = windows, unmodelled, restoration
        if self.photographs is not None and unmodelled != ChartEffects():
            raise InputError("unmodelled: photographs have effects of their own; leave them out")
        pitch = windows.pixel_pitch
        rays = ChartRays(lens, chart, waves, pupil.rings, pupil.arms)
        self.model = ChartModel(rays, self.tolerances.names, places, pitch, order)
        self.prior = camera.prior(self.model, self.tolerances)
        self.light = ChartLight(wavelengths=waves, **light)
        self.cameras, self.seed = cameras, int(seed)
        for count in subsets:
            if not 1 <= count <= len(places):
                raise InputError(f"subsets: {count}; allowed: from 1 to {len(places)} photographs")
        self.subsets = tuple(sorted({*subsets} - {len(places)}))
        self.found: list[FittedSpecimen] = []
        self.fewer: list[tuple[int, ChartFit]] = []
        self.first: MarkWindows | None = None

    # ---------------------------------------------------------------- the work

    @torch.no_grad()
    def analyse(self) -> dict[str, float]:
        """Fit the photographs, or draw cameras and fit theirs."""
        if self.photographs is not None:
            with named_stage("photographs and their fit"):
                seen = read_windows(
                    self.photographs, self.model, self.prior, self.windows.search_radius
                )
                self._fitted(1, seen, None)
        else:
            for number in range(1, self.cameras + 1):
                with named_stage(f"camera {number} of {self.cameras}"):
                    self._simulated(number)
                self.write_tables()
        self.lens.load_state_dict(
            with_numbers(self.lens, self.model.of_lens, self.found[0].fit.numbers).state_dict()
        )
        numbers = self._numbers_found()
        logger.info("%s", self._verdict(numbers))
        return numbers

    def _simulated(self, number: int) -> None:
        specimen = drawn(
            self.lens,
            self.model,
            self.prior,
            self.tolerances,
            self.unmodelled,
            self.seed,
            number,
        )
        seen = simulated(self.model, self.prior, specimen, self.light, self.windows.search_radius)
        self._fitted(number, seen, specimen)

    def _fitted(self, number: int, seen: MarkWindows, specimen: Specimen | None) -> None:
        """Fit the photographs of one camera, and judge the fit."""
        started = time.perf_counter()
        with one_thread():
            fit = self._fit(self.model, seen, self.prior)
        seconds = time.perf_counter() - started
        if number == 1:
            self.first = seen
            self.fewer = [(count, self._fit(*self._part(seen, count))) for count in self.subsets]
        truth = torch.full_like(fit.numbers, torch.nan) if specimen is None else specimen.truth
        pictures: Judged | None = None
        if specimen is not None and number <= self.restoration.specimens:
            numbers = {"design": self.prior.mean, "fitted": fit.numbers}
            pictures = judged(
                self.model,
                self.restoration,
                numbers,
                specimen.camera,
                self._light_of_scenes(),
                specimen.generator,
            )
        self.found.append(FittedSpecimen(number, truth, fit, seconds, pictures))
        logger.info(
            "camera %d: χ² %.5g of %.5g, %.2g s",
            number,
            fit.chi_squared,
            fit.degrees_of_freedom,
            seconds,
        )

    def _light_of_scenes(self) -> Sequence[float]:
        """Return the lens's wavelengths that count (nm), or else those of the chart."""
        own = self.lens.wavelengths
        if not own:
            return self.model.rays.wavelengths
        shares = spectral_shares(self.lens, own).tolist()
        return [nm for nm, share in zip(own, shares, strict=True) if share > 0.0]

    def _fit(self, model: ChartModel, seen: MarkWindows, prior: Prior) -> ChartFit:
        rays = model.rays
        coarse = replace(model, rays=replace(rays, rings=_COARSE.rings, arms=_COARSE.arms))
        return fit_chart([coarse, coarse, model], seen, prior)

    def _part(self, seen: MarkWindows, count: int) -> tuple[ChartModel, MarkWindows, Prior]:
        """Return the model, the photographs and the prior of some of them, evenly chosen."""
        chosen = spread_evenly(count, len(self.model.planes))
        model = replace(self.model, planes=tuple(self.model.planes[place] for place in chosen))
        # Errors of planes have one prior; names count the photographs that are left.
        size = len(model.names)
        prior = Prior(model.names, self.prior.mean[:size], self.prior.deviation[:size])
        return model, seen.chosen(chosen), prior

    # ---------------------------------------------------------------- what was found

    @property
    def _known(self) -> bool:
        return self.photographs is None

    def _numbers_found(self) -> dict[str, float]:
        numbers = fit_metrics(self.found)
        if self._known:
            numbers |= coverage_metrics(self.found, len(self.model.of_lens))
            numbers |= gain_metrics(self.found)
        for count, fit in self._by_number():
            share = fit.standard_errors / fit.prior.deviation
            for name, value in zip(fit.prior.names, share.tolist(), strict=True):
                numbers[f"error_over_prior/{name}/{count}_photographs"] = value
        return numbers

    def _by_number(self) -> list[tuple[int, ChartFit]]:
        """Return the first camera's fits by their numbers of photographs."""
        return [*self.fewer, (len(self.model.planes), self.found[0].fit)]

    def _verdict(self, numbers: Mapping[str, float]) -> str:
        text = (
            f"χ² {numbers['fit/chi_squared_per_freedom']:.3f} of a degree of freedom; "
            f"{100.0 * numbers['fit/converged']:.0f} % of the fits came to rest"
        )
        if self._known:
            text += (
                f"; of the errors of {len(self.found)} cameras "
                f"{100.0 * numbers['coverage/all/within_1']:.1f} % lie within a standard error and "
                f"{100.0 * numbers['coverage/all/within_2']:.1f} % within two"
            )
        if "gain/share" in numbers:
            text += (
                f"; restored images gain {numbers['gain/fitted_db']:.2f} dB over the design's, "
                f"{100.0 * numbers['gain/share']:.0f} % of what the true functions give"
            )
        return text

    def tables(self) -> dict[str, Iterable[Row]]:
        """Return `prescription` and `combinations` of the first camera, and `cameras` and
        `restored` of all that were drawn.
        """
        first = self.found[0]
        return {
            "prescription": prescription_rows(self.prior.mean, first),
            "combinations": combination_rows(first.fit),
            "cameras": specimen_rows(self.found) if self._known else [],
            "restored": gain_rows(self.found) if self._known else [],
        }

    def figures(self) -> Figures:
        """Return `marks`, `intervals`, and `coverage` and `restoration` of cameras drawn."""
        first, lens = self.found[0], lens_title(self.lens)
        marks, planes = self.model.rays.chart.count, len(self.model.planes)
        seen = f"{lens}\n{planes} photographs of {marks} marks"
        figures = {
            "marks": lambda: marks_figure(self.model, self.first, first.fit, self.prior.mean, seen),
            "intervals": lambda: intervals_figure(self._by_number(), f"{lens}\n{marks} marks"),
        }
        if self._known and len(self.found) > 1:
            title = f"{lens}\n{len(self.found)} cameras, {planes} photographs of {marks} marks each"
            figures["coverage"] = lambda: coverage_figure(self.found, title)
        if any(one.judged for one in self.found):
            figures["restoration"] = lambda: restoration_figure(self.found, lens)
        return figures
