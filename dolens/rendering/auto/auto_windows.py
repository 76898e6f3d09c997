"""A renderer for windows of a large sensor that is chosen by what the windows need."""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from dolens.optics.lens import Lens
from dolens.rendering.auto.agreement import (
    Agreement,
    GradientMeasure,
    Render,
    agreement,
    from_plain,
    gradient,
    gradients_of_rays,
    judging_samples,
    plain,
)
from dolens.rendering.auto.auto_renderer import AutoRenderer
from dolens.rendering.auto.chosen import gradient_numbers, settings_of
from dolens.rendering.auto.plan import Plan, Requirements, plan
from dolens.rendering.auto.probe import probe_texture
from dolens.rendering.auto.reference import Reference, reference
from dolens.rendering.auto.tightening import tightened
from dolens.rendering.auto.trial import REFERENCE_SAMPLES, in_both_precisions, with_values
from dolens.rendering.chief_ray_map import chief_ray_maps
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.pupil.exit_pupil import paraxial_exit_pupil
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor

logger = logging.getLogger(__name__)

# Sides of the reference's parts of a window, pixels.
_SIDE = 12
_DIFFRACTION = ("none", "limit", "wave")

# From windows and the places of their textures' centres to what gradients are judged by.
WindowMeasure = Callable[[Sequence[Sensor], Sequence[tuple[float, float]]], GradientMeasure]


@dataclass(frozen=True)
class WindowChoice:
    """A renderer that serves all windows, and what is known of it.

    Attributes:
        renderer: its sensor is the whole one.
        errors: by the windows' names, RMS on the probe image against rays, both without
            diffraction, grey levels.
        uncertainty: of these, the largest.
        seconds: that choosing and measuring took.
        agreement: of the gradients with those of rays; None where they were not asked for.
    """

    renderer: PsfRenderer
    errors: Mapping[str, float]
    uncertainty: float
    seconds: float
    agreement: Agreement | None = None

    @property
    def worst(self) -> float:
        """The largest error."""
        return max(self.errors.values())

    def __str__(self) -> str:
        renderer = self.renderer
        errors = ", ".join(f"{name} {error:.2g}" for name, error in self.errors.items())
        return (
            f"{renderer.fields[0]}×{renderer.fields[1]} fields, {renderer.pupil_samples}² rays, "
            f"{renderer.size} pixels, colours {renderer.colours}, diffraction "
            f"{renderer.diffraction}; errors in grey levels: {errors} (±{self.uncertainty:.2g}); "
            + (f"{self.agreement}; " if self.agreement else "")
            + f"{self.seconds:.1f} s"
        )


