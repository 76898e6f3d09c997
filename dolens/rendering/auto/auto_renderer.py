"""The renderer that chooses its model, for a whole sensor or for windows of a large one."""

import logging
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.rendering.auto.choice import Choice, Tolerances, choose, measured
from dolens.rendering.auto.field_grid import REGISTRATIONS
from dolens.rendering.auto.plan import Requirements
from dolens.rendering.auto.trial import ProbeSet, Trial
from dolens.rendering.protocol import Measure, Renderer, SensorWindow, WindowShare
from dolens.scene.scene import Scene
from dolens.sensor.pixels import Sensor
from dolens.tasks import stage

logger = logging.getLogger(__name__)


@dataclass(eq=False)
class AutoRenderer(Renderer):
    """Renders by the cheapest model whose error stays within a tolerance.

    The first render makes a plan for the lens as it is, and later ones keep to it; `prepare` asks
    whether it still serves a lens that has changed, and makes another if it does not.

    For windows of a large sensor (`for_windows`), fields, PSF size, rays and what is shared are
    planned for each of some windows by itself; the union of these plans is measured against rays on
    the probe images in all of them, and serves all other windows too.  Functions are then centred
    on chief rays, so that they follow the lens, and rays are not considered instead.

    Attributes:
        sensor: the pixels.
        tolerance: RMS error on the worst probe image, in grey levels: 1/255 of full scale in linear
            light, before the sensor's own noise.  One probe is like a photograph, one is of fine
            detail, and others are those that `prepare` is given.
        gradients: whether the lens's gradients matter too, and not only the image.
        diffraction: whether to model it where it shows; where not, the log says what it would
            change.
        seed: of the probe and its reference.
        gradient_cosine: the least cosine of the angle between a plan's gradient and that of rays.
        gradient_norm: by how much the ratio of their norms may differ from 1.
        windows: by name, of the sensor, that a plan is made for; none: the whole sensor.
        choice: the renderer that was chosen; None before there is a plan.
        plans: how many were made.
    """

    sensor: Sensor
    tolerance: float = 1.0
    gradients: bool = True
    diffraction: bool = True
    seed: int = 0
    gradient_cosine: float = 0.95
    gradient_norm: float = 0.15
    windows: Mapping[str, Sensor] = field(default_factory=dict, kw_only=True)
    choice: Choice | None = field(default=None, init=False)
    plans: int = field(default=0, init=False)
    _cast: Lens | None = field(default=None, init=False, repr=False)
    _photographs: Tensor | None = field(default=None, init=False, repr=False)

    model: ClassVar[str] = "auto"

    def __post_init__(self) -> None:
        if not 0.0 < self.tolerance < math.inf:
            raise InputError(
                f"renderer: tolerance must be positive (grey levels), not {self.tolerance}"
            )
        if not 0.0 < self.gradient_cosine < 1.0 or not self.gradient_norm > 0.0:
            raise InputError(
                "renderer: gradient_cosine must be between 0 and 1 and gradient_norm positive, not "
                f"{self.gradient_cosine} and {self.gradient_norm}"
            )

    def for_windows(self, sensor: Sensor, windows: Mapping[str, Sensor]) -> "AutoRenderer":
        """One that plans for windows of a large sensor; see `Renderer.for_windows`."""
        return replace(self, sensor=sensor, windows=dict(windows))

    def without_diffraction(self) -> Renderer:
        """The renderer that was chosen, by rays alone; itself before there is a plan."""
        return self if self.choice is None else self.choice.renderer.without_diffraction()

    @property
    def tolerances(self) -> Tolerances:
        """The errors that a plan may have."""
        return Tolerances(self.tolerance, self.gradient_cosine, self.gradient_norm)

    @property
    def psf_size(self) -> int | None:
        """Pixels along each side of the chosen functions; None where none are chosen."""
        return None if self.choice is None else self.choice.renderer.psf_size

    def rays_per_image(self, scene: Scene, sensor: Sensor | None = None) -> int:
        """Rays traced for one render; 0 before there is a plan."""
        return 0 if self.choice is None else self.choice.renderer.rays_per_image(scene, sensor)

    def render(
        self,
        lens: Lens,
        scene: Scene,
        textures: Tensor,
        seed: int,
    ) -> Tensor:
        """Image textures as a scene shows them; see `Renderer.render`.

        The image is in the lens's precision, whatever the plan's is.
        """
        choice = self._choice(lens, scene)
        planned = self._as_planned(lens, choice.dtype)
        image = choice.renderer.render(planned, scene, textures, seed)
        return image.to(lens.dtype)

    def render_windows(
        self,
        lens: Lens,
        scene: Scene,
        textures: Tensor,
        windows: Sequence[SensorWindow],
        seed: int,
    ) -> Tensor:
        """Image each texture on a window of its own; see `Renderer.render_windows`."""
        choice = self._choice(lens, scene)
        planned = self._as_planned(lens, choice.dtype)
        image = choice.renderer.render_windows(planned, scene, textures, windows, seed)
        return image.to(lens.dtype)

    def render_share(
        self,
        lens: Lens,
        scene: Scene,
        textures: Tensor,
        windows: Sequence[SensorWindow],
        seed: int,
        share: WindowShare,
    ) -> Tensor:
        """Image each texture on its window, one of a larger batch; see `Renderer.render_share`."""
        choice = self._choice(lens, scene)
        planned = self._as_planned(lens, choice.dtype)
        image = choice.renderer.render_share(planned, scene, textures, windows, seed, share)
        return image.to(lens.dtype)

    def _choice(self, lens: Lens, scene: Scene) -> Choice:
        """Return the choice; make a plan where there is none."""
        return self.choice or self.make_plan(lens, scene)

    def _as_planned(self, lens: Lens, dtype: torch.dtype) -> Lens:
        """The lens in the plan's precision; gradients flow back to its own values."""
        if dtype == lens.dtype:
            return lens
        values = {**dict(lens.named_parameters()), **lens.given}
        assert self._cast is not None  # the choice was made with it
        return self._cast.with_values({name: value.to(dtype) for name, value in values.items()})

    @torch.no_grad()
    def prepare(
        self,
        lens: Lens,
        scene: Scene,
        measure: Measure | None = None,
        photographs: Tensor | None = None,
    ) -> None:
        """Measure the errors of the plan for the lens as it is now; plan anew where they are too
        large, and where there is no plan.

        Args:
            lens: as of `render`, and the scene.
            scene: planes and wavelengths.
            measure: the variables and the loss whose gradients are to be those of rays; None: for a
                whole sensor the squared error to the truth, with respect to those values that the
                lens was given and that require gradients, and for windows none.
            photographs: (P, 3, h, w), linear light: what the scene may look like, beside the two
                probe images; those of a later call replace them.
        """
        if photographs is not None:
            self._photographs = photographs
        started, before = time.perf_counter(), self.choice
        trial = self._trial(lens, scene, measure)
        if before is not None:
            renewed = before.renderer.with_pupil(lens, scene)
            # The whole sensor is measured with the pupil that it was rendered with until now.
            renderer = renewed if self.windows else before.renderer
            with stage("checking the renderer's plan"):
                now = measured(renderer, before.dtype, before.decisions, trial)
            now = replace(now, seconds=before.seconds + time.perf_counter() - started)
            if now.error <= max(self.tolerance, before.error) and self.tolerances.serves_still(
                before.agreement, now.agreement
            ):
                self.choice = replace(now, renderer=renewed)
                logger.info(
                    "renderer auto: the plan still serves, error %.2g grey levels%s",
                    now.error,
                    f"; {now.agreement}" if now.agreement else "",
                )
                return
            logger.info("renderer auto: the lens has changed, error %.2g grey levels", now.error)
            started -= before.seconds
        self.plans += 1
        with stage("planning the renderer"):
            chosen = choose(trial, self.tolerances)
        self._cast = trial.lens(chosen.dtype).requires_grad_(False)
        self.choice = replace(
            chosen,
            renderer=chosen.renderer.with_pupil(lens, scene),
            seconds=time.perf_counter() - started,
        )
        for line in self.choice.lines():
            logger.info("%s", line)
        for line in self.tolerances.misses(self.choice):
            logger.warning("renderer auto: %s", line)

    def _trial(self, lens: Lens, scene: Scene, measure: Measure | None) -> Trial:
        """The lens as it is, before the probe images."""
        registrations = ("chief_rays",) if self.windows else REGISTRATIONS
        return Trial(
            lens,
            scene,
            ProbeSet(self.sensor, self.seed, self.windows, self._photographs),
            Requirements(self.tolerance, self.gradients, self.diffraction, registrations),
            measure if self.gradients else None,
        )

    @torch.no_grad()
    def make_plan(
        self,
        lens: Lens,
        scene: Scene,
        measure: Measure | None = None,
    ) -> Choice:
        """Choose, measure on the probe images, log; the choice is kept for `render`."""
        self.choice = None
        self.prepare(lens, scene, measure)
        found: Choice | None = self.choice
        assert found is not None  # `prepare` chose
        return found

    def numbers(self) -> dict[str, float]:
        """The plan as metrics, `auto/…`."""
        if self.choice is None:
            return {}
        return self.choice.numbers() | {"auto/plans": float(self.plans)}

    def state(self) -> dict[str, Any]:
        """The plan, as plain values."""
        return {} if self.choice is None else self.choice.state()

    def load_state(self, lens: Lens, state: Mapping[str, Any]) -> "AutoRenderer":
        """Go on with a plan that was made before; this renderer takes it up."""
        if state:
            self.choice = Choice.from_state(state, self.sensor, lens.dtype, self.tolerance)
            self._cast = lens.storing_its_values().requires_grad_(False).to(self.choice.dtype)
            logger.info("renderer auto: the plan of the checkpoint is taken up")
        return self
