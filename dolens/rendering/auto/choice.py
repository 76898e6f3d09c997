"""The choice among renderers: what is chosen for a lens, and what is known of it."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch

from dolens.errors import InputError
from dolens.rendering.auto.field_grid import Decision
from dolens.rendering.auto.trial import Trial
from dolens.rendering.gradient_check import Agreement, from_plain, plain
from dolens.rendering.protocol import Renderer
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.sensor.pixels import Sensor
from dolens.tasks import stage

MODELS: Mapping[str, type[Renderer]] = {r.model: r for r in (PsfRenderer, RayRenderer)}

_DTYPES = {32: torch.float32, 64: torch.float64}
# Times the cost of functions that rays may take where only the gradients of functions are off.
_WORTH = 4.0
# Plans that are tried until one keeps to the tolerances.
_ROUNDS = 4

Found = TypeVar("Found")


@dataclass(frozen=True)
class Tolerances:
    """The errors that a renderer may have.

    Attributes:
        error: RMS on the probe images, grey levels.
        cosine: the least cosine of the angle between its gradient and that of rays.
        norm: by how much the ratio of their norms may differ from 1.
    """

    error: float
    cosine: float
    norm: float

    def excess(self, agreement: Agreement | None) -> float:
        """Return the gradients' error over its tolerance; 0 where gradients do not matter."""
        return agreement.excess(self.cosine, self.norm) if agreement else 0.0

    def serves_still(self, before: Agreement | None, now: Agreement | None) -> bool:
        """Return whether gradients are within their tolerance, or hardly worse than they were."""
        return self.excess(now) <= max(1.0, 1.5 * self.excess(before))

    def misses(self, choice: "Choice") -> list[str]:
        """Name the tolerances that a choice misses, a line each."""
        found = []
        if choice.error > self.error:
            found.append(
                f"the tolerance of {self.error:g} grey levels is not met: {choice.error:.2g} is "
                "the best found"
            )
        if self.excess(choice.agreement) > 1.0:
            found.append(
                f"the tolerance of gradients (cosine {self.cosine:g}, norm within {self.norm:g}) "
                f"is not met: {choice.agreement}"
            )
        return found


@dataclass(frozen=True)
class Choice:
    """A renderer, its precision, and how it was found.

    Attributes:
        renderer: the one that renders; its sensor is the whole one.
        dtype: of rays and image.
        decisions: the decisions, with what each costs in grey levels.
        errors: RMS on the worst probe image against rays, both without diffraction, grey levels, by
            the windows' names, or of the whole sensor by ""; 0 is below what the reference can
            tell.
        uncertainty: of these errors, grey levels.
        tolerance: grey levels that were asked for.
        seconds: that choosing took.
        agreement: of the gradients with those of rays; None where they were not asked for.
    """

    renderer: Renderer
    dtype: torch.dtype
    decisions: tuple[Decision, ...]
    errors: Mapping[str, float]
    uncertainty: float
    tolerance: float
    seconds: float = 0.0
    agreement: Agreement | None = None

    @property
    def error(self) -> float:
        """The largest error, grey levels."""
        return max(self.errors.values())

    def lines(self) -> list[str]:
        """The plan, for people: a line a decision."""
        by_window = ", ".join(f"{n} {error:.2g}" for n, error in self.errors.items() if n)
        return [
            f"renderer auto: {self.renderer.model}, error {self.error:.2g} of {self.tolerance:g} "
            f"grey levels (±{self.uncertainty:.2g}) on the probe images, planned in "
            f"{self.seconds:.1f} s",
            *([f"  errors in grey levels: {by_window}"] if by_window else []),
            *(f"  {decision}" for decision in self.decisions),
            *([f"  {self.agreement}"] if self.agreement else []),
        ]

    def numbers(self) -> dict[str, float]:
        """The plan as metrics."""
        settings = self.renderer.settings()
        numbers = {f"auto/error_grey_levels/{n}": error for n, error in self.errors.items() if n}
        numbers |= {
            "auto/error_grey_levels": self.error,
            "auto/uncertainty_grey_levels": self.uncertainty,
            "auto/tolerance_grey_levels": self.tolerance,
            "auto/plan_s": self.seconds,
            "auto/pupil_samples": float(settings["pupil_samples"]),
            "auto/precision_bits": float(torch.finfo(self.dtype).bits),
            "auto/by_rays": float(self.renderer.model == RayRenderer.model),
        }
        if self.renderer.psf_size is not None:
            numbers["auto/fields"] = float(math.prod(settings["fields"]))
            numbers["auto/psf_pixels"] = float(self.renderer.psf_size)
            numbers["auto/diffraction"] = float(settings["diffraction"] != "none")
        return numbers | (self.agreement.numbers() if self.agreement else {})

    def state(self) -> dict[str, Any]:
        """The choice, as plain values; `from_state` is the inverse."""
        return {
            "model": self.renderer.model,
            "settings": self.renderer.settings(),
            "bits": torch.finfo(self.dtype).bits,
            "errors": dict(self.errors),
            "uncertainty": self.uncertainty,
            "agreement": plain(self.agreement),
        }

    @classmethod
    def from_state(
        cls, state: Mapping[str, Any], sensor: Sensor, dtype: torch.dtype, tolerance: float
    ) -> "Choice":
        """The choice of a checkpoint.

        Args:
            state: of `state`; older ones have one `error`, or windows' without model and precision.
            sensor: the pixels.
            dtype: of the lens.
            tolerance: grey levels that are asked for.

        Raises:
            InputError: a plan of a model that is unknown, or with settings that there are not.
        """
        model, bits = state.get("model", PsfRenderer.model), torch.finfo(dtype).bits
        try:
            make: Any = MODELS[model]
            renderer = make(sensor=sensor, **state["settings"])
            chosen = _DTYPES[state.get("bits", bits)]
        except (KeyError, TypeError) as error:
            raise InputError(
                f"renderer auto: the checkpoint's plan, of model '{model}', cannot be read "
                f"({error}); allowed: {', '.join(MODELS)}, with the settings of these renderers"
            ) from None
        errors = state["errors"] if "errors" in state else {"": state["error"]}
        agreement = from_plain(state.get("agreement"))
        return cls(
            renderer, chosen, (), errors, state["uncertainty"], tolerance, agreement=agreement
        )


