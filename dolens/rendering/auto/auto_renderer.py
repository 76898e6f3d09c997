"""The renderer that chooses its model."""

import copy
import logging
import math
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.rendering.auto.agreement import Agreement, GradientMeasure, from_plain, plain
from dolens.rendering.auto.chosen import Choice, settings_of
from dolens.rendering.auto.finding import Finding
from dolens.rendering.auto.plan import Plan
from dolens.rendering.auto.tightening import tightened
from dolens.rendering.auto.trial import Trial, with_values
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import Scene
from dolens.sensor.pixels import Sensor

logger = logging.getLogger(__name__)

# Times the cost of functions that rays may take where only the gradients of functions are off.
_WORTH = 4.0


class AutoRenderer:
    """Renders by the cheapest model whose error stays within a tolerance.

    The first render makes a plan for the lens as it is, and later ones keep to it; `prepare` asks
    whether it still serves a lens that has changed, and makes another if it does not.

    Args:
        sensor: the pixels.
        tolerance: RMS error on the worst probe image, in grey levels: 1/255 of full scale in linear
            light, before the sensor's own noise.  One probe is like a photograph, one is of fine
            detail, and others are those that `prepare` is given.
        gradients: whether the lens's gradients matter too, and not only the image.
        gradient_cosine: the least cosine of the angle between a plan's gradient and that of rays.
        gradient_norm: by how much the ratio of their norms may differ from 1.
        diffraction: whether to model it where it shows; where not, the log says what it would
            change.
        seed: of the probe and its reference.
    """

    def __init__(
        self,
        sensor: Sensor,
        tolerance: float = 1.0,
        gradients: bool = True,
        diffraction: bool = True,
        seed: int = 0,
        gradient_cosine: float = 0.95,
        gradient_norm: float = 0.15,
    ) -> None:
        if not tolerance > 0.0:
            raise InputError(f"renderer: tolerance must be positive (grey levels), not {tolerance}")
        if not 0.0 < gradient_cosine < 1.0 or not gradient_norm > 0.0:
            raise InputError(
                "renderer: gradient_cosine must be between 0 and 1 and gradient_norm positive, not "
                f"{gradient_cosine} and {gradient_norm}"
            )
        self.gradient_cosine = gradient_cosine
        self.gradient_norm = gradient_norm
        self.sensor = sensor
        self.tolerance = tolerance
        self.gradients = gradients
        self.diffraction = diffraction
        self.seed = seed
        self.choice: Choice | None = None
        self.plans = 0
        self._other: Lens | None = None
        self._photographs: Tensor | None = None

    def rays_per_image(self, scene: Scene) -> int:
        """Rays traced for one render; 0 before there is a plan."""
        return 0 if self.choice is None else self.choice.renderer.rays_per_image(scene)

    def render(
        self,
        lens: Lens,
        scene: Scene,
        textures: Tensor,
        seed: int,
        values: Mapping[str, Tensor] | None = None,
    ) -> Tensor:
        """Image textures at every depth of a scene; as `RayRenderer.render`.

        Returns:
            (B, depths, C, height, width), linear light, in the lens's precision, whatever the
            plan's is.
        """
        if self.choice is None:
            self.make_plan(lens, scene, values)
        choice = self.choice
        if choice.dtype == lens.dtype:
            return choice.renderer.render(lens, scene, textures, seed, values)
        values = {**dict(lens.named_parameters()), **(values or {})}
        values = {name: value.to(choice.dtype) for name, value in values.items()}
        image = choice.renderer.render(self._other, scene, textures, seed, values)
        return image.to(lens.dtype)

    @torch.no_grad()
    def prepare(
        self,
        lens: Lens,
        scene: Scene,
        values: Mapping[str, Tensor] | None = None,
        measure: GradientMeasure | None = None,
        photographs: Tensor | None = None,
    ) -> None:
        """Measure what the plan errs by for the lens as it is now; plan anew where it is too much,
        and where there is none.

        Args:
            lens: as of `render`, and the scene.
            scene: planes and wavelengths.
            values: parameters of the lens as it is now.
            measure: the variables and the loss whose gradients are to be those of rays; None: the
                squared error to the truth, with respect to those values that require gradients.
            photographs: (P, 3, h, w), linear light: what the scene may look like, beside the two
                probe images; those of a later call replace them.
        """
        if photographs is not None:
            self._photographs = photographs
        if self.choice is None:
            self.make_plan(lens, scene, values, measure)
            return
        started = time.perf_counter()
        trial = self._trial(lens, scene, values, measure)
        choice = self.choice
        error = trial.error(choice.renderer, choice.dtype)
        agreed = trial.agreement(choice.renderer, choice.dtype)
        seconds = choice.seconds + time.perf_counter() - started
        if error <= max(self.tolerance, choice.error) and self.serves_still(
            choice.agreement, agreed
        ):
            renderer = choice.renderer.with_pupil(lens, scene, values)
            self.choice = replace(
                choice, renderer=renderer, error=error, agreement=agreed, seconds=seconds
            )
            logger.info(
                "renderer auto: the plan still serves, error %.2g grey levels%s",
                error,
                f"; {agreed}" if agreed else "",
            )
            return
        logger.info("renderer auto: the lens has changed, error %.2g grey levels", error)
        self.make_plan(lens, scene, values, measure)
        self.choice = replace(self.choice, seconds=self.choice.seconds + seconds)

    def numbers(self) -> dict[str, float]:
        """The plan as metrics, `auto/…`."""
        if self.choice is None:
            return {}
        return self.choice.numbers() | {"auto/plans": float(self.plans)}

    def state(self) -> dict[str, Any]:
        """The plan, as plain values."""
        if self.choice is None:
            return {}
        renderer = self.choice.renderer
        return {
            "model": "psf" if isinstance(renderer, PsfRenderer) else "rays",
            "settings": settings_of(renderer),
            "bits": torch.finfo(self.choice.dtype).bits,
            "error": self.choice.error,
            "uncertainty": self.choice.uncertainty,
            "agreement": plain(self.choice.agreement),
        }

    def load_state(self, lens: Lens, state: Mapping[str, Any]) -> None:
        """Go on with a plan that was made before."""
        if not state:
            return
        model = {"psf": PsfRenderer, "rays": RayRenderer}[state["model"]]
        dtype = {32: torch.float32, 64: torch.float64}[state["bits"]]
        renderer = model(sensor=self.sensor, **state["settings"])
        self._other = copy.deepcopy(lens).requires_grad_(False).to(dtype)
        self.choice = Choice(
            renderer,
            dtype,
            (),
            state["error"],
            state["uncertainty"],
            self.tolerance,
            0.0,
            from_plain(state.get("agreement")),
        )
        logger.info("renderer auto: the plan of the checkpoint is taken up")

    @torch.no_grad()
    def make_plan(
        self,
        lens: Lens,
        scene: Scene,
        values: Mapping[str, Tensor] | None = None,
        measure: GradientMeasure | None = None,
    ) -> Choice:
        """Choose, measure on the probe images, log; the choice is kept for `render`."""
        started = time.perf_counter()
        self.plans += 1
        trial = self._trial(lens, scene, values, measure)

        def attempt(tolerance: float) -> tuple[float, tuple[Plan, float, Agreement | None]]:
            found = trial.plan(tolerance)
            error = trial.error(found.renderer, found.dtype)
            agreed = trial.agreement(found.renderer, found.dtype)
            return max(error, self.tolerance * self.excess(agreed)), (found, error, agreed)

        worst, (found, error, agreed) = tightened(attempt, self.tolerance)
        renderer, dtype, findings = found.renderer, found.dtype, list(found.findings)
        samples, noise, times = trial.rays_instead(renderer)
        # Rays know no diffraction.
        of_rays = math.hypot(noise, found.without_diffraction if self.diffraction else 0.0)
        verdict = (
            f"{samples**2} rays a pixel and colour would err by {of_rays:.2g} at {times:.2g} times "
            f"the cost"
        )
        wanted = times < 1.0 or error > self.tolerance
        # For gradients alone rays are worth some times the cost, not any.
        wanted |= worst > self.tolerance and times < _WORTH
        if of_rays <= self.tolerance and wanted:
            because = f"functions err by {error:.2g}" + (f", {agreed}" if agreed else "")
            findings = [
                Finding("model", "rays", of_rays, f"{because}; {verdict}"),
                *(f for f in findings if f.what == "diffraction"),
            ]
            renderer, dtype = RayRenderer(self.sensor, samples), torch.float32
            error, agreed = trial.error(renderer, dtype), trial.agreement(renderer, dtype)
        else:
            findings.insert(0, Finding("model", "psf", error, verdict))
            if not scene.separate_planes:
                because = "not measured: the probe's planes make images of their own"
                findings.append(Finding("occlusion", "blurred planes", 0.0, because))
        renderer = renderer.with_pupil(lens, scene, values)
        self._other = trial.lens(dtype).requires_grad_(False)
        self.choice = Choice(
            renderer,
            dtype,
            tuple(findings),
            error,
            trial.uncertainty,
            self.tolerance,
            time.perf_counter() - started,
            agreed,
        )
        for line in self.choice.lines():
            logger.info("%s", line)
        self.warn_of_misses("renderer auto", error, agreed)
        return self.choice

    def warn_of_misses(self, who: str, error: float, agreed: Agreement | None) -> None:
        """Log which of the tolerances a choice misses."""
        if error > self.tolerance:
            logger.warning(
                "%s: the tolerance of %g grey levels is not met: %.2g is the best found",
                who,
                self.tolerance,
                error,
            )
        if self.excess(agreed) > 1.0:
            logger.warning(
                "%s: the tolerance of gradients (cosine %g, norm within %g) is not met: %s",
                who,
                self.gradient_cosine,
                self.gradient_norm,
                agreed,
            )

    def excess(self, agreed: Agreement | None) -> float:
        """How many times their tolerance gradients err by; 0 where they do not matter."""
        return agreed.excess(self.gradient_cosine, self.gradient_norm) if agreed else 0.0

    def serves_still(self, before: Agreement | None, now: Agreement | None) -> bool:
        """Whether gradients are within their tolerance, or hardly worse than they were."""
        return self.excess(now) <= max(1.0, 1.5 * self.excess(before))

    def _trial(
        self,
        lens: Lens,
        scene: Scene,
        values: Mapping[str, Tensor] | None,
        measure: GradientMeasure | None,
    ) -> Trial:
        """The lens as it is, before the probe images."""
        return Trial(
            with_values(lens, values),
            scene,
            self.sensor,
            values if self.gradients else None,
            measure if self.gradients else None,
            self.gradients,
            self.diffraction,
            self.tolerance,
            self.seed,
            self._photographs,
        )
