"""What a pose fit is made of: what is to be found, and by which stages."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from dolens.errors import InputError
from dolens.imaging.spot_image import SpotImager

OPTIMIZERS = ("adam", "dls")
LOSSES = ("s21", "noise_weighted")


@dataclass(frozen=True)
class Stage:
    """Some iterations by one optimizer.

    Attributes:
        optimizer: `adam` or `dls`.
        iterations: how many.
        learning_rate: of Adam, in u.
        damping: of least squares' first step.
        loss: `s21`, or `noise_weighted`, which reaches the bound but wants a start near the pose.
        imager: settings of `SpotImager` that differ from the experiment's.
        slopes: those that differ from this stage's for derivatives, of `noise_weighted`.
        variables: names that move; None: all of the fit's.
        centroid_weight: μ (1/mm²) of this stage; None: the experiment's.
        blur: of both images, pixels; see `SpotLoss`.

    Both `centroid_weight` and `blur` are S21's.
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
    blur: float = 0.0

    def __post_init__(self) -> None:
        for key, allowed in (("optimizer", OPTIMIZERS), ("loss", LOSSES)):
            if getattr(self, key) not in allowed:
                raise InputError(
                    f"stages: {key} '{getattr(self, key)}' is unknown; allowed: "
                    f"{', '.join(allowed)}"
                )
        if self.loss != "s21" and (self.blur or self.centroid_weight is not None):
            raise InputError(f"stages: blur and centroid_weight are of loss s21, not {self.loss}")
        if self.iterations < 1:
            raise InputError(f"stages: {self.iterations} iterations; allowed: 1 or more")


@dataclass(frozen=True)
class Fit:
    """One pose to find.

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


def stage_of(settings: Mapping[str, Any]) -> Stage:
    """A stage as a configuration gives it.

    Raises:
        InputError: an unknown key, or a number out of range.
    """
    try:
        stage = Stage(**settings)
    except TypeError as error:
        raise InputError(f"stages: {error}") from None
    if stage.variables is None:
        return stage
    return replace(stage, variables=tuple(stage.variables))


def with_settings(imager: SpotImager, settings: Mapping[str, Any]) -> SpotImager:
    """An imager with other settings.

    Raises:
        InputError: an unknown key, or a number out of range.
    """
    try:
        return replace(imager, **settings)
    except TypeError as error:
        raise InputError(f"stages.imager: {error}") from None


def fit_of(name: str, settings: Mapping[str, Any]) -> Fit:
    """A fit as a configuration gives it.

    Raises:
        InputError: an unknown key.
    """
    unknown = set(settings) - {"variables", "truth", "held"}
    if unknown:
        raise InputError(f"fits.{name}: unknown key '{unknown.pop()}'")
    held = dict(settings.get("held") or {})
    return Fit(
        name,
        dict(settings.get("variables") or {}),
        {key: float(value) for key, value in (settings.get("truth") or {}).items()},
        tuple(held.get("variables", ())),
        held.get("from"),
    )
