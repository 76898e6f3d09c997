"""The renderer that chooses its model."""

import copy
import logging
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.imaging.choice.cost import psf_cost, rays_cost
from dolens.imaging.choice.plan import Finding, plan
from dolens.imaging.choice.probe import probe_image
from dolens.imaging.choice.reference import Reference, rays_samples, reference
from dolens.imaging.psf_renderer import PsfRenderer
from dolens.imaging.ray_renderer import RayRenderer
from dolens.imaging.scene import PlanarScene
from dolens.imaging.sensor import Sensor
from dolens.optics.backend import choose_backend
from dolens.optics.lens import Lens

logger = logging.getLogger(__name__)

# The reference's samples along each side of the pupil; rounds of tightening the plan.
_REFERENCE_SAMPLES, _ROUNDS = 24, 3
_MARGIN = 32


@dataclass(frozen=True)
class Choice:
    """A renderer, its precision, and how it was found.

    Attributes:
        renderer: what renders.
        dtype: of rays and image.
        findings: the decisions, with what each costs in grey levels.
        error: RMS error on the probe image against rays, both without diffraction, grey levels;
            0 is below what the reference can tell.
        uncertainty: of that error, grey levels.
        tolerance: grey levels that were asked for.
        seconds: that choosing took.
    """

    renderer: PsfRenderer | RayRenderer
    dtype: torch.dtype
    findings: tuple[Finding, ...]
    error: float
    uncertainty: float
    tolerance: float
    seconds: float

    def lines(self) -> list[str]:
        """The plan, for people: a line a decision."""
        model = "psf" if isinstance(self.renderer, PsfRenderer) else "rays"
        return [
            f"renderer auto: {model}, error {self.error:.2g} of {self.tolerance:g} grey levels "
            f"(±{self.uncertainty:.2g}) on the probe image, planned in {self.seconds:.1f} s",
            *(f"  {finding}" for finding in self.findings),
        ]

    def numbers(self) -> dict[str, float]:
        """The plan as metrics."""
        renderer = self.renderer
        numbers = {
            "auto/error_grey_levels": self.error,
            "auto/uncertainty_grey_levels": self.uncertainty,
            "auto/tolerance_grey_levels": self.tolerance,
            "auto/plan_s": self.seconds,
            "auto/pupil_samples": float(renderer.pupil_samples),
            "auto/precision_bits": float(torch.finfo(self.dtype).bits),
            "auto/by_rays": float(isinstance(renderer, RayRenderer)),
        }
        if isinstance(renderer, PsfRenderer):
            numbers["auto/fields"] = float(renderer.fields[0] * renderer.fields[1])
            numbers["auto/psf_pixels"] = float(renderer.size)
            numbers["auto/diffraction"] = float(renderer.diffraction != "none")
        return numbers


class AutoRenderer:
    """Renders by the cheapest model whose error stays within a tolerance.

    The first render makes a plan for the lens as it is, and later ones keep to it; a lens that
    changes wants a new plan now and then (`make_plan`).

    Args:
        sensor: the pixels.
        tolerance: RMS error on a photograph-like probe image, in grey levels: 1/255 of full scale
            in linear light, before the sensor's own noise.
        seed: of the probe and its reference.
    """

    def __init__(self, sensor: Sensor, tolerance: float = 1.0, seed: int = 0) -> None:
        if not tolerance > 0.0:
            raise InputError(f"renderer: tolerance must be positive (grey levels), not {tolerance}")
        self.sensor = sensor
        self.tolerance = tolerance
        self.seed = seed
        self.choice: Choice | None = None
        self._other: Lens | None = None

    def rays_per_image(self, scene: PlanarScene) -> int:
        """Rays traced for one render; 0 before there is a plan."""
        return 0 if self.choice is None else self.choice.renderer.rays_per_image(scene)

    def render(
        self,
        lens: Lens,
        scene: PlanarScene,
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
    def make_plan(
        self, lens: Lens, scene: PlanarScene, values: Mapping[str, Tensor] | None = None
    ) -> Choice:
        """Choose, measure on the probe image, log; the choice is kept for `render`."""
        started = time.perf_counter()
        current = _with_values(lens, values)
        single, double = (copy.deepcopy(current).to(d) for d in (torch.float32, torch.float64))
        backend = choose_backend(double.system(), lens.backend)
        texture, whole = self._probe(scene)
        judge = reference(single, whole, self.sensor, texture, _REFERENCE_SAMPLES, self.seed)
        tightened, best = 1.0, None
        for _ in range(_ROUNDS):
            found = plan(
                single.system(),
                double.system(),
                scene,
                self.sensor,
                tightened * self.tolerance,
                backend,
            )
            error = self._measured(
                found.renderer, found.dtype, single, double, texture, whole, judge
            )
            if best is None or error < best[0]:
                best = error, found
            if error <= self.tolerance:
                break
            tightened *= max(0.25, 0.7 * self.tolerance / error)
        error, found = best
        renderer, dtype, findings = found.renderer, found.dtype, list(found.findings)
        surfaces = len(lens.surfaces)
        samples, noise = rays_samples(single, whole, self.sensor, texture, self.tolerance)
        times = rays_cost(self.sensor, samples**2, scene, surfaces) / psf_cost(
            renderer, scene, surfaces
        )
        # Rays know no diffraction.
        of_rays = math.hypot(noise, found.without_diffraction)
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
        self._other = single if dtype == torch.float32 else double
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

    def _probe(self, scene: PlanarScene) -> tuple[Tensor, PlanarScene]:
        """A texture that covers the sensor, and the scene with it in its place."""
        sensor = self.sensor
        size = (sensor.height + 2 * _MARGIN, sensor.width + 2 * _MARGIN)
        texture = probe_image(*size, self.seed)[:, [i % 3 for i in range(len(scene.wavelengths))]]
        centre = (float(round(sensor.centre_row)), float(round(sensor.centre_column)))
        return texture, replace(scene, texture_centre=centre)

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


def _with_values(lens: Lens, values: Mapping[str, Tensor] | None) -> Lens:
    """The lens with some of its parameters replaced."""
    changed = copy.deepcopy(lens)
    parameters = dict(changed.named_parameters())
    for name, value in (values or {}).items():
        parameters[name].copy_(value)
    return changed
