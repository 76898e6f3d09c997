"""Textures at depths of a scene: each on every plane, or in layers that hide each other."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from dolens.analysis.pupil_quadrature import SpotRays, gaussian_quadrature
from dolens.diffraction.pixel_psf import with_diffraction_limit
from dolens.errors import InputError, check_choice
from dolens.experiments.camera.views.base import (
    LIGHTS_OFFSET,
    SCENE_OFFSET,
    Comparison,
    Imaging,
    Shot,
    Views,
)
from dolens.experiments.camera.views.lights import RandomLights
from dolens.experiments.camera.views.truth import (
    TRUTHS,
    reference_chief_ray_map,
    sample_texture,
)
from dolens.experiments.camera.views.whole import (
    DIFFRACTION,
    Placing,
    WholePicture,
    at_depth,
    axial_function,
    convolved,
    diffraction_of,
)
from dolens.optics.lens import Lens
from dolens.rendering.auto.auto_renderer import AutoRenderer
from dolens.rendering.exit_pupil import axial_f_number
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.protocol import GradientMeasure, Measure, Renderer
from dolens.rendering.psf import axial_point_spread_functions
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.scene.layered import LayeredScene
from dolens.scene.planar import as_planes, pinhole_image
from dolens.scene.scene import Scene, resized
from dolens.sensor.colour import linear_to_srgb
from dolens.sensor.noise import generator_of
from dolens.sensor.readout import Readout


class DepthViews(Imaging):
    """Textured planes at several depths, in front of the whole sensor.

    With `truth` "pinhole" the truth is what a distortion-free pinhole sees; with "chief_rays" it is
    the texture where the chief rays of the reference wavelength look, so that distortion is no
    error, and image and truth move together with the lens.

    Args:
        scene: depths and wavelengths.
        renderer: makes the training images.
        readout: what the sensor makes of them.
        evaluation_renderer: makes the validation and test images, of the same sensor; None: the
            training renderer, which then judges its own approximations.
        psf_size: pixels along each side of the point spread functions that networks ask for.
        psf_pupil_samples: their strata along each side of the pupil.
        truth: `pinhole` or `chief_rays`.
        seed: of rendering and noise.
        reference_renderers: make the test images besides, of the same sensor, by name.
        psf_diffraction: of the functions that networks ask for: `none`; `limit`: blurred by a
            perfect pupil's diffraction, as a measurement would find them; `orders`: the same of all
            orders of diffractive elements; `wave`: of wavefronts, at the middle of the sensor, with
            the `band` of the evaluation's.  Rays do not see a diffractive element's heights.
        psf_depths: of the functions that networks ask for, mm; None: the scene's.  A camera that is
            calibrated at its own depths is judged at others by it.
        lights: are added to all images, those of tests too; None: none.

    Raises:
        InputError: the renderers' sensors differ, an unknown word, or no depths.
    """

    def __init__(
        self,
        scene: Scene,
        renderer: Renderer,
        readout: Readout,
        evaluation_renderer: Renderer | None = None,
        psf_size: int = 65,
        psf_pupil_samples: int = 48,
        truth: str = "pinhole",
        seed: int = 0,
        reference_renderers: Mapping[str, Renderer] | None = None,
        psf_diffraction: str = "none",
        psf_depths: Sequence[float] | None = None,
        lights: RandomLights | None = None,
    ) -> None:
        super().__init__(scene, renderer, readout, seed)
        self.lights = lights
        if psf_depths is not None and not len(psf_depths):
            raise InputError("views.psf_depths: []; allowed: null, or depths in mm")
        self.psf_depths = None if psf_depths is None else tuple(map(float, psf_depths))
        check_choice(truth, TRUTHS, "views.truth")
        self.truth = truth
        if self.truth != "pinhole" and not scene.separate_planes:
            raise InputError(
                f"views.truth: '{truth}' needs planes that make images of their own; allowed for "
                "layers: pinhole"
            )
        self.evaluation_renderer = evaluation_renderer or renderer
        self.psf_size = psf_size
        self.psf_pupil_samples = psf_pupil_samples
        self._reference_renderers = dict(reference_renderers or {})
        check_choice(psf_diffraction, DIFFRACTION, "views.psf_diffraction")
        self.psf_diffraction = psf_diffraction
        self._f_number: float | None = None
        others = {
            f"reference_renderers.{name}": reference
            for name, reference in self._reference_renderers.items()
        }
        for name, other in {"evaluation_renderer": self.evaluation_renderer, **others}.items():
            if other.sensor != renderer.sensor:
                raise InputError(
                    f"{name}.sensor: {other.sensor} is not that of "
                    f"the training renderer, {renderer.sensor}"
                )

    def labels(self) -> list[str]:
        """The depths."""
        return self.scene.labels()

    def psf_labels(self) -> list[str]:
        """The depths of the functions."""
        return self._psf_scene(None).plane_labels()

    def expose(self, lens: Lens) -> None:
        """Set the exposure by the lens's aperture, where the readout has a reference F-number."""
        super().expose(lens)
        if self.lights is not None:
            self.lights.begin(lens, self.scene, self.sensor)
        if self.psf_diffraction == "limit":
            self._f_number = axial_f_number(lens)

    @property
    def registers_moved_images(self) -> bool:
        """Whether functions are centred, or the truth moves with the chief rays.

        A planned renderer's window is for an image that stays on the axis.
        """
        if isinstance(self.renderer, PsfRenderer):
            return self.renderer.registration == self._registration
        return self.truth == "chief_rays" and not isinstance(self.renderer, AutoRenderer)

    @property
    def _band(self) -> tuple[float, ...]:
        judge = self.evaluation_renderer
        return judge.band if isinstance(judge, PsfRenderer) else (0.0,)

    @property
    def _registration(self) -> str:
        """The registration of the functions of a lens that moves its image."""
        return "chief_rays" if self.truth == "chief_rays" else "centred"

    def _measure(self, lens: Lens, comparison: Comparison) -> Measure | None:
        """The training's loss as a function of images of textures; of planes of their own."""
        if not self.scene.separate_planes:
            return None

        def loss(image: Tensor, textures: Tensor, values: Mapping[str, Tensor]) -> Tensor:
            raw = self._raw(image.to(lens.dtype), self.seed)
            truth = self._truth(lens.with_values(values), textures.to(raw)).expand_as(raw)
            return comparison.loss(Views(truth, raw), values)

        found = GradientMeasure(comparison.variables, comparison.values, loss)
        return lambda windows: found

    def take(self, lens: Lens, shot: Shot) -> Views:
        """Image textures at every depth."""
        renderer = self._training if shot.stage == "train" else self.evaluation_renderer
        if shot.reference is not None:
            renderer = self._reference_renderers[shot.reference]
        seed = shot.seed(self.seed)
        image = renderer.render(lens, self.scene, shot.textures, seed)
        truth = self._truth(lens, shot.textures).expand_as(image)
        if self.lights is not None:
            given = (image, truth, seed + LIGHTS_OFFSET, shot.share)
            image, truth = self.lights.added_to(lens, *given)
        return Views(truth, self._raw(image, seed, shot.share))

    def _truth(self, lens: Lens, textures: Tensor) -> Tensor:
        """(B, D or 1, 3, H, W), display-encoded."""
        colours = self.scene.colours(textures)
        if self.truth == "pinhole":
            return linear_to_srgb(pinhole_image(colours, self.sensor))[:, None]
        ((rows, columns),) = reference_chief_ray_map(lens, self.scene, self.sensor, [self.sensor])
        centre = self.scene.texture_centre
        planes = [sample_texture(colours, r, c, centre) for r, c in zip(rows, columns, strict=True)]
        return linear_to_srgb(torch.stack(planes, 1))

    def reference_renderers(self) -> list[str]:
        """Those that were given."""
        return list(self._reference_renderers)

    def point_spread_functions(
        self,
        lens: Lens,
        pupil_samples: int | None = None,
        depths: Sequence[float] | None = None,
        size: int | None = None,
    ) -> Tensor:
        """(depths, 3, K, K), on the axis."""
        samples = pupil_samples or self.psf_pupil_samples
        scene = self._psf_scene(depths)
        if self.psf_diffraction in ("orders", "wave"):
            renderer = PsfRenderer(
                self.sensor,
                (1, 1),
                samples,
                size or self.psf_size,
                registration="centred" if self.registers_moved_images else "pinhole",
                diffraction=self.psf_diffraction,
                band=self._band if self.psf_diffraction == "wave" else (0.0,),
                jitter=False,
            )
            imaging = ImagingSystem.of(lens.system(), scene, self.sensor)
            return renderer.point_spread_functions(imaging, 0).functions[0]
        functions = axial_point_spread_functions(
            lens,
            scene,
            self.sensor,
            size or self.psf_size,
            samples,
            # As they are in the images, whose truth is where their chief rays are.
            centred=self.registers_moved_images,
        )
        if self.psf_diffraction == "none":
            return functions
        f_number = self._f_number or axial_f_number(lens.as_stored())
        pitch = self.sensor.pixel_pitch
        return with_diffraction_limit(functions, pitch, scene.wavelengths, f_number)

    @torch.no_grad()
    def whole_picture(self, lens: Lens, picture: Tensor, placing: Placing) -> WholePicture:
        """Image a picture with the blur on the axis everywhere: the camera's sensor is a small part
        of the field, and a larger picture stands for many such parts side by side.
        """
        scale = placing.scale or 1.0
        size = [max(1, round(length / scale)) for length in picture.shape[-2:]]
        picture = resized(picture, *size).to(lens.device)
        scene = at_depth(as_planes(self.scene), placing.depth, lens)
        diffraction = placing.diffraction or diffraction_of(self.evaluation_renderer)
        functions = axial_function(lens, scene, self.sensor, self.psf_size, diffraction)
        mapping = (
            f"{scale:g} pixel(s) of the picture to one of the sensor, {size[1]}×{size[0]} of "
            f"{1000.0 * self.sensor.pixel_pitch:g} µm; the blur on the axis everywhere, in "
            f"{functions.shape[-1]} pixels, diffraction: {diffraction} (the run's own sensor has "
            f"{self.sensor.width}×{self.sensor.height})"
        )
        image = convolved(picture.to(lens.dtype), functions)
        return WholePicture(linear_to_srgb(picture)[None], image[None], None, mapping)

    def _psf_scene(self, depths: Sequence[float] | None) -> Scene:
        """The scene with the depths that are asked for, else those of the functions."""
        depths = self.psf_depths if depths is None else depths
        return self.scene if depths is None else replace(self.scene, depths=tuple(depths))

    def spots(self, lens: Lens, rings: int, arms: int) -> list[SpotRays]:
        """Return spots of each depth: on the axis, and towards the sensor's edges."""
        half = 0.35 * self.sensor.pixel_pitch * min(self.sensor.height, self.sensor.width)
        found = []
        scales = self.scene.magnifications(lens.system())
        for depth, magnification in zip(self.scene.depths, scales, strict=True):
            height = half / magnification
            fields = [(0.0, 0.0), (0.0, height), (height, 0.0)]
            found.append(
                gaussian_quadrature(
                    lens, fields, self.scene.wavelengths, rings, arms, depth, symmetry=False
                )
            )
        return found


