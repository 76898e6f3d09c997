"""The misaligned element of a lens is identified from its spots."""

import copy
import logging
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from dolens.alignment.element_fit import (
    POSE,
    MeasuredMoments,
    element_names,
    fit_element,
    information_root,
    least_covariance,
    most_likely_element,
    simulated_moments,
)
from dolens.alignment.moments import Pixels, grid_error
from dolens.alignment.spot_moments import SENSOR, MomentModel, moment_model, one_thread
from dolens.errors import InputError, check_choice, check_count, check_keys
from dolens.experiments.experiment import Analysis, Figures
from dolens.experiments.poses.alignment_result import (
    COLUMNS,
    SENSOR_COLUMNS,
    Alignment,
    Setup,
    alignment_figure,
)
from dolens.experiments.settings import PupilRays, Spots, check_finite, check_positive
from dolens.experiments.tables import Row
from dolens.optics.lens import Lens
from dolens.optics.parameter_names import DEGREE, unit_factors, unit_of
from dolens.plotting.layout import lens_title
from dolens.tasks import stage as named_stage


@dataclass(frozen=True)
class Detector:
    """The detector that counts the photons of the spots.

    Attributes:
        pixel_pitch: mm; 0: every photon is located exactly, and nothing is read.
        read_noise: electrons RMS of a pixel.
        window: half of the side of the square that a spot is summed over, in its RMS radii.

    Raises:
        InputError: a number out of range, or read noise without pixels.
    """

    pixel_pitch: float
    read_noise: float
    window: float

    def __post_init__(self) -> None:
        if self.pixel_pitch == 0.0 and self.read_noise != 0.0:
            raise InputError(f"read_noise: {self.read_noise!r}; allowed: 0 where pixel_pitch is 0")
        self.pixels()

    def pixels(self) -> Pixels | None:
        """Return the pixels; None for an ideal detector."""
        if self.pixel_pitch == 0.0:
            return None
        return Pixels(self.pixel_pitch, self.read_noise, self.window)


@dataclass(frozen=True)
class Misalignments:
    """The simulated lenses: one that is known, and a number of random ones.

    Attributes:
        demo: the first lens: `element`, and any of `tilt_x`, `tilt_y` (degrees), `decenter_x`,
            `decenter_y` (mm); its sensor's place is random.
        count: random lenses: elements are equally likely, tilts and decentres uniform.
        tilt_range: half-range of the tilts about x and y, degrees.
        decenter_range: half-range of the decentres, mm.
        sensor_shift_range: half-range of the sensor's place in x and in y, mm; 0: it is known.
        focus_range: half-range of the sensor's place along the axis, mm; 0: it is known.
        seed: of the lenses and of noise.

    Raises:
        InputError: a number out of range, or an unknown key of `demo`.
    """

    demo: Mapping[str, Any]
    count: int
    tilt_range: float
    decenter_range: float
    sensor_shift_range: float
    focus_range: float
    seed: int

    def __post_init__(self) -> None:
        check_count("misalignments", self.count)
        check_positive("tilt_range", self.tilt_range)
        check_positive("decenter_range", self.decenter_range)
        for key in ("sensor_shift_range", "focus_range"):
            number = getattr(self, key)
            if not 0.0 <= number < math.inf:
                raise InputError(f"{key}: {number!r}; allowed: a positive number, or 0 if known")
        check_keys(self.demo, ("element", *POSE), "demo")
        for name in POSE:
            check_finite(f"demo.{name}", self.demo.get(name, 0.0))

    def unknown_of_sensor(self) -> list[str]:
        """Return the names of the sensor's coordinates that are unknown to the fits."""
        return [name for name, half_range in self._places().items() if half_range > 0.0]

    def half_range(self) -> Tensor:
        """Return the half-ranges of tilts (radians), decentres and unknown coordinates (mm)."""
        tilt, shift = self.tilt_range, self.decenter_range
        pose = torch.tensor([tilt, tilt, shift, shift], dtype=torch.float64) * unit_factors(POSE)
        places = [float(half_range) for half_range in self._places().values() if half_range > 0.0]
        return torch.cat([pose, torch.tensor(places, dtype=torch.float64)])

    def known_case(self, elements: Sequence[str]) -> tuple[int, Tensor]:
        """Return the demo's element (its number) and pose (4,), in radians and mm.

        Raises:
            InputError: it names none of the elements.
        """
        name = self.demo.get("element")
        check_choice(name, elements, "demo.element")
        values = [float(self.demo.get(part, 0.0)) for part in POSE]
        pose = torch.tensor(values, dtype=torch.float64) * unit_factors(POSE)
        return list(elements).index(name), pose

    def _places(self) -> dict[str, float]:
        shift = self.sensor_shift_range
        return dict(zip(SENSOR, (shift, shift, self.focus_range), strict=True))


logger = logging.getLogger(__name__)

# Rings and arms with many rays in every pixel.
_DENSE = PupilRays(40, 120)