def measured(
    renderer: Renderer,
    dtype: torch.dtype,
    decisions: Sequence[Decision],
    trial: Trial,
) -> Choice:
    """A renderer with its errors and the agreement of its gradients in a trial."""
    with stage("errors on probe images"):
        errors, uncertainty = trial.errors(renderer, dtype), trial.uncertainty
    with stage("gradients beside those of rays"):
        agreement = trial.agreement(renderer, dtype)
    return Choice(
        renderer,
        dtype,
        tuple(decisions),
        errors,
        uncertainty,
        trial.requirements.tolerance,
        agreement=agreement,
    )


def choose(trial: Trial, tolerances: Tolerances) -> Choice:
    """Choose the cheapest renderer that keeps to the tolerances.

    Functions are planned, and measured; for a whole sensor rays are taken instead where they err
    less or cost less.
    """

    def attempt(tolerance: float) -> tuple[float, tuple[Choice, float]]:
        with stage("fields, window and rays"):
            found = trial.plan(tolerance)
        choice = measured(found.renderer, found.dtype, found.decisions, trial)
        worst = max(choice.error, tolerances.error * tolerances.excess(choice.agreement))
        return worst, (choice, found.without_diffraction)

    worst, (choice, without) = _tightened(attempt, tolerances.error)
    if trial.probes.windows or not isinstance(choice.renderer, PsfRenderer):
        return choice
    samples, noise, times = trial.rays_instead(choice.renderer)
    # Rays know no diffraction.
    of_rays = math.hypot(noise, without if trial.requirements.diffraction else 0.0)
    verdict = (
        f"{samples**2} rays a pixel and colour would err by {of_rays:.2g} at {times:.2g} times "
        f"the cost"
    )
    wanted = times < 1.0 or choice.error > tolerances.error
    # For gradients alone rays are worth some times the cost, not any.
    wanted |= worst > tolerances.error and times < _WORTH
    if of_rays <= tolerances.error and wanted:
        agreed = f", {choice.agreement}" if choice.agreement else ""
        because = f"functions err by {choice.error:.2g}{agreed}; {verdict}"
        decisions = [
            Decision("model", RayRenderer.model, of_rays, because),
            *(f for f in choice.decisions if f.topic == "diffraction"),
        ]
        rays = RayRenderer(trial.probes.sensor, samples)
        return measured(rays, torch.float32, decisions, trial)
    decisions = [Decision("model", PsfRenderer.model, choice.error, verdict), *choice.decisions]
    if not trial.separate_planes:
        because = "not measured: the probe's planes make images of their own"
        decisions.append(Decision("occlusion", "blurred planes", 0.0, because))
    return replace(choice, decisions=tuple(decisions))


def _tightened(
    attempt: Callable[[float], tuple[float, Found]], tolerance: float
) -> tuple[float, Found]:
    """The first plan whose measured error is within a tolerance, or else the best of four.

    What a plan errs by is not quite what it expects: each round asks for less, in proportion to
    what the last one erred by.

    Args:
        attempt: a tolerance to plan for → the error that was measured, and the plan.
        tolerance: of the measured error.
    """
    share = 1.0
    best = attempt(tolerance)
    error = best[0]
    for _ in range(_ROUNDS - 1):
        if error <= tolerance:
            break
        share *= max(0.25, 0.7 * tolerance / error)
        error, found = attempt(share * tolerance)
        if error < best[0]:
            best = error, found
    return best
