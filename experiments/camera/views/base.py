"""The base class of a camera's views: the images that are taken of a texture."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Self

import torch
from torch import Tensor

from dolens.analysis.pupil_quadrature import SpotRays
from dolens.errors import InputError
from dolens.experiments.camera.views.whole import ByPlace, Placing, WholePicture
from dolens.optics.lens import Lens
from dolens.rendering.exit_pupil import axial_f_number
from dolens.rendering.protocol import Measure, Renderer
from dolens.scene.scene import Scene
from dolens.sensor.noise import BatchShare, generator_of
from dolens.sensor.pixels import Sensor
from dolens.sensor.readout import Readout

# Streams of random numbers that must not meet: an offset of the seed for each stage, and others for
# the sensor's noise, for what is drawn into scenes, and for lights.
_STAGES = {"train": 0, "val": 1, "test": 2}
_STRIDE, _NOISE_OFFSET, SCENE_OFFSET, LIGHTS_OFFSET = 1 << 40, 1 << 39, 1 << 38, 1 << 37


class Shot(NamedTuple):
    """Textures in front of a camera, and what decides all random numbers of their images.

    Attributes:
        textures: (B, 3, h, w), linear light.
        stage: `train`, `val` or `test`.
        index: of the batch in its stage.
        reference: the judge that makes the images, one of `Imaging.reference_renderers`, with the
            same noise; None: the camera's own renderer.
        share: of a larger batch, whose random numbers these textures have their part of.
    """

    textures: Tensor
    stage: str
    index: int
    reference: str | None = None
    share: BatchShare | None = None

    def seed(self, seed: int) -> int:
        """Return a seed of its own, of a run's; see `seed_of`."""
        return seed_of(seed, self.stage, self.index)


class Views(NamedTuple):
    """B textures, each imaged in V ways.

    Attributes:
        truth: (B, V, 3, H, W), display-encoded: what an ideal camera would have taken.
        raw: (B, V, 3, H, W), linear light, read out and developed.
        field: (B, V, 2, H, W), where each pixel lies on the sensor, x and y over half its diagonal,
            by which functions of each image are found; None where that is the same for all.
        readouts: (B, V, N, 3, H, W), where an image is read out N times; `raw` is their mean.
        motion: (N, 2), of the scene at each state of a lens that is exposed in several, pixels down
            and to the right.
    """

    truth: Tensor
    raw: Tensor
    field: Tensor | None = None
    readouts: Tensor | None = None
    motion: Tensor | None = None

    @property
    def given(self) -> Tensor:
        """What restorers are given: (B·V, 3, H, W), or (B·V, N, 3, H, W) of readouts."""
        return (self.raw if self.readouts is None else self.readouts).flatten(0, 1)


class PlainExposure(NamedTuple):
    """Images by a simpler camera of the same scene, and what restorers are told of them.

    Attributes:
        taken: the images.
        functions: point spread functions.
        noise: as of `Readout.noise`.
    """

    taken: Views
    functions: Tensor
    noise: Sequence[float]


class Comparison(NamedTuple):
    """The training's own loss and variables, for judging gradients.

    Attributes:
        variables: tensors that are varied.
        values: the lens's parameters by name, as functions of them.
        loss: of raw images and truths (B, V, 3, H, W), as of `Views`, and the lens's parameters.
    """

    variables: Sequence[Tensor]
    values: Callable[[], Mapping[str, Tensor]]
    loss: Callable[[Views, Mapping[str, Tensor]], Tensor]


