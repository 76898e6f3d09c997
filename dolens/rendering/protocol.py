"""The interface of a renderer: a lens, a scene and textures in, the image on the sensor out."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Self, cast

import torch
from torch import Tensor

from dolens.optics.lens import Lens
from dolens.scene.scene import Scene
from dolens.sensor.pixels import Sensor

Values = Mapping[str, Tensor]


@dataclass(frozen=True)
class SensorWindow:
    """A part of a sensor, and the part of the scene that a texture shows to it.

    Attributes:
        sensor: the pixels of the window.
        texture_centre: rows below and columns right of the axis where the texture's centre lies, as
            in `Scene`.
    """

    sensor: Sensor
    texture_centre: tuple[float, float]


@dataclass(frozen=True)
class WindowShare:
    """Windows that are a part of those of a batch; the others are rendered elsewhere.

    Attributes:
        first: number in the batch of the first window here.
        windows: the pixels of all windows of the batch, by which random numbers are numbered.
    """

    first: int
    windows: Sequence[Sensor]


@dataclass(frozen=True)
class GradientMeasure:
    """A loss and the variables that its gradient is taken with respect to.

    Attributes:
        variables: tensors that require gradients, in units in which they may be compared.
        values: the lens's parameters by name, as functions of the variables.
        loss: of an image (B, images, C, H, W) in linear light, the textures (B, channels, h, w) it
            shows and the lens's parameters, on which a truth may depend.
    """

    variables: Sequence[Tensor]
    values: Callable[[], Values]
    loss: Callable[[Tensor, Tensor, Values], Tensor]


# From the windows that textures are shown to, one for each texture, to the measure of gradients.
Measure = Callable[[Sequence[SensorWindow]], GradientMeasure]


class Renderer(ABC):
    """Renders what a scene shows through a lens onto a sensor.

    A renderer has a field `sensor` and the method `render`.  All else has a default, which fits a
    frozen dataclass whose settings say everything.

    Attributes:
        sensor: the pixels.
        model: the name of the method, for logs and checkpoints.
        monte_carlo: whether each pixel is estimated by itself from random rays of its own: the
            image then has their noise, and a window is rendered like that part of the whole.
    """

    sensor: Sensor
    model: ClassVar[str] = ""
    monte_carlo: ClassVar[bool] = False

    @abstractmethod
    def render(
        self,
        lens: Lens,
        scene: Scene,
        textures: Tensor,
        seed: int,
    ) -> Tensor:
        """Image textures as a scene shows them.

        Args:
            lens: the lens; its precision is that of rays and image.
            scene: planes, wavelengths, and what textures mean.
            textures: (B, channels, H, W), linear light, as the scene takes them.
            seed: of all random numbers; the same seed gives the same image.

        Returns:
            (B, images, C, height, width), linear light, in the lens's precision; of a planar scene
            an image for each depth.  Differentiable in the lens's parameters and values and the
            textures.

        Raises:
            InputError: a depth inside the lens, or channels that are not the scene's.
        """

    def render_windows(
        self,
        lens: Lens,
        scene: Scene,
        textures: Tensor,
        windows: Sequence[SensorWindow],
        seed: int,
    ) -> Tensor:
        """Image each texture on a window of its own; here one after the other.

        Args:
            lens: as of `render`, and the others.
            scene: of all windows.
            textures: (W, channels, h, w).
            windows: W of one size, of the renderer's sensor.
            seed: the i-th window has seed + i.

        Returns:
            (W, images, C, height, width).
        """
        images = []
        for i, (window, texture) in enumerate(zip(windows, textures, strict=True)):
            placed = replace(scene, texture_centre=window.texture_centre)
            renderer = self.on(window.sensor)
            images.append(renderer.render(lens, placed, texture[None], seed + i))
        return torch.cat(images)

    def render_share(
        self,
        lens: Lens,
        scene: Scene,
        textures: Tensor,
        windows: Sequence[SensorWindow],
        seed: int,
        share: WindowShare,
    ) -> Tensor:
        """Image each texture on its window as `render_windows` does where all windows are together.

        Args:
            lens: as of `render_windows`, and the others.
            scene: of all windows.
            textures: (W, channels, h, w), of this share.
            windows: W, of this share.
            seed: of the whole batch.
            share: where these windows stand among all.
        """
        return self.render_windows(lens, scene, textures, windows, seed + share.first)

    def rays_per_image(self, scene: Scene, sensor: Sensor | None = None) -> int:
        """Rays traced through the lens for one render, all wavelengths together.

        Args:
            scene: the scene.
            sensor: the pixels that are rendered; None: the renderer's own.
        """
        return 0

    @property
    def psf_size(self) -> int | None:
        """Pixels along each side of its point spread functions; None where it has none."""
        return None

    def on(self, sensor: Sensor) -> Self:
        """The same renderer for another sensor."""
        other: Any = self  # a dataclass, as every renderer
        return replace(other, sensor=sensor)

    def for_windows(self, sensor: Sensor, windows: Mapping[str, Sensor]) -> Self:
        """The same renderer for windows of a large sensor.

        Args:
            sensor: the whole one.
            windows: by name, some that are like those that will be rendered.
        """
        return self.on(sensor)

    def with_pupil(self, lens: Lens, scene: Scene) -> Self:
        """The renderer with what it may keep of the lens's pupil as long as the lens hardly
        changes; here nothing.
        """
        return self

    def without_diffraction(self) -> "Renderer":
        """Return a renderer of the same images by rays alone; here the renderer itself."""
        return self

    def prepare(  # noqa: B027 - a renderer need not look at the lens
        self,
        lens: Lens,
        scene: Scene,
        measure: Measure | None = None,
        photographs: Tensor | None = None,
    ) -> None:
        """Look at the lens as it is now; `render` need not be called with the same one.

        Args:
            lens: as of `render`, and the scene.
            scene: planes and wavelengths.
            measure: the variables and the loss whose gradients matter; None: not said.
            photographs: (P, 3, h, w), linear light: what scenes look like.
        """

    def numbers(self) -> dict[str, float]:
        """Metrics of the renderer itself; here none."""
        return {}

    def settings(self) -> dict[str, Any]:
        """All settings but the sensor, as plain values that a checkpoint can hold."""
        names = [f.name for f in fields(cast(Any, self)) if f.init and f.name != "sensor"]
        named = {name: getattr(self, name) for name in names}
        return {name: list(v) if isinstance(v, tuple) else v for name, v in named.items()}

    def state(self) -> dict[str, Any]:
        """Plain values for a checkpoint of what was found of the lens; here none."""
        return {}

    def load_state(self, lens: Lens, state: Mapping[str, Any]) -> "Renderer":
        """The renderer with what another's `state` held.

        Args:
            lens: the lens of the checkpoint.
            state: of a renderer with the same settings.
        """
        return self
