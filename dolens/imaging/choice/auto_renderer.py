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
from dolens.imaging.choice.chosen import Choice, settings_of
from dolens.imaging.choice.cost import psf_cost, rays_cost
from dolens.imaging.choice.finding import Finding
from dolens.imaging.choice.plan import Plan, plan
from dolens.imaging.choice.probe import probe_texture
from dolens.imaging.choice.reference import Reference, rays_samples, reference
from dolens.imaging.choice.tightening import tightened
from dolens.imaging.psf_renderer import PsfRenderer
from dolens.imaging.ray_renderer import RayRenderer
from dolens.imaging.scene import PlanarScene, Scene
from dolens.imaging.sensor import Sensor
from dolens.optics.backend import choose_backend
from dolens.optics.lens import Lens

logger = logging.getLogger(__name__)

# The reference's samples along each side of the pupil.
REFERENCE_SAMPLES = 24


class AutoRenderer:
    """Renders by the cheapest model whose error stays within a tolerance.

    The first render makes a plan for the lens as it is, and later ones keep to it; `prepare` asks
    whether it still serves a lens that has changed, and makes another if it does not.

    Args:
        sensor: the pixels.
        tolerance: RMS error on a photograph-like probe image, in grey levels: 1/255 of full scale
            in linear light, before the sensor's own noise.
        gradients: whether the lens's gradients matter too, and not only the image.
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
    ) -> None:
        if not tolerance > 0.0:
            raise InputError(f"renderer: tolerance must be positive (grey levels), not {tolerance}")
        self.sensor = sensor
        self.tolerance = tolerance
        self.gradients = gradients
        self.diffraction = diffraction
        self.seed = seed
        self.choice: Choice | None = None
        self.plans = 0
        self._other: Lens | None = None

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
    def prepare(self, lens: Lens, scene: Scene, values: Mapping[str, Tensor] | None = None) -> None:
        """Measure what the plan errs by for the lens as it is now; plan anew where it is too much,
        and where there is none.
        """
        if self.choice is None:
            self.make_plan(lens, scene, values)
            return
        started = time.perf_counter()
        current = with_values(lens, values)
        single, double = in_both_precisions(current)
        texture, whole = self._probe(scene)
        judge = reference(single, whole, self.sensor, texture, REFERENCE_SAMPLES, self.seed)
        choice = self.choice
        error = self._measured(choice.renderer, choice.dtype, single, double, texture, whole, judge)
        if error <= max(self.tolerance, choice.error):
            seconds = choice.seconds + time.perf_counter() - started
            renderer = choice.renderer.with_pupil(lens, scene, values)
            self.choice = replace(choice, renderer=renderer, error=error, seconds=seconds)
            logger.info("renderer auto: the plan still serves, error %.2g grey levels", error)
            return
        logger.info("renderer auto: the lens has changed, error %.2g grey levels", error)
        self.make_plan(lens, scene, values)
        self.choice = replace(self.choice, seconds=self.choice.seconds + choice.seconds)

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
            renderer, dtype, (), state["error"], state["uncertainty"], self.tolerance, 0.0
        )
        logger.info("renderer auto: the plan of the checkpoint is taken up")

    @torch.no_grad()
    def make_plan(
        self, lens: Lens, scene: Scene, values: Mapping[str, Tensor] | None = None
    ) -> Choice:
        """Choose, measure on the probe image, log; the choice is kept for `render`."""
        started = time.perf_counter()
        self.plans += 1
        current = with_values(lens, values)
        single, double = in_both_precisions(current)
        backend = choose_backend(double.system(), lens.backend)
        texture, whole = self._probe(scene)
        planes = replace(whole, texture_centre=scene.texture_centre)
        judge = reference(single, whole, self.sensor, texture, REFERENCE_SAMPLES, self.seed)

        def attempt(tolerance: float) -> tuple[float, Plan]:
            found = plan(
                single.system(),
                double.system(),
                planes,
                self.sensor,
                tolerance,
                self.gradients,
                self.diffraction,
                backend,
            )
            measured = (single, double, texture, whole, judge)
            return self._measured(found.renderer, found.dtype, *measured), found

        error, found = tightened(attempt, self.tolerance)
        renderer, dtype, findings = found.renderer, found.dtype, list(found.findings)
        surfaces = len(lens.surfaces)
        samples, noise = rays_samples(single, whole, self.sensor, texture, self.tolerance)
        times = rays_cost(self.sensor, samples**2, planes, surfaces) / psf_cost(
            renderer, planes, surfaces
        )
        # Rays know no diffraction.
        of_rays = math.hypot(noise, found.without_diffraction if self.diffraction else 0.0)
        verdict = (
            f"{samples**2} rays a pixel and colour would err by {of_rays:.2g} at {times:.2g} times "
            f"the cost"
        )
        if of_rays <= self.tolerance and (times < 1.0 or error > self.tolerance):
            findings = [
                Finding("model", "rays", of_rays, f"functions err by {error:.2g}; {verdict}"),
                *(f for f in findings if f.what == "diffraction"),
            ]
            renderer, dtype = RayRenderer(self.sensor, samples), torch.float32
            error = self._measured(renderer, dtype, single, double, texture, whole, judge)
        else:
            findings.insert(0, Finding("model", "psf", error, verdict))
            if not scene.separate_planes:
                because = "not measured: the probe's planes make images of their own"
                findings.append(Finding("occlusion", "blurred planes", 0.0, because))
        renderer = renderer.with_pupil(lens, scene, values)
        self._other = (single if dtype == torch.float32 else double).requires_grad_(False)
        self.choice = Choice(
            renderer,
            dtype,
            tuple(findings),
            error,
            judge.uncertainty,
            self.tolerance,
            time.perf_counter() - started,
        )
        for line in self.choice.lines():
            logger.info("%s", line)
        if error > self.tolerance:
            logger.warning(
                "renderer auto: the tolerance of %g grey levels is not met: %.2g is the best found",
                self.tolerance,
                error,
            )
        return self.choice

    def _probe(self, scene: Scene) -> tuple[Tensor, PlanarScene]:
        """A texture that covers the sensor, and the scene with it in its place."""
        sensor = self.sensor
        texture = probe_texture(sensor, len(scene.wavelengths), self.seed)
        centre = (float(round(sensor.centre_row)), float(round(sensor.centre_column)))
        return texture, scene.as_planes(texture_centre=centre)

    def _measured(
        self,
        renderer: PsfRenderer | RayRenderer,
        dtype: torch.dtype,
        single: Lens,
        double: Lens,
        texture: Tensor,
        scene: PlanarScene,
        judge: Reference,
    ) -> float:
        """Error against the reference, which has no diffraction."""
        lens = single if dtype == torch.float32 else double
        if isinstance(renderer, PsfRenderer):
            renderer = replace(renderer, diffraction="none")
        return judge.error(renderer.render(lens, scene, texture, self.seed + 1))


def with_values(lens: Lens, values: Mapping[str, Tensor] | None) -> Lens:
    """The lens with some of its parameters replaced."""
    changed = copy.deepcopy(lens)
    parameters = dict(changed.named_parameters())
    for name, value in (values or {}).items():
        parameters[name].copy_(value)
    return changed


def in_both_precisions(lens: Lens) -> tuple[Lens, Lens]:
    """Copies in single and in double precision."""
    single, double = (copy.deepcopy(lens).to(d) for d in (torch.float32, torch.float64))
    return single, double