class Imaging(ABC):
    """A scene, renderers and a readout.

    Subclasses say which images are taken (`take`) and what the gradients of a renderer are measured
    by (`_measure`).  All random numbers are functions of the seed, the stage and the index.

    Attributes:
        scene: what the camera looks at.
        renderer: of the training images; its sensor has the pixels of one image.
        evaluation_renderer: of the validation and test images.
        readout: what the sensor makes of light.
        seed: of rendering and noise.
        keeps_pupil: whether the training renderer keeps the lens's pupil from one `prepare` to the
            next.
    """

    keeps_pupil: ClassVar[bool] = False
    # Whether a camera knows which view an image is: the place in the field, but not the depth.
    view_is_known: ClassVar[bool] = False
    # Where the point spread functions are taken, for titles.
    psf_place: ClassVar[str] = "on the axis, at the distances of the scene"

    def __init__(self, scene: Scene, renderer: Renderer, readout: Readout, seed: int) -> None:
        self.scene = scene
        self.renderer = renderer
        self.readout = readout
        self.seed = seed
        # What makes the training images, with what it found of the lens.
        self._training = renderer
        self.evaluation_renderer = renderer

    @property
    def readouts(self) -> int | None:
        """How many readouts an image has; None: one, and no list of it."""
        return None

    @property
    def noise(self) -> Sequence[float] | Sequence[Sequence[float]]:
        """The noise of what restorers are given, as of `Readout.noise`, or of each readout."""
        return self.readout.noise

    @property
    def sensor(self) -> Sensor:
        """The pixels of one image."""
        return self.renderer.sensor

    @property
    def image_sensor(self) -> Sensor:
        """The whole sensor, of which an image may be a window."""
        return self.renderer.sensor

    def field_shares(self) -> Sequence[float]:
        """Return the fields that drawings show, over the sensor's half diagonal, from the axis."""
        return (0.0, 1.0)

    @property
    def object_distance(self) -> float:
        """The distance of the scene (the first of several depths), mm in front of the first vertex.

        Operands and drawings of the lens take it.
        """
        return self.scene.depths[0]

    @abstractmethod
    def labels(self) -> Sequence[str]:
        """Names of the evaluation's views, for metrics."""

    @abstractmethod
    def psf_labels(self) -> Sequence[str]:
        """Names of the point spread functions."""

    @abstractmethod
    def take(self, lens: Lens, shot: Shot) -> Views:
        """Image the textures of a shot."""

    @abstractmethod
    def point_spread_functions(
        self,
        lens: Lens,
        pupil_samples: int | None = None,
        depths: Sequence[float] | None = None,
        size: int | None = None,
    ) -> Tensor:
        """(views, 3, K, K), of the training's views; or of depths (mm) instead of the scene's.

        K is the views' own number of pixels, or the odd one that is given as `size`.
        """

    def functions_of_images(self, lens: Lens, taken: Views, stage: str) -> Tensor | None:
        """Return the point spread functions of each image's own place, (B·V, D, 3, K, K).

        I(p) = Σ PSF(e) · S(p - e) in the sensor's pixels, with S the truth in linear light.  Their
        sums are relative illuminations.  Differentiable in the values.

        Args:
            lens: the lens.
            taken: the images.
            stage: that they were taken in, whose renderer says how diffraction is modelled.

        Returns:
            Texture after texture; None where a camera does not know which view an image is.
        """
        return None

    @abstractmethod
    def spots(self, lens: Lens, rings: int, arms: int) -> list[SpotRays]:
        """Rays of spots that stand for what the views see, one entry for each object distance."""

    def spot_weights(self, fields: int) -> Sequence[float]:
        """Return what part of the training images each of the spots' fields stands for.

        Args:
            fields: of `spots`, of each object distance.
        """
        return [1.0 / fields] * fields

    def whole_picture(self, lens: Lens, picture: Tensor, placing: Placing) -> WholePicture:
        """Image a picture (3, h, w) of any size, linear light, as a plane at one depth.

        Raises:
            InputError: the views image no whole pictures.
        """
        raise InputError(f"views: {type(self).__name__} images no whole pictures")

    def by_place(
        self,
        lens: Lens,
        size: tuple[int, int],
        placing: Placing | None = None,
    ) -> ByPlace | None:
        """Return what restores a whole picture by place, where cameras know the place.

        Args:
            lens: the lens.
            size: height and width of the picture on the sensor, pixels.
            placing: how it was put in front of the camera; None: as in training.
        """
        return None

    def field_of(self, height: int, width: int) -> Tensor | None:
        """Where each pixel of an image about the middle of the sensor lies, (2, H, W), x and y over
        half the sensor's diagonal; None where the camera is the same all over.

        Raises:
            InputError: the image is larger than the sensor.
        """
        return None

    @property
    def registers_moved_images(self) -> bool:
        """Whether an image that a decentred lens moves is compared with the truth it shows."""
        return True

    def judged_by_training(self) -> Self:
        """Return these views with the training's renderer for evaluation images too."""
        found = copy.copy(self)
        found.evaluation_renderer = self._training
        return found

    def reference_renderers(self) -> Sequence[str]:
        """Names of renderers that make the test images besides."""
        return []

    def check(self, lens: Lens) -> None:
        """Raise `InputError` where a depth lies inside the lens; fix the scene's scale for it."""
        self.scene.check(lens.system())
        self.scene = self.scene.fixed_for(lens.system())

    def expose(self, lens: Lens) -> None:
        """Set the sensor's exposure by the aperture of the lens as it begins, where the readout has
        a reference F-number.

        It is held from then on: what variables change of the F-number is left out of value and
        derivative alike.
        """
        if self.readout.reference_f_number is not None:
            self.readout = self.readout.at_f_number(axial_f_number(lens))

    def prepare(
        self,
        lens: Lens,
        comparison: Comparison | None = None,
        photographs: Tensor | None = None,
    ) -> None:
        """Let the training renderer look at the lens as it is now, at the start of an epoch.

        Args:
            lens: the lens.
            comparison: which gradients a renderer that chooses its model has to get right.
            photographs: (P, 3, h, w), linear light, on which it has to, beside its own images.
        """
        measure = None if comparison is None else self._measure(lens, comparison)
        self._training.prepare(lens, self.scene, measure, photographs)
        if self.keeps_pupil:
            self._training = self._training.with_pupil(lens, self.scene)

    def _measure(self, lens: Lens, comparison: Comparison) -> Measure | None:
        """The training's loss as a function of images of textures; None where there is none."""
        return None

    def _raw(
        self,
        image: Tensor,
        seed: int,
        share: BatchShare | None = None,
        readout: Readout | None = None,
    ) -> Tensor:
        """An image in linear light, read out with the noise of a seed and developed."""
        readout = readout or self.readout
        generator = generator_of(seed + _NOISE_OFFSET, image.device)
        return readout.develop(readout(image, generator, share))

    def plain_exposure(self, lens: Lens, shot: Shot) -> PlainExposure | None:
        """Return images by a plain lens in one exposure, to compare; None where there is none."""
        return None

    @property
    def has_plain_exposure(self) -> bool:
        """Whether there is a plain lens to compare with."""
        return False

    def sensed(self, image: Tensor, generator: torch.Generator) -> Tensor:
        """Return what the sensor gives for light (1, 3, H, W): (1, C, H, W), or of each of N
        readouts (1, N, C, H, W), from an image of each.
        """
        return self.readout(image, generator)

    def developed(self, signal: Tensor) -> Tensor:
        """Return the linear light of what the sensor gave, as restorers are given it."""
        return self.readout.develop(signal)

    def rays(self) -> int:
        """Rays that a training image takes; 0 before a renderer is chosen."""
        return self._training.rays_per_image(self.scene, self.sensor)

    def numbers(self) -> dict[str, float]:
        """The renderer's metrics of itself."""
        return self._training.numbers()

    def state(self) -> dict[str, Any]:
        """Return what the renderer found, as plain values for a checkpoint."""
        return self._training.state()

    def load_state(self, lens: Lens, state: Mapping[str, Any]) -> None:
        """Go on with what another one's `state` held."""
        self._training = self._training.load_state(lens, state)


def seed_of(seed: int, stage: str, index: int) -> int:
    """A seed of its own for every batch of every stage."""
    return (seed * len(_STAGES) + _STAGES[stage]) * _STRIDE + index