class AutoWindows:
    """Renders windows as the most demanding of some of them needs it.

    Fields, window, rays and what is shared are planned for each of the windows by itself, as
    `AutoRenderer` does for a sensor; the union of these plans is measured against rays on a probe
    image in all of them.  Functions are centred on chief rays, so that they follow the lens.

    Args:
        auto: tolerance, whether gradients and diffraction matter, seed; its sensor is a window's.
        sensor: the whole one.
        windows: by name, of the whole sensor; all others are taken to be like some of these.
    """

    def __init__(self, auto: AutoRenderer, sensor: Sensor, windows: Mapping[str, Sensor]) -> None:
        self.auto = auto
        self.sensor = sensor
        self.windows = dict(windows)
        self.choice: WindowChoice | None = None
        self.plans = 0
        self._photographs: Tensor | None = None

    @torch.no_grad()
    def prepare(
        self,
        lens: Lens,
        scene: PlanarScene,
        values: Mapping[str, Tensor] | None = None,
        measure: WindowMeasure | None = None,
        photographs: Tensor | None = None,
    ) -> None:
        """Measure the choice for the lens as it is now; choose where there is none, or where it
        errs too much.

        Args:
            lens: the lens.
            scene: one depth, and wavelengths.
            values: its parameters as they are now.
            measure: of gradients, of windows and their textures' centres; None: only images count.
            photographs: (P, 3, h, w), linear light, that windows look at beside the probe images;
                those of a later call replace them.
        """
        if photographs is not None:
            self._photographs = photographs
        started, before = time.perf_counter(), self.choice
        auto = self.auto
        measure = measure if auto.gradients else None
        trial = _Trial(self, with_values(lens, values), scene, measure, self._photographs)
        if before is not None:
            renderer = before.renderer.with_pupil(lens, scene, values)
            errors, agreed = trial.errors(renderer), trial.agreement(renderer)
            seconds = before.seconds + time.perf_counter() - started
            well = auto.serves_still(before.agreement, agreed)
            if max(errors.values()) <= max(auto.tolerance, before.worst) and well:
                self.choice = WindowChoice(renderer, errors, trial.uncertainty, seconds, agreed)
                logger.info("renderer auto, windows: still serves, %s", self.choice)
                return
        self.plans += 1

        def attempt(tolerance: float) -> tuple[float, WindowChoice]:
            renderer = self._planned(trial, tolerance).with_pupil(lens, scene, values)
            errors, agreed = trial.errors(renderer), trial.agreement(renderer)
            seconds = time.perf_counter() - started + (before.seconds if before else 0.0)
            found = WindowChoice(renderer, errors, trial.uncertainty, seconds, agreed)
            return max(found.worst, auto.tolerance * auto.excess(agreed)), found

        _, best = tightened(attempt, auto.tolerance)
        self.choice = best
        logger.info("renderer auto, windows: %s", best)
        auto.warn_of_misses("renderer auto, windows", best.worst, best.agreement)

    def _planned(self, trial: "_Trial", tolerance: float) -> PsfRenderer:
        """The union of the windows' plans."""
        plans = [trial.plan(i, tolerance) for i in range(len(trial.windows))]
        if any(found.dtype == torch.float64 for found in plans) and trial.lens.dtype.itemsize < 8:
            logger.warning(
                "renderer auto, windows: rounding shows; windows are rendered in the lens's "
                "precision, dtype=float64 would avoid it"
            )
        parts = [found.renderer for found in plans]
        return PsfRenderer(
            self.sensor,
            tuple(max(part.fields[side] for part in parts) for side in (0, 1)),
            max(part.pupil_samples for part in parts),
            max(part.size for part in parts),
            illumination="map" if any(p.illumination == "map" for p in parts) else "functions",
            colours="each" if any(p.colours == "each" for p in parts) else "one",
            diffraction=max((part.diffraction for part in parts), key=_DIFFRACTION.index),
        )

    def numbers(self) -> dict[str, float]:
        """The choice as metrics, `auto/…`."""
        if self.choice is None:
            return {}
        renderer, choice = self.choice.renderer, self.choice
        return (
            {f"auto/error_grey_levels/{n}": error for n, error in choice.errors.items()}
            | {
                "auto/error_grey_levels": choice.worst,
                "auto/uncertainty_grey_levels": choice.uncertainty,
                "auto/tolerance_grey_levels": self.auto.tolerance,
                "auto/plan_s": choice.seconds,
                "auto/plans": float(self.plans),
                "auto/pupil_samples": float(renderer.pupil_samples),
                "auto/fields": float(renderer.fields[0] * renderer.fields[1]),
                "auto/psf_pixels": float(renderer.size),
                "auto/diffraction": float(renderer.diffraction != "none"),
            }
            | gradient_numbers(choice.agreement)
        )

    def state(self) -> dict[str, Any]:
        """The choice, as plain values."""
        if self.choice is None:
            return {}
        return {
            "settings": settings_of(self.choice.renderer),
            "errors": dict(self.choice.errors),
            "uncertainty": self.choice.uncertainty,
            "agreement": plain(self.choice.agreement),
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go on with a choice that was made before."""
        if state:
            renderer = PsfRenderer(sensor=self.sensor, **state["settings"])
            agreed = from_plain(state.get("agreement"))
            self.choice = WindowChoice(renderer, state["errors"], state["uncertainty"], 0.0, agreed)


class _Trial:
    """Windows of a lens as it is, what they look at, and what rays make of it."""

    def __init__(
        self,
        owner: AutoWindows,
        lens: Lens,
        scene: PlanarScene,
        measure: WindowMeasure | None,
        photographs: Tensor | None,
    ) -> None:
        self.lens, self.scene, self.auto, self.sensor = lens, scene, owner.auto, owner.sensor
        self.names, self.windows = list(owner.windows), list(owner.windows.values())
        self.single, self.double = in_both_precisions(lens)
        self.centres = self._centres(owner.sensor)
        channels = len(scene.wavelengths)
        self.textures = [
            probe_texture(w, channels, self.auto.seed, photographs) for w in self.windows
        ]
        self.judges: Sequence[Reference] = [
            reference(
                self.single,
                replace(scene, texture_centre=centre),
                window,
                texture,
                REFERENCE_SAMPLES,
                self.auto.seed,
                _SIDE,
            )
            for window, centre, texture in zip(
                self.windows, self.centres, self.textures, strict=True
            )
        ]
        # Each texture has a window to itself.
        self._each = [w for w in self.windows for _ in range(len(self.textures[0]))]
        self._centre_each = [c for c in self.centres for _ in range(len(self.textures[0]))]
        self._measure = measure(self._each, self._centre_each) if measure else None
        self._of_rays: tuple[Tensor, Tensor] | None = None

    @property
    def uncertainty(self) -> float:
        """Of errors, grey levels."""
        return max(judge.uncertainty for judge in self.judges)

    def plan(self, number: int, tolerance: float) -> Plan:
        """For one window by itself."""
        scene = replace(self.scene, texture_centre=self.centres[number])
        single, double = (
            ImagingSystem.of(lens.system(), scene, self.windows[number])
            for lens in (self.single, self.double)
        )
        auto = self.auto
        return plan(
            single,
            double,
            Requirements(tolerance, auto.gradients, auto.diffraction, ("chief_rays",)),
        )

    def errors(self, renderer: PsfRenderer) -> dict[str, float]:
        """RMS errors of the windows, rendered together; of the model without diffraction."""
        renderer = replace(renderer, diffraction="none")
        images = self._rendered(renderer)({}, self.auto.seed + 1)
        parts = images.split(len(self.textures[0]))
        errors = [judge.error(part) for judge, part in zip(self.judges, parts, strict=True)]
        return dict(zip(self.names, errors, strict=True))

    def agreement(self, renderer: PsfRenderer) -> Agreement | None:
        """How well gradients of all windows agree with those of rays, both without diffraction."""
        if self._measure is None or not self._measure.variables:
            return None
        textures, seed = torch.cat(self.textures), self.auto.seed
        if self._of_rays is None:
            window, count = self.windows[0], len(self._each)
            side = judging_samples(window.height, count * window.width, len(self.scene.wavelengths))
            rays = self._rendered(RayRenderer(self.sensor, side))
            self._of_rays = gradients_of_rays(rays, textures, self._measure, seed + 2)
        rendered = self._rendered(replace(renderer, diffraction="none"))
        return agreement(gradient(rendered, textures, self._measure, (seed + 4,)), self._of_rays)

    def _rendered(self, renderer: PsfRenderer | RayRenderer) -> Render:
        def render(values: Mapping[str, Tensor], seed: int) -> Tensor:
            return renderer.render_windows(
                self.lens,
                self.scene,
                torch.cat(self.textures),
                self._each,
                self._centre_each,
                seed,
                values,
            )

        return render

    def _centres(self, sensor: Sensor) -> list[tuple[float, float]]:
        """Where windows look, to a whole texel."""
        system, wavelengths = self.double.system(), (self.scene.middle_wavelength,)
        middle = self.scene.as_planes(wavelengths=wavelengths)
        pupil = paraxial_exit_pupil(system, wavelengths)
        looks = chief_ray_maps(ImagingSystem(system, middle, sensor, pupil), self.windows)
        return [tuple(float(c.mean().round()) for c in look) for look in looks]
