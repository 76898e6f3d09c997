"""What every renderer offers."""

from collections.abc import Mapping
from typing import Any, Protocol, Self

from torch import Tensor

from dolens.optics.lens import Lens
from dolens.scene.planar import Scene
from dolens.sensor.pixels import Sensor


class Renderer(Protocol):
    """Lens, scene and texture in; the linear image on the sensor out."""

    @property
    def sensor(self) -> Sensor:
        """The pixels."""

    def render(
        self,
        lens: Lens,
        scene: Scene,
        textures: Tensor,
        seed: int,
        values: Mapping[str, Tensor] | None = None,
    ) -> Tensor:
        """Image textures (B, C, H, W) at every depth of a scene: (B, depths, C, height, width)."""

    def rays_per_image(self, scene: Scene) -> int:
        """Rays traced through the lens for one render, all wavelengths together."""

    def prepare(
        self,
        lens: Lens,
        scene: Scene,
        values: Mapping[str, Tensor] | None = None,
        measure: Any = None,
        photographs: Tensor | None = None,
    ) -> None:
        """Look at the lens as it is now; `render` need not be called with the same one.

        `measure`, a `choice.agreement.GradientMeasure`, says which gradients matter, and
        `photographs` (P, 3, h, w), linear light, what scenes look like.
        """

    def numbers(self) -> dict[str, float]:
        """What the renderer has to say of itself, as metrics."""

    def state(self) -> dict[str, Any]:
        """What `prepare` found, as plain values for a checkpoint."""

    def load_state(self, lens: Lens, state: Mapping[str, Any]) -> None:
        """Take up what another renderer's `state` held."""


class Unprepared:
    """A renderer whose settings say everything."""

    def prepare(
        self,
        lens: Lens,
        scene: Scene,
        values: Mapping[str, Tensor] | None = None,
        measure: Any = None,
        photographs: Tensor | None = None,
    ) -> None:
        """Nothing depends on the lens."""

    def with_pupil(
        self, lens: Lens, scene: Scene, values: Mapping[str, Tensor] | None = None
    ) -> Self:
        """The renderer with what it may keep of the lens's pupil; here nothing."""
        return self

    def numbers(self) -> dict[str, float]:
        """Nothing that the settings do not say."""
        return {}

    def state(self) -> dict[str, Any]:
        """Nothing was found."""
        return {}

    def load_state(self, lens: Lens, state: Mapping[str, Any]) -> None:
        """There is nothing to take up."""