class LayerViews(DepthViews):
    """Scenes with a depth at every texel, in front of the whole sensor.

    Textures that have a depth as their last channel are taken as they are; photographs are given
    one, with edges where near things hide far ones, drawn from the seed, the stage and the index.

    Args:
        scene: the planes.
        occluders: ellipses in front of each photograph.
        **settings: those of `DepthViews`.

    Raises:
        InputError: the scene is not one of layers.
    """

    def __init__(self, scene: LayeredScene, occluders: int = 8, **settings: Any) -> None:
        super().__init__(scene, **settings)
        if not isinstance(scene, LayeredScene):
            raise InputError("views: layers need a scene of layers; choose scene=layers")
        self.occluders = occluders

    def take(self, lens: Lens, shot: Shot) -> Views:
        """One image of each texture."""
        textures = shot.textures
        if textures.shape[1] == len(self.scene.wavelengths):
            generator = generator_of(shot.seed(self.seed) + SCENE_OFFSET)
            near, far = self.scene.depths[0], self.scene.depths[-1]
            before = 0 if shot.share is None else shot.share.first
            textures = with_occluders(textures, near, far, self.occluders, generator, before)
        return super().take(lens, shot._replace(textures=textures))


def with_occluders(
    textures: Tensor,
    nearest: float,
    farthest: float,
    count: int,
    generator: torch.Generator,
    before: int = 0,
) -> Tensor:
    """Give photographs a depth: a slanted background, and ellipses in front of it.

    Vergences, 1/depth, are drawn evenly, so that blurs are.  The background takes the farther half
    of the range; ellipses are painted from far to near, each with a part of the photograph that
    lies elsewhere, since an edge in depth is seen by what changes there.

    Args:
        textures: (B, C, H, W), linear light.
        nearest: mm in front of the first vertex.
        farthest: mm.
        count: ellipses in each image.
        generator: of the random numbers, on the CPU.
        before: photographs whose random numbers come before: of a batch, of which these are a part.

    Returns:
        (B, C + 1, H, W), as `LayeredScene` takes them: the depth is the last channel.

    Raises:
        InputError: the depths are not positive or not in order, or the count is negative.
    """
    if not 0.0 < nearest <= farthest:
        raise InputError(f"occluders: depths {nearest:g} and {farthest:g} mm; allowed: 0 < a <= b")
    if count < 0:
        raise InputError(f"occluders: {count} of them; allowed: 0 or more")
    near, far = 1.0 / nearest, 1.0 / farthest
    for _ in range(before):
        _drawn(count, generator)
    return torch.stack([_scene(image, near, far, count, generator) for image in textures])