class TripletAlignmentModule(Analysis):
    """Simulates spots of lenses with one misaligned element, and finds the element and its pose.

    Where the sensor is counts as unknown: every hypothesis has the pose of one element and, where
    a range is not zero, the sensor's place across or along the axis.

    Args:
        lens: as designed; it has two elements or more with poses.
        spots: their rays are fitted.
        photons: of each spot.
        simulation_pupil: the rays that are measured instead.
        detector: counts the photons.
        misalignments: the lenses that are simulated.
        iterations: of each fit, at most.

    Raises:
        InputError: a setting out of range, a lens with fewer elements, an unknown element.
    """

    digits: ClassVar[int] = 9

    metrics = (
        "alignment/named_right",
        "alignment/converged",
        "alignment/chi_squared/mean",
        "alignment/*_over_noise*",
        "alignment/*/*",
        "pose_error/*",
        "pose_bound/*",
        "sensor_error/*",
        "sensor_bound/*",
    )

    def __init__(
        self,
        lens: Lens,
        spots: Spots,
        photons: float,
        simulation_pupil: PupilRays,
        detector: Detector,
        misalignments: Misalignments,
        iterations: int,
    ) -> None:
        super().__init__(lens)
        self.elements = list(lens.elements)
        if len(self.elements) < 2:
            raise InputError("lens.elements: two or more are needed to tell one from another")
        self.spots, self.simulation_pupil = spots, simulation_pupil
        check_positive("photons", photons)
        check_count("iterations", iterations)
        self.photons, self.pixels = float(photons), detector.pixels()
        self.misalignments = misalignments
        self.demo = misalignments.known_case(self.elements)
        self.sensor = misalignments.unknown_of_sensor()
        self.half_range = misalignments.half_range()
        self.iterations = iterations
        self.alignment: Alignment | None = None

    @torch.no_grad()
    def analyse(self) -> dict[str, float]:
        """Simulate all cases, and fit them in one batch."""
        with one_thread(), named_stage("cases and their fits"):
            self.alignment = self._align()
        logger.info("%s", self.alignment.verdict())
        return self.alignment.summary()

    def tables(self) -> dict[str, Iterable[Row]]:
        """Return `alignment`: a row for each case, the demo first."""
        return {"alignment": self.alignment.rows()}

    def figures(self) -> Figures:
        """Return `alignment`."""
        setup = Setup(
            lens_title(self.lens), len(self.spots.fields), self.photons, self.pixels, self.sensor
        )
        return {"alignment": lambda: alignment_figure(self.alignment, setup)}

    def _align(self) -> Alignment:
        lens = copy.deepcopy(self.lens).double()
        names = [element_names(lens, element) for element in self.elements]
        spots = self.spots.rays(lens)
        models = [moment_model(lens, spots, own, self.sensor, self.pixels) for own in names]
        every = sum(names, ())
        whole = moment_model(lens, spots, every, self.sensor, self.pixels)
        other = self.spots.rays(lens, self.simulation_pupil)
        simulation = moment_model(lens, other, every, self.sensor, self.pixels, whole.size)

        generator = torch.Generator().manual_seed(self.misalignments.seed)
        element, true = self._cases(generator)
        errors = _of_whole_lens(element, true, len(names))
        measured = simulated_moments(simulation, errors, self.photons, generator)
        checks = sampling_error(whole, simulation, errors, measured)
        if self.pixels is not None:
            dense = self.spots.rays(lens, _DENSE)
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

    def _cases(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw the cases: elements (1 + K,), poses and places (1 + K, P) in radians and mm.

        The demo is the first.
        """
        count, poses = self.misalignments.count, len(POSE)
        element = torch.randint(len(self.elements), (count,), generator=generator)
        shares = torch.rand((count, poses), generator=generator, dtype=torch.float64)
        places = torch.rand((1 + count, len(self.sensor)), generator=generator, dtype=torch.float64)
        number, pose = self.demo
        drawn = torch.cat([pose[None], (2.0 * shares - 1.0) * self.half_range[:poses]])
        return (
            torch.cat([torch.tensor([number]), element]),
            torch.cat([drawn, (2.0 * places - 1.0) * self.half_range[poses:]], 1),
        )


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


# Places of the pixels' grid that are tried.
_PLACES = 16


def sampling_error(
    fitted: MomentModel, simulated: MomentModel, errors: Tensor, measured: MeasuredMoments
) -> dict[str, float]:
    """Return the difference of moments by two quadratures of the same pupil, over their noise.

    Args:
        fitted: the model that is fitted.
        simulated: the one that is measured.
        errors: (K, P), of the lenses, in the lens's units.
        measured: K measurements.
    """
    difference = fitted.moments(errors, measured.origin) - simulated.moments(
        errors, measured.origin
    )
    apart = measured.over_noise(difference)
    return {
        "alignment/sampling_error_over_noise": float(apart.square().mean().sqrt()),
        "alignment/sampling_error_over_noise/largest": float(apart.abs().max()),
    }


def one_exposure_error(
    dense: MomentModel, pixels: Pixels, errors: Tensor, measured: MeasuredMoments
) -> dict[str, float]:
    """Return what one exposure instead of many dithered ones would change, over the noise.

    Places of the pixels' grid under the spots form a lattice.

    Args:
        dense: a model of many rays a pixel, without pixels.
        pixels: what counts the light.
        errors: (1, P), of one lens, in the lens's units.
        measured: its measurement.
    """
    side = (torch.arange(math.isqrt(_PLACES)) + 0.5) / math.isqrt(_PLACES)
    places = torch.cartesian_prod(side, side)
    difference = grid_error(
        dense.points(errors)[0],
        dense.shares,
        measured.origin[0],
        dense.size,
        pixels.pitch,
        places,
    )
    apart = measured.over_noise(difference[:, None])
    return {"alignment/pixel_grid_over_noise": float(apart.square().mean().sqrt())}
