"""The settings of a pose fit say what is to be found, and by which stages."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from dolens.alignment.measurement import Measurement
from dolens.errors import InputError, check_choice, check_keys
from dolens.experiments.settings import check_finite, check_not_negative
from dolens.rendering.spot_image import SpotImager
from dolens.sensor.pixels import Sensor
from dolens.typed_values import call_with_settings, check_type

OPTIMIZERS = ("adam", "dls")
LOSSES = ("s21", "noise_weighted")
AUTO = "auto"
_SPACINGS, _FINEST = 1.2, 1 << 14
# Rays of a pixel beyond which their moiré is below the shot noise of the light that cameras hold.
_RAYS_WITHOUT_MOIRE = 2000.0
# Derivatives are differences of what crosses a pixel's edges: by so much wider are their patches.
_SLOPES_WIDENED = 2.0
_RAYS_OF_A_SLOPE, _LEAST_BLUR = 450.0, 0.5


@dataclass(frozen=True)
class ImageSettings:
    """Gives settings of the images that a pose is compared by.

    Attributes:
        imager: settings of `SpotImager` besides sensor and wavelength; see `spot_imager`.
        slopes: those that differ for derivatives.
    """

    imager: Mapping[str, Any] = field(default_factory=dict)
    slopes: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Stage:
    """Describes some iterations by one optimizer.

    Attributes:
        optimizer: `adam` or `dls`.
        iterations: how many.
        learning_rate: of Adam, in u.
        damping: of least squares' first step.
        loss: `s21`, or `noise_weighted`, which reaches the bound; from afar it wants `noise_blur`.
        imager: settings of `SpotImager` that differ from the experiment's.
        slopes: those that differ from this stage's for derivatives, of `noise_weighted`.
        variables: names that move; None: all of the fit's.
        centroid_weight: μ (1/mm²) of this stage, of S21; None: the experiment's.
        blur: of what is compared, pixels; see `SpotLoss` and `NoiseWeightedLoss`; None, of the
            second: as much as the rays' number asks for.
        noise_blur: of the light that makes noise, pixels, of `noise_weighted`: some let it start
            from afar, 0 reaches the bound.
    """

    optimizer: str
    iterations: int
    learning_rate: float = 0.1
    damping: float = 1e-3
    loss: str = "s21"
    imager: Mapping[str, Any] = field(default_factory=dict)
    slopes: Mapping[str, Any] = field(default_factory=dict)
    variables: tuple[str, ...] | None = None
    centroid_weight: float | None = None
    blur: float | None = None
    noise_blur: float = 0.0

    def __post_init__(self) -> None:
        for key, allowed in (("optimizer", OPTIMIZERS), ("loss", LOSSES)):
            check_choice(getattr(self, key), allowed, f"stages: {key}")
        if self.loss != "s21" and self.centroid_weight is not None:
            raise InputError(f"stages: centroid_weight is of loss s21, not {self.loss}")
        if self.noise_blur and self.loss != "noise_weighted":
            raise InputError(f"stages: noise_blur is of loss noise_weighted, not {self.loss}")
        check_not_negative("stages: noise_blur", self.noise_blur)
        if self.iterations < 1:
            raise InputError(f"stages: {self.iterations} iterations; allowed: 1 or more")


@dataclass(frozen=True)
class Fit:
    """Describes one pose to find.

    Attributes:
        name: what it is called.
        variables: settings of `Pose`, by name.
        truth: what is simulated, by name; other numbers are those of the lens and the sources.
        held: names whose values an earlier fit found, and that fit.
    """

    name: str
    variables: Mapping[str, Mapping[str, Any] | None]
    truth: Mapping[str, float]
    held: tuple[str, ...] = ()
    held_from: str | None = None


@dataclass(frozen=True)
class FitPlan:
    """Lists the poses that are fitted, and the stages of each fit.

    Attributes:
        fits: in their order; a fit may hold what an earlier one found.
        stages: of each fit, in turn.
        imager: settings of `SpotImager` besides sensor and wavelength; see `spot_imager`.
        centroid_weight: μ of S21, 1/mm².
    """

    fits: tuple[Fit, ...]
    stages: tuple[Stage, ...]
    imager: Mapping[str, Any] = field(default_factory=dict)
    centroid_weight: float = 1.0

    def number(self, name: str) -> int:
        """Return the number of a fit by its name."""
        return [fit.name for fit in self.fits].index(name)

    def stage_at(self, iteration: int) -> int:
        """Return the number of the stage that an iteration of a fit belongs to."""
        ends = itertools.accumulate(stage.iterations for stage in self.stages)
        return next((i for i, end in enumerate(ends) if iteration < end), len(self.stages) - 1)

    def check_imagers(self, sensor: Sensor, wavelength: float) -> None:
        """Refuse a mistake in the images of the last stage before the first one begins.

        Raises:
            InputError: an unknown key, or a number out of range.
        """
        for stage in self.stages:
            plain_imager(sensor, wavelength, self.imager, stage.imager, stage.slopes)


def fit_plan(
    fits: Mapping[str, Mapping[str, Any]],
    stages: Sequence[Mapping[str, Any]],
    imager: Mapping[str, Any] | None = None,
    centroid_weight: float = 1.0,
) -> FitPlan:
    """Return a plan from its settings.

    Args:
        fits: name → `variables`, `truth`, and `held: {from, variables}`.
        stages: settings of `Stage`, in turn.
        imager: see `FitPlan`.
        centroid_weight: see `FitPlan`.

    Raises:
        InputError: an unknown key, no fit, no stage, or a fit that holds what none before it finds.
    """
    plan = FitPlan(
        tuple(fit_of(name, settings) for name, settings in fits.items()),
        tuple(stage_of(settings) for settings in stages),
        dict(imager or {}),
        float(centroid_weight),
    )
    check_not_negative("centroid_weight", centroid_weight)
    for key, given in (("fits", plan.fits), ("stages", plan.stages)):
        if not given:
            raise InputError(f"{key}: none is given; allowed: one or more")
    for number, fit in enumerate(plan.fits):
        earlier = [before.name for before in plan.fits[:number]]
        if fit.held_from is not None and fit.held_from not in earlier:
            raise InputError(
                f"fits.{fit.name}.held.from: '{fit.held_from}' is no earlier fit; allowed: "
                f"{', '.join(earlier) or 'none'}"
            )
    return plan


def stage_of(settings: Mapping[str, Any]) -> Stage:
    """Return the stage that a configuration describes.

    Raises:
        InputError: an unknown key, or a number out of range.
    """
    stage = call_with_settings(Stage, settings, "stages")
    if stage.variables is None:
        return stage
    return replace(stage, variables=tuple(stage.variables))


def plain_imager(
    sensor: Sensor, wavelength: float, *settings: Mapping[str, Any]
) -> tuple[SpotImager, bool]:
    """Return the imager before there is a measurement, and whether its patches are `auto`.

    Raises:
        InputError: an unknown key, or a number out of range.
    """
    merged = {key: value for part in settings for key, value in part.items()}
    auto = merged.get("subpixels") == AUTO
    if auto:
        merged.pop("subpixels")
    return call_with_settings(SpotImager, merged, "imager", sensor, wavelength), auto


def spot_imager(
    measurement: Measurement,
    wavelength: float,
    *settings: Mapping[str, Any],
    widened: float = 1.0,
    values_only: bool = False,
) -> SpotImager:
    """Return the imager that models a measurement's images.

    `subpixels: auto` makes a ray's patch of light 1.2 times as wide as rays are apart where the
    measured light is: narrower ones let the rays' pattern show as moiré, wider ones blur rims.
    Each image of a measurement has patches of its own, for near focus the same rays are denser.

    Args:
        measurement: its sensor, and how many pixels its light covers.
        wavelength: nm.
        settings: of `SpotImager`; later ones override earlier ones.
        widened: by how much `auto` is wider.
        values_only: no derivative is taken of these images; see `values_imager`.

    Raises:
        InputError: an unknown key, or a number out of range.
    """
    imager, auto = plain_imager(measurement.sensor, wavelength, *settings)
    if not auto:
        return imager
    density = imager.rays / imager.reach**2 / measurement.lit_pixels
    finer = (density / _RAYS_WITHOUT_MOIRE).clamp(min=1.0) if values_only else 1.0
    patches = density.sqrt() / (_SPACINGS * widened) * finer
    finest = patches.int().clamp(1, _FINEST).tolist()
    return replace(imager, subpixels=min(finest), subpixels_of=tuple(finest))


def values_imager(
    measurement: Measurement, wavelength: float, *settings: Mapping[str, Any]
) -> SpotImager:
    """Return the imager for images of which no derivative is taken.

    Its `auto` patches are narrower than rays are apart where a pixel gets more than 2000: moiré is
    below the shot noise there, while a patch that spills light beyond the edge of a caustic, if by
    a hundredth of a pixel, lights pixels whose read noise alone would show it.
    """
    return spot_imager(measurement, wavelength, *settings, values_only=True)


def slopes_imager(
    measurement: Measurement, wavelength: float, *settings: Mapping[str, Any]
) -> SpotImager:
    """Return the imager for derivatives, whose `auto` patches are twice as wide."""
    return spot_imager(measurement, wavelength, *settings, widened=_SLOPES_WIDENED)


def blur_for(measurement: Measurement, imager: SpotImager) -> float:
    """Return the pixels by which derivatives are averaged so that 450 rays make each.

    It is 0 where less than half a pixel would do: a Gaussian of the deviation b averages 4π·b²
    pixels and one more.

    With 37 rays a pixel (the fit at 30° with 800 000) derivatives by two patterns of rays agree so
    to some per cent, where without it they seem to tell three times as much as they do.
    """
    missing = max(_RAYS_OF_A_SLOPE / _rays_a_pixel(measurement, imager) - 1.0, 0.0)
    needed = math.sqrt(missing / (4.0 * math.pi))
    return needed if needed >= _LEAST_BLUR else 0.0


def _rays_a_pixel(measurement: Measurement, imager: SpotImager) -> float:
    """Return the rays that reach a pixel where the measured light is; the lens lets 1/reach² of the
    disc through that rays aim at.
    """
    return imager.rays / imager.reach**2 / float(measurement.lit_pixels.max())


def fit_of(name: str, settings: Mapping[str, Any]) -> Fit:
    """Return the fit that a configuration describes.

    Raises:
        InputError: an unknown key, or a truth that is no number.
    """
    keys = ("variables", "truth", "held")
    check_keys(settings, keys, f"fits.{name}")
    for key in keys:
        check_type(settings.get(key), Mapping[str, Any] | None, f"fits.{name}.{key}")
    for key, value in (settings.get("truth") or {}).items():
        check_finite(f"fits.{name}.truth.{key}", value)
    held = dict(settings.get("held") or {})
    check_keys(held, ("from", "variables"), f"fits.{name}.held")
    check_type(held.get("variables", ()), Sequence[str], f"fits.{name}.held.variables")
    return Fit(
        name,
        dict(settings.get("variables") or {}),
        {key: float(value) for key, value in (settings.get("truth") or {}).items()},
        tuple(held.get("variables", ())),
        held.get("from"),
    )
