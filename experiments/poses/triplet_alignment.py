"""Identification of the misaligned element of a lens from its spots."""

import copy
import logging
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from dolens.alignment.element_fit import (
    POSE,
    element_names,
    fit_element,
    information_root,
    least_covariance,
    most_likely_element,
)
from dolens.alignment.moment_noise import MeasuredMoments, simulated_moments
from dolens.alignment.pixel_moments import Pixels
from dolens.alignment.spot_moments import SENSOR, MomentModel, moment_model, one_thread
from dolens.analysis.pupil_quadrature import SpotRays, gaussian_quadrature
from dolens.errors import InputError, check_choice, check_keys
from dolens.optics.lens import Lens
from dolens.optics.parameter_units import DEGREE, unit_factors, unit_of
from experiments.analysis import Analysis
from experiments.experiment import Figures
from experiments.poses.alignment_checks import one_exposure_error, sampling_error
from experiments.poses.alignment_figures import Setup, alignment_figure
from experiments.poses.alignment_result import COLUMNS, SENSOR_COLUMNS, Alignment
from experiments.settings import numbers_of
from experiments.tables import Row

logger = logging.getLogger(__name__)

# Rings and arms with many rays in every pixel.
_DENSE = 40, 120


class TripletAlignmentModule(Analysis):
    """Simulates spots of lenses with one misaligned element, and finds the element and its pose.

    Where the sensor is counts as unknown: every hypothesis has the pose of one element and, where
    a range is not zero, the sensor's place across or along the axis.

    Args:
        lens: as designed; it has two elements or more with poses.
        experiment: name of the experiment.
        fields: (x, y), degrees or mm; on all sides, for a misaligned lens has no symmetry.
        wavelengths: nm.
        folder: where tables go.
        demo: the first case: `element`, and any of `tilt_x`, `tilt_y` (degrees), `decenter_x`,
            `decenter_y` (mm); its sensor's place is random.
        misalignments: how many more to draw: elements alike, tilts and decentres uniform.
        tilt_range: half-range of the tilts about x and y, degrees.
        decenter_range: half-range of the decentres, mm.
        sensor_shift_range: half-range of the sensor's place in x and in y, mm; 0: it is known.
        focus_range: half-range of its place along the axis, mm; 0: it is known.
        photons: of each spot.
        pixel_pitch: mm; 0: every photon is located exactly, and nothing is read.
        read_noise: electrons RMS of a pixel.
        window: half of the side of the square that a spot is summed over, in its RMS radii.
        rings: radii of the pupil's quadrature that is fitted.
        arms: its azimuths.
        simulation_rings: radii of the quadrature that is measured.
        simulation_arms: its azimuths.
        iterations: of each fit, at most.
        seed: of cases and noise.

    Raises:
        InputError: a setting out of range, a lens with fewer elements, an unknown element.
    """

    digits: ClassVar[int] = 9

    def __init__(
        self,
        lens: Lens,
        experiment: str,
        fields: Sequence[Sequence[float]],
        wavelengths: Sequence[float],
        folder: str,
        demo: Mapping[str, Any],
        misalignments: int = 1000,
        tilt_range: float = 0.2,
        decenter_range: float = 0.05,
        sensor_shift_range: float = 0.02,
        focus_range: float = 0.02,
        photons: float = 1e5,
        pixel_pitch: float = 0.00345,
        read_noise: float = 2.0,
        window: float = 5.0,
        rings: int = 4,
        arms: int = 20,
        simulation_rings: int = 6,
        simulation_arms: int = 28,
        iterations: int = 20,
        seed: int = 0,
    ) -> None:
        super().__init__(lens, experiment, folder)
        self.elements = list(lens.elements)
        if len(self.elements) < 2:
            raise InputError("lens.elements: two or more are needed to tell one from another")
        if not (type(misalignments) is int and misalignments >= 1):
            raise InputError(f"misalignments: {misalignments!r}; allowed: an integer of 1 or more")
        for key, number in (("tilt_range", tilt_range), ("decenter_range", decenter_range)):
            if not 0.0 < number < math.inf:
                raise InputError(f"{key}: {number!r}; allowed: a positive number")
        for key, number in (
            ("sensor_shift_range", sensor_shift_range),
            ("focus_range", focus_range),
        ):
            if not 0.0 <= number < math.inf:
                raise InputError(f"{key}: {number!r}; allowed: a positive number, or 0 if known")
        self.seed = int(seed)
        self.fields = [numbers_of("fields", field, 2) for field in fields]
        self.wavelengths = numbers_of("wavelengths", wavelengths)
        if not self.fields or not self.wavelengths:
            raise InputError("fields, wavelengths: give at least one (x, y) and one wavelength")
        self.misalignments, self.photons = misalignments, float(photons)
        self.pixels = _pixels(pixel_pitch, read_noise, window)
        tilt, shift = math.radians(tilt_range), float(decenter_range)
        place = dict(
            zip(SENSOR, (sensor_shift_range, sensor_shift_range, focus_range), strict=True)
        )
        self.sensor = [name for name, half_range in place.items() if half_range > 0.0]
        self.half_range = torch.tensor(
            [tilt, tilt, shift, shift, *(float(place[name]) for name in self.sensor)],
            dtype=torch.float64,
        )
        self.demo = self._demo(demo)
        self.rays = {"fit": (rings, arms), "simulation": (simulation_rings, simulation_arms)}
        self.iterations = iterations
        self.alignment: Alignment | None = None

    @torch.no_grad()
    def analyse(self) -> dict[str, float]:
        """Simulate all cases, and fit them in one batch."""
        with one_thread():
            self.alignment = self._align()
        logger.info("%s", self.alignment.verdict())
        return self.alignment.summary()

    def tables(self) -> dict[str, Iterable[Row]]:
        """Return `alignment`: a row for each case, the demo first."""
        return {"alignment": self.alignment.rows()}

    def figures(self) -> Figures:
        """Return `alignment`."""
        setup = Setup(self.lens.name, len(self.fields), self.photons, self.pixels, self.sensor)
        return {"alignment": lambda: alignment_figure(self.alignment, setup)}

    def _align(self) -> Alignment:
        lens = copy.deepcopy(self.lens).double()
        names = [element_names(lens, element) for element in self.elements]
        spots = self._spots(lens, *self.rays["fit"])
        models = [moment_model(lens, spots, own, self.sensor, self.pixels) for own in names]
        every = sum(names, ())
        whole = moment_model(lens, spots, every, self.sensor, self.pixels)
        other = self._spots(lens, *self.rays["simulation"])
        simulation = moment_model(lens, other, every, self.sensor, self.pixels, whole.size)

        generator = torch.Generator().manual_seed(self.seed)
        element, true = self._cases(generator)
        errors = _of_whole_lens(element, true, len(names))
        measured = simulated_moments(simulation, errors, self.photons, generator)
        checks = sampling_error(whole, simulation, errors, measured)
        if self.pixels is not None:
            dense = self._spots(lens, *_DENSE)
            model = moment_model(lens, dense, every, self.sensor, None, whole.size)
            checks |= one_exposure_error(
                model, self.pixels, errors[:1], measured[torch.tensor([0])]
            )

        started = time.perf_counter()
        fits = [fit_element(model, measured, self.iterations) for model in models]
        named, share = most_likely_element([fit.chi_squared for fit in fits])
        seconds = time.perf_counter() - started
        rows = torch.arange(len(true))
        found = torch.stack([fit.errors for fit in fits])[named, rows]
        rested = torch.stack([fit.converged for fit in fits])[named, rows]
        root = _information_roots(models, measured, element, true)
        covariance = least_covariance(root)
        bound = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        known = least_covariance(root[:, : len(POSE), : len(POSE)])
        units = _table_units((*POSE, *self.sensor))
        return Alignment(
            elements=self.elements,
            columns=[*COLUMNS, *(SENSOR_COLUMNS[name] for name in self.sensor)],
            element=element,
            true=true * units,
            named=named,
            found=found * units,
            chi_squared=torch.stack([fit.chi_squared for fit in fits]),
            share=share,
            bound=bound * units,
            bound_ratio=bound[:, : len(POSE)] / known.diagonal(dim1=-2, dim2=-1).sqrt(),
            correlation=covariance / (bound[:, :, None] * bound[:, None, :]),
            converged=float(rested.double().mean()),
            seconds=seconds,
            checks=checks,
        )

    def _spots(self, lens: Lens, rings: int, arms: int) -> SpotRays:
        """Return the rays of the lens as designed."""
        return gaussian_quadrature(
            lens,
            self.fields,
            self.wavelengths,
            rings,
            arms,
            lens.object_distance,
            symmetry=False,
        )

    def _cases(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw the cases: elements (1 + K,), poses and places (1 + K, P) in radians and mm.

        The demo is the first.
        """
        count, poses = self.misalignments, len(POSE)
        element = torch.randint(len(self.elements), (count,), generator=generator)
        shares = torch.rand((count, poses), generator=generator, dtype=torch.float64)
        places = torch.rand((1 + count, len(self.sensor)), generator=generator, dtype=torch.float64)
        number, pose = self.demo
        drawn = torch.cat([pose[None], (2.0 * shares - 1.0) * self.half_range[:poses]])
        return (
            torch.cat([torch.tensor([number]), element]),
            torch.cat([drawn, (2.0 * places - 1.0) * self.half_range[poses:]], 1),
        )

    def _demo(self, settings: Mapping[str, Any]) -> tuple[int, Tensor]:
        check_keys(settings, ("element", *POSE), "demo")
        name = settings.get("element")
        check_choice(name, self.elements, "demo.element")
        pose = torch.tensor([float(settings.get(part, 0.0)) for part in POSE], dtype=torch.float64)
        pose *= unit_factors(POSE)
        return self.elements.index(name), pose


def _pixels(pitch: float, read_noise: float, window: float) -> Pixels | None:
    """Return the settings of the pixels; None for a pitch of zero, an ideal sensor."""
    if pitch != 0.0:
        return Pixels(pitch, read_noise, window)
    if read_noise != 0.0:
        raise InputError(f"read_noise: {read_noise!r}; allowed: 0 where pixel_pitch is 0")
    return None


def _table_units(names: Sequence[str]) -> Tensor:
    """Return what a number of the lens is multiplied by for a table in degrees and µm, (P,)."""
    factors = [1.0 / unit_of(name).factor if unit_of(name) is DEGREE else 1e3 for name in names]
    return torch.tensor(factors, dtype=torch.float64)


def _of_whole_lens(element: Tensor, true: Tensor, elements: int) -> Tensor:
    """Return the poses of all elements and the sensor's place (K, E·4 + Q).

    Args:
        element: (K,), the number of the misaligned element.
        true: (K, 4 + Q), its pose and the sensor's place.
        elements: E.
    """
    poses = true.new_zeros(len(true), elements, len(POSE))
    poses[torch.arange(len(true)), element] = true[:, : len(POSE)]
    return torch.cat([poses.flatten(1), true[:, len(POSE) :]], 1)


def _information_roots(
    models: Sequence[MomentModel], measured: MeasuredMoments, element: Tensor, true: Tensor
) -> Tensor:
    """Return roots of the information (K, P, P), each for the element that is misaligned."""
    roots = true.new_zeros(len(true), true.shape[1], true.shape[1])
    for number, model in enumerate(models):
        mine = torch.nonzero(element == number)[:, 0]
        if len(mine):
            roots[mine] = information_root(model, measured[mine], true[mine])
    return roots
