"""Textures on windows drawn from the whole field: how a large sensor trains on a small machine."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dolens.analysis.pupil_quadrature import SpotRays, gaussian_quadrature
from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.rendering.auto.agreement import GradientMeasure
from dolens.rendering.auto.auto_renderer import AutoRenderer
from dolens.rendering.auto.auto_windows import AutoWindows
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.pupil.exit_pupil import ExitPupil
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene, pinhole_image
from dolens.sensor.colour import linear_to_srgb
from dolens.sensor.pixels import Sensor
from dolens.sensor.readout import Readout
from experiments.camera.views.base import NOISE_OFFSET, Comparison, Views, exposed, seed_of
from experiments.camera.views.field_windows import FieldWindows
from experiments.camera.views.truth import check_truth, chief_ray_looks, looked_up, nearest_texel

EVERYWHERE = "field"


class FieldViews:
    """Each texture on a window of a large sensor, imaged as it is there.

    Training windows are drawn from the whole field.  Every evaluation texture is imaged in zones:
    windows at fractions of the half diagonal, at azimuths that go around from texture to texture,
    and one drawn evenly from the whole field, `field`.

    With `truth` "chief_rays" the truth is the texture where the chief rays of the reference
    wavelength look: distortion, which a camera's calibration undoes, is part of it, and lateral
    colour is not.  It moves with the lens as the image does, and both carry the derivative.  With
    "pinhole" it is what a distortion-free pinhole sees, and distortion is an error.

    Args:
        scene: one depth, and wavelengths.
        sensor: the whole of it.
        renderer: makes the training images; its sensor says how large windows are.  An
            `AutoRenderer` is asked for what the zones need.
        readout: what the sensor makes of them.
        evaluation_renderer: makes the validation and test images; None: the training renderer.
        zones: fractions of the half diagonal, by name.
        training_windows: `circle`: drawn evenly from the area of the circle about the sensor, so
            that the edge of the field counts by its area; `radius`: evenly from the distances to
            the middle; `area`: from the sensor, of which corners are a small part.
        truth: `chief_rays` or `pinhole`.
        seed: of windows, rendering and noise.

    Raises:
        InputError: several depths, a window larger than the sensor, or other pixels; nothing but
            an `AutoRenderer` to evaluate by.
    """

    def __init__(
        self,
        scene: PlanarScene,
        sensor: Sensor,
        renderer: PsfRenderer | RayRenderer | AutoRenderer,
        readout: Readout,
        evaluation_renderer: PsfRenderer | RayRenderer | None = None,
        zones: Mapping[str, float] | None = None,
        training_windows: str = "circle",
        truth: str = "chief_rays",
        seed: int = 0,
    ) -> None:
        self.truth = check_truth(truth)
        self.scene = scene
        self.whole = sensor
        self.renderer = renderer
        self.readout = readout
        self.evaluation_renderer = evaluation_renderer or renderer
        self.zones = dict(zones or {"axis": 0.0, "0.5": 0.5, "0.7": 0.7, "full": 1.0})
        self.seed = seed
        self._pupil: ExitPupil | None = None
        self._auto: AutoWindows | None = None
        window = renderer.sensor
        if len(scene.depths) != 1:
            raise InputError(f"scene.depths: {len(scene.depths)} of them; allowed: one")
        if window.pixel_pitch != sensor.pixel_pitch:
            raise InputError(
                f"renderer.sensor.pixel_pitch: {window.pixel_pitch} is not the sensor's, "
                f"{sensor.pixel_pitch}"
            )
        if window.height > sensor.height or window.width > sensor.width:
            raise InputError(
                f"renderer.sensor: a window of {window.height}×{window.width} pixels is larger "
                f"than the sensor, {sensor.height}×{sensor.width}"
            )
        for name, share in self.zones.items():
            if not 0.0 <= share <= 1.0:
                raise InputError(f"views.zones.{name}: {share}; allowed: 0 (axis) to 1 (corner)")
        self.windows = FieldWindows(sensor, window.height, window.width, training_windows)
        if isinstance(self.evaluation_renderer, AutoRenderer):
            raise InputError("evaluation_renderer: windows are evaluated by rays or psf, not auto")
        if isinstance(renderer, AutoRenderer):
            windows = {name: self.windows.zone(share, 0) for name, share in self.zones.items()}
            self._auto = AutoWindows(renderer, sensor, windows)

    @property
    def sensor(self) -> Sensor:
        """The pixels of one window."""
        return self.renderer.sensor

    @property
    def object_distance(self) -> float:
        """The scene's depth."""
        return self.scene.depths[0]

    def labels(self) -> list[str]:
        """The zones, and the whole field."""
        return [*self.zones, EVERYWHERE]

    def psf_labels(self) -> list[str]:
        """The zones."""
        return list(self.zones)

    def check(self, lens: Lens) -> None:
        """Raise `InputError` where the depth lies inside the lens; fix the scene's scale for it."""
        self.scene.check(lens.system())
        self.scene = self.scene.fixed_for(lens.system())

    def expose(self, lens: Lens) -> None:
        """Set the exposure by the lens's aperture, where the readout has a reference F-number."""
        self.readout = exposed(self.readout, lens)

    def prepare(
        self,
        lens: Lens,
        values: Mapping[str, Tensor],
        comparison: Comparison | None = None,
        photographs: Tensor | None = None,
    ) -> None:
        """Find what training windows share until the next time: the renderer, and the pupil."""
        if self._auto is not None:
            measure = partial(self._measure, lens, comparison) if comparison else None
            self._auto.prepare(lens, self.scene, values, measure, photographs)
        elif isinstance(self.renderer, PsfRenderer):
            whole = replace(self.renderer, sensor=self.whole)
            self._pupil = whole.with_pupil(lens, self.scene, values).pupil

    def _measure(
        self,
        lens: Lens,
        comparison: Comparison,
        windows: Sequence[Sensor],
        centres: Sequence[tuple[float, float]],
    ) -> GradientMeasure:
        """The training's loss as a function of windows' images of textures."""

        def loss(image: Tensor, textures: Tensor, values: Mapping[str, Tensor]) -> Tensor:
            generator = torch.Generator(image.device).manual_seed(self.seed + NOISE_OFFSET)
            raw = self.readout.develop(self.readout(image, generator))
            textures = textures.to(raw)
            truth = self._truth(lens, values, textures, windows, centres)[:, None]
            field = torch.stack([self.windows.coordinates(w, textures) for w in windows])
            return comparison.loss(Views(truth, raw, field[:, None]), values)

        return GradientMeasure(comparison.variables, comparison.values, loss)

    def take(
        self,
        lens: Lens,
        values: Mapping[str, Tensor],
        textures: Tensor,
        stage: str,
        index: int,
        judge: str | None = None,
    ) -> Views:
        """Image textures (B, 3, h, w): one window each in training, one a zone otherwise."""
        seed, count = seed_of(self.seed, stage, index), len(textures)
        rows = [self._shown(stage, index * count + i) for i in range(count)]
        windows = [window for row in rows for window in row]
        repeated = textures.repeat_interleave(len(rows[0]), dim=0)
        looks, centres = self._looked_at(lens, values, windows)
        truth = _seen(repeated, looks, windows, centres)
        renderer = replace(self.evaluation_renderer, sensor=self.whole)
        if stage == "train":
            renderer = self._training_renderer(lens, values)
        image = renderer.render_windows(
            lens,
            self.scene,
            repeated,
            windows,
            centres,
            seed,
            values,
        )
        field = torch.stack([self.windows.coordinates(window, textures) for window in windows])
        truth, image, field = (
            t.unflatten(0, (count, len(rows[0]))) for t in (truth, image[:, 0], field)
        )
        generator = torch.Generator(image.device).manual_seed(seed + NOISE_OFFSET)
        return Views(truth, self.readout.develop(self.readout(image, generator)), field)

    def _shown(self, stage: str, number: int) -> list[Sensor]:
        """The windows of texture `number` of a stage."""
        generator = torch.Generator().manual_seed(seed_of(self.seed, stage, number))
        if stage == "train":
            return [self.windows.training(generator)]
        zones = [self.windows.zone(share, number) for share in self.zones.values()]
        return [*zones, self.windows.anywhere(generator)]

    def _training_renderer(
        self, lens: Lens, values: Mapping[str, Tensor]
    ) -> PsfRenderer | RayRenderer:
        """Of the whole sensor."""
        if self._auto is None:
            renderer = replace(self.renderer, sensor=self.whole)
            return renderer if self._pupil is None else replace(renderer, pupil=self._pupil)
        if self._auto.choice is None:
            self._auto.prepare(lens, self.scene, values)
        return self._auto.choice.renderer

    def _looked_at(
        self, lens: Lens, values: Mapping[str, Tensor], windows: Sequence[Sensor]
    ) -> tuple[list[tuple[Tensor, Tensor]] | None, list[tuple[float, float]]]:
        """Rows and columns that windows look at, None for a pinhole's, and where their textures
        lie, to a whole texel: `texture_centre` of each.
        """
        if self.truth == "pinhole":
            centres = [(float(round(w.centre_row)), float(round(w.centre_column))) for w in windows]
            return None, centres
        looks = chief_ray_looks(lens, values, self.scene, self.whole, windows)
        return looks, [nearest_texel(rows, columns) for rows, columns in looks]

    def _truth(
        self,
        lens: Lens,
        values: Mapping[str, Tensor],
        textures: Tensor,
        windows: Sequence[Sensor],
        centres: Sequence[tuple[float, float]],
    ) -> Tensor:
        """What windows should see of textures (W, 3, h, w): (W, 3, H, W), display-encoded."""
        looks, _ = self._looked_at(lens, values, windows)
        return _seen(textures, looks, windows, centres)

    def judges(self) -> list[str]:
        """None: windows are judged by the evaluation renderer alone."""
        return []

    def point_spread_functions(
        self,
        lens: Lens,
        values: Mapping[str, Tensor],
        pupil_samples: int | None = None,
        depths: Sequence[float] | None = None,
    ) -> Tensor:
        """(zones, 3, K, K), at the middles of the zones' windows."""
        scene = self.scene if depths is None else replace(self.scene, depths=tuple(depths))
        found = []
        for share in self.zones.values():
            window = self.windows.zone(share, 0)
            renderer = PsfRenderer(
                window, (1, 1), pupil_samples or 32, self._psf_size(), jitter=False
            )
            imaging = ImagingSystem.of(lens.system(values), scene, window)
            functions = renderer.point_spread_functions(imaging, 0)
            found.append(functions.functions[0, 0])
        return torch.stack(found)

    def _psf_size(self) -> int:
        """The training renderer's window, if it has one."""
        if self._auto is not None and self._auto.choice is not None:
            return self._auto.choice.renderer.size
        return getattr(self.renderer, "size", 65)

    def spots(self, lens: Lens, rings: int, arms: int) -> list[SpotRays]:
        """Of the zones."""
        depth = self.scene.depths[0]
        (magnification,) = self.scene.magnifications(lens.system())
        half = 0.5 * math.hypot(self.whole.height, self.whole.width) * self.whole.pixel_pitch
        fields = [(0.0, share * half / magnification) for share in sorted(set(self.zones.values()))]
        wavelengths = self.scene.wavelengths
        return [gaussian_quadrature(lens, fields, wavelengths, rings, arms, depth, symmetry=False)]

    def rays(self) -> int:
        """Rays that a training window takes; 0 before a renderer is chosen."""
        renderer = self.renderer
        if self._auto is not None and self._auto.choice is not None:
            renderer = self._auto.choice.renderer
        return renderer.rays_per_image(self.scene)

    def numbers(self) -> dict[str, float]:
        """What was chosen, where it was."""
        return {} if self._auto is None else self._auto.numbers()

    def state(self) -> dict[str, Any]:
        """The pupil of training windows, or the renderer that was chosen."""
        if self._auto is not None:
            return self._auto.state()
        return {} if self._pupil is None else {"pupil": list(self._pupil)}

    def load_state(self, lens: Lens, state: Mapping[str, Any]) -> None:
        """Go on with it."""
        if self._auto is not None:
            self._auto.load_state(state)
        elif "pupil" in state:
            self._pupil = ExitPupil(*map(float, state["pupil"]))


def _seen(
    textures: Tensor,
    looks: Sequence[tuple[Tensor, Tensor]] | None,
    windows: Sequence[Sensor],
    centres: Sequence[tuple[float, float]],
) -> Tensor:
    """Textures (W, 3, h, w) where windows look, by a pinhole where it is not said where."""
    if looks is None:
        rows = zip(textures, windows, centres, strict=True)
        return linear_to_srgb(torch.stack([pinhole_image(*row) for row in rows]))
    found = [
        looked_up(texture, rows[0], columns[0], centre)
        for texture, (rows, columns), centre in zip(textures, looks, centres, strict=True)
    ]
    return linear_to_srgb(torch.stack(found))