def _scene(
    image: Tensor, near: float, far: float, count: int, generator: torch.Generator
) -> Tensor:
    height, width = image.shape[-2:]
    options = {"dtype": torch.float64, "device": image.device}
    row = torch.linspace(-1.0, 1.0, height, **options)[:, None]
    column = torch.linspace(-1.0, 1.0, width, **options)
    middle = 0.5 * (near + far)
    (angle, tilt), drawn = _drawn(count, generator)
    turn = torch.tensor(2.0 * torch.pi * angle, **options)
    slope = (row * turn.sin() + column * turn.cos()) / 2.0**0.5
    vergence = far + (middle - far) * (0.5 + 0.5 * tilt * slope)
    light = image
    # From far to near: the later one hides the earlier one.
    for shares in drawn[drawn[:, 0].argsort()].tolist():
        place, down, across, long, short, shift_down, shift_across = shares
        radii = 0.15 + 0.35 * long, 0.15 + 0.35 * short
        inside = ((row - (2.0 * down - 1.0)) / radii[0]).square() + (
            (column - (2.0 * across - 1.0)) / radii[1]
        ).square() < 1.0
        # Between a quarter and three quarters of the image away.
        shifts = (
            round(height * (0.25 + 0.5 * shift_down)),
            round(width * (0.25 + 0.5 * shift_across)),
        )
        light = torch.where(inside, image.roll(shifts, (-2, -1)), light)
        vergence = torch.where(inside, middle + (near - middle) * place, vergence)
    return torch.cat((light, (1.0 / vergence)[None].to(image)))


def _drawn(count: int, generator: torch.Generator) -> tuple[list[float], Tensor]:
    """Draw the random numbers of one photograph: of its background, and of its ellipses."""
    background = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
    return background, torch.rand(count, 7, generator=generator, dtype=torch.float64)
