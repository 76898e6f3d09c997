"""Textures on windows drawn from the whole field: how a large sensor trains on a small machine."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from dolens.analysis.pupil_quadrature import SpotRays, gaussian_quadrature
from dolens.errors import InputError, check_choice
from dolens.experiments.camera.views.base import Comparison, Imaging, Shot, Views, seed_of
from dolens.experiments.camera.views.truth import (
    CENTROIDS,
    TRUTHS,
    FieldWindows,
    field_functions,
    field_imaging,
    nearest_texel,
    reference_centroid_map,
    reference_chief_ray_map,
    sample_texture,
)
from dolens.experiments.camera.views.whole import (
    ByPlace,
    Placing,
    WholePicture,
    at_depth,
    diffraction_of,
)
from dolens.optics.lens import Lens
from dolens.rendering.auto.auto_renderer import AutoRenderer
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.protocol import (
    GradientMeasure,
    Measure,
    Renderer,
    SensorWindow,
    WindowShare,
)
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.rendering.relative_illumination import IlluminationMap
from dolens.rendering.whole_field import window_side
from dolens.scene.planar import PlanarScene, pinhole_image
from dolens.scene.scene import resized
from dolens.sensor.colour import linear_to_srgb
from dolens.sensor.noise import BatchShare, generator_of
from dolens.sensor.pixels import Sensor
from dolens.sensor.readout import Readout

EVERYWHERE = "field"
# Pixels along each side of point spread functions, where the training renderer has none.
_PSF_SIZE = 65
# Functions along each side of a whole sensor, at most; strata of the pupil, likewise, of rays.
_MOST_FIELDS, _RAYS = 17, 10
# Windows that are drawn to find how many lie near each zone.
_DRAWN = 1000


class FieldViews(Imaging):
    """Each texture on a window of a large sensor, imaged as it is there.

    Training windows are drawn from the whole field.  Every evaluation texture is imaged in zones:
    windows at fractions of the half diagonal, at azimuths that go around from texture to texture,
    and one drawn evenly from the whole field, `field`.

    With `truth` "chief_rays" the truth is the texture where the chief rays of the reference
    wavelength look: distortion, which a camera's calibration undoes, is part of it, and lateral
    colour is not.  It moves with the lens as the image does, and both carry the derivative.  With
    "centroids" each window's truth is moved by the centroid of its spot besides, which coma puts
    beside the chief ray: a calibration by images undoes that too.  With "pinhole" it is what a
    distortion-free pinhole sees, and distortion is an error.

    Args:
        scene: one depth, and wavelengths.
        sensor: the whole of it.
        renderer: makes the training images; its sensor says how large windows are, and the zones
            are those that it may be planned for.
        readout: what the sensor makes of them.
        evaluation_renderer: makes the validation and test images; None: the training renderer.
        zones: fractions of the half diagonal, by name.
        training_windows: `circle`: drawn evenly from the area of the circle about the sensor, so
            that the edge of the field counts by its area; `radius`: evenly from the distances to
            the middle; `area`: from the sensor, of which corners are a small part.
        truth: `chief_rays`, `centroids` or `pinhole`.
        seed: of windows, rendering and noise.

    Raises:
        InputError: several depths, a window larger than the sensor, or other pixels.
    """

    keeps_pupil = True
    psf_place = "at shares of the sensor's half diagonal"
    view_is_known = True

    def __init__(
        self,
        scene: PlanarScene,
        sensor: Sensor,
        renderer: Renderer,
        readout: Readout,
        evaluation_renderer: Renderer | None = None,
        zones: Mapping[str, float] | None = None,
        training_windows: str = "circle",
        truth: str = "chief_rays",
        seed: int = 0,
    ) -> None:
        super().__init__(scene, renderer, readout, seed)
        check_choice(truth, (*TRUTHS, CENTROIDS), "views.truth")
        self.truth = truth
        self.whole = sensor
        self.zones = dict(zones or {"axis": 0.0, "0.5": 0.5, "0.7": 0.7, "full": 1.0})
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
        places = {name: self.windows.zone(share, 0) for name, share in self.zones.items()}
        self._training = renderer.for_windows(sensor, places)
        self.evaluation_renderer = self._training
        if evaluation_renderer is not None:
            self.evaluation_renderer = evaluation_renderer.for_windows(sensor, places)

    @property
    def image_sensor(self) -> Sensor:
        """The whole sensor."""
        return self.whole

    def field_shares(self) -> list[float]:
        """Return the zones."""
        return sorted(set(self.zones.values()))

    def labels(self) -> list[str]:
        """The zones, and the whole field."""
        return [*self.zones, EVERYWHERE]

    def psf_labels(self) -> list[str]:
        """The zones."""
        return list(self.zones)

    def _measure(self, lens: Lens, comparison: Comparison) -> Measure:
        """The training's loss as a function of windows' images of textures."""

        def of_windows(windows: Sequence[SensorWindow]) -> GradientMeasure:
            def loss(image: Tensor, textures: Tensor, values: Mapping[str, Tensor]) -> Tensor:
                raw = self._raw(image.to(lens.dtype), self.seed)
                textures = textures.to(raw)
                now, sensors = lens.with_values(values), [w.sensor for w in windows]
                object_points, _ = self._chief_ray_points(now, sensors)
                truth = _sampled(textures, object_points, windows)[:, None]
                field = torch.stack([self.windows.coordinates(w.sensor, textures) for w in windows])
                return comparison.loss(Views(truth, raw, field[:, None]), values)

            return GradientMeasure(comparison.variables, comparison.values, loss)

        return of_windows

    def take(self, lens: Lens, shot: Shot) -> Views:
        """Image textures (B, 3, h, w): one window each in training, one a zone otherwise."""
        textures, stage, index, _, share = shot
        seed, count = shot.seed(self.seed), len(textures)
        share = share or BatchShare(0, count)
        everywhere = [self._shown(stage, index * share.total + i) for i in range(share.total)]
        rows = everywhere[share.first : share.first + count]
        sensors = [window for row in rows for window in row]
        repeated = textures.repeat_interleave(len(rows[0]), dim=0)
        object_points, centres = self._chief_ray_points(lens, sensors)
        windows = [SensorWindow(*pair) for pair in zip(sensors, centres, strict=True)]
        truth = _sampled(repeated, object_points, windows)
        renderer = self._training if stage == "train" else self.evaluation_renderer
        if share.total == count:
            image = renderer.render_windows(lens, self.scene, repeated, windows, seed)
        else:
            whole = [window for row in everywhere for window in row]
            part = WindowShare(share.first * len(rows[0]), whole)
            image = renderer.render_share(lens, self.scene, repeated, windows, seed, part)
        field = torch.stack([self.windows.coordinates(window, textures) for window in sensors])
        truth, image, field = (
            t.unflatten(0, (count, len(rows[0]))) for t in (truth, image[:, 0], field)
        )
        return Views(truth, self._raw(image, seed, share), field)

    def _shown(self, stage: str, number: int) -> list[Sensor]:
        """The windows of texture `number` of a stage."""
        generator = generator_of(seed_of(self.seed, stage, number))
        if stage == "train":
            return [self.windows.training(generator)]
        zones = [self.windows.zone(share, number) for share in self.zones.values()]
        return [*zones, self.windows.anywhere(generator)]

    def _chief_ray_points(
        self, lens: Lens, windows: Sequence[Sensor]
    ) -> tuple[list[tuple[Tensor, Tensor]] | None, list[tuple[float, float]]]:
        """Return the object points of windows (rows and columns; None for a pinhole's), and where
        their textures lie, to a whole texel: `texture_centre` of each.
        """
        if self.truth == "pinhole":
            centres = [(float(round(w.centre_row)), float(round(w.centre_column))) for w in windows]
            return None, centres
        of_windows = reference_centroid_map if self.truth == CENTROIDS else reference_chief_ray_map
        object_points = of_windows(lens, self.scene, self.whole, windows)
        return object_points, [nearest_texel(rows, columns) for rows, columns in object_points]

    @property
    def psf_size(self) -> int:
        """Pixels along each side of point spread functions."""
        return self._training.psf_size or _PSF_SIZE

    def point_spread_functions(
        self,
        lens: Lens,
        pupil_samples: int | None = None,
        depths: Sequence[float] | None = None,
        size: int | None = None,
    ) -> Tensor:
        """(zones, 3, K, K), at the middles of the zones' windows."""
        scene = self.scene if depths is None else replace(self.scene, depths=tuple(depths))
        found = []
        for share in self.zones.values():
            window = self.windows.zone(share, 0)
            side = size or self.psf_size
            renderer = PsfRenderer(window, (1, 1), pupil_samples or 32, side, jitter=False)
            imaging = ImagingSystem.of(lens.system(), scene, window)
            functions = renderer.point_spread_functions(imaging, 0)
            found.append(functions.functions[0, 0])
        return torch.stack(found)

    def functions_of_images(self, lens: Lens, taken: Views, stage: str) -> Tensor:
        """Return the functions of the windows' middles; see `Imaging.functions_of_images`."""
        assert taken.field is not None  # of these views
        middles = taken.field.double().mean((-2, -1)).flatten(0, 1) * self.windows.half_diagonal
        renderer = self._training if stage == "train" else self.evaluation_renderer
        found = field_functions(
            lens,
            self.scene,
            self.whole,
            (middles[:, 0], middles[:, 1]),
            self.truth,
            self.psf_size,
            diffraction_of(renderer),
        )
        return found.functions * found.light[:, None, :, None, None]

    def by_place(
        self,
        lens: Lens,
        size: tuple[int, int],
        placing: Placing | None = None,
    ) -> ByPlace:
        """Return functions and illumination about the middle of the sensor; see `Imaging`."""
        sensor = Sensor(*size, self.whole.pixel_pitch)
        scene = self.scene if placing is None else at_depth(self.scene, placing.depth, lens)
        diffraction = placing.diffraction if placing else None
        diffraction = diffraction or diffraction_of(self.evaluation_renderer)

        @torch.no_grad()
        def functions(rows: Tensor, columns: Tensor) -> Tensor:
            x, y = (p.to(lens.device) for p in sensor.positions(rows.double(), columns.double()))
            settings = (self.truth, self.psf_size, diffraction)
            return field_functions(lens, scene, self.whole, (x, y), *settings).functions

        illumination = IlluminationMap.of(field_imaging(lens, scene, self.whole).on(sensor))
        return ByPlace(functions, illumination, window_side(functions, sensor, self.psf_size))

    @torch.no_grad()
    def whole_picture(self, lens: Lens, picture: Tensor, placing: Placing) -> WholePicture:
        """Image a picture that fills the sensor, as large as it fits on it, with the blur of each
        place in the field.
        """
        lengths = picture.shape[-2:]
        scale = placing.scale or max(lengths[0] / self.whole.height, lengths[1] / self.whole.width)
        height, width = (max(1, round(length / scale)) for length in lengths)
        if height > self.whole.height or width > self.whole.width:
            raise InputError(
                f"--scale: {scale:g} makes the picture {width}×{height} pixels, larger than the "
                f"sensor, {self.whole.width}×{self.whole.height}"
            )
        picture = resized(picture, height, width).to(lens.device)
        sensor = Sensor(height, width, self.whole.pixel_pitch)
        scene = at_depth(self.scene, placing.depth, lens)
        renderer = self._of_whole(sensor, placing.diffraction)
        image = renderer.render(lens, scene, picture[None], placing.seed)[:, 0]
        truth = linear_to_srgb(picture)
        if self.truth != "pinhole":
            # The distortion is part of the truth, as it is in training.
            ((rows, columns),) = reference_chief_ray_map(lens, scene, self.whole, [sensor])
            truth = linear_to_srgb(sample_texture(picture, rows[0], columns[0], (0.0, 0.0)))
        mapping = (
            f"{scale:.3g} pixel(s) of the picture to one of the sensor, {width}×{height} of "
            f"{self.whole.width}×{self.whole.height} pixels of "
            f"{1000.0 * self.whole.pixel_pitch:g} µm; the blur of each place in the field (by "
            f"{'rays' if renderer.monte_carlo else 'point spread functions'}, diffraction: "
            f"{diffraction_of(renderer)})"
        )
        field = self.field_of(height, width)[None].to(image)
        return WholePicture(truth[None], image, field, mapping)

    def field_of(self, height: int, width: int) -> Tensor:
        """The places of an image's pixels on the sensor; see `Imaging.field_of`."""
        if height > self.whole.height or width > self.whole.width:
            raise InputError(
                f"an image of {width}×{height} pixels is larger than the sensor, "
                f"{self.whole.width}×{self.whole.height}"
            )
        sensor = Sensor(height, width, self.whole.pixel_pitch)
        return self.windows.coordinates(sensor, torch.zeros(()))

    def _of_whole(self, sensor: Sensor, diffraction: str | None) -> Renderer:
        """Return what makes test images, for a whole sensor."""
        renderer = self.evaluation_renderer
        if isinstance(renderer, AutoRenderer):
            choice = renderer.choice
            renderer = RayRenderer(sensor, _RAYS) if choice is None else choice.renderer
        if diffraction not in (None, diffraction_of(renderer)) and not isinstance(
            renderer, PsfRenderer
        ):
            renderer = PsfRenderer(sensor, (2, 2), size=self.psf_size, jitter=False)
        if isinstance(renderer, PsfRenderer):
            # As many functions for a stretch of the sensor as a window has, but no fewer than two.
            fields = [
                min(_MOST_FIELDS, max(2, math.ceil(length / own * (max(count, 2) - 1)) + 1))
                for length, own, count in zip(
                    (sensor.height, sensor.width),
                    (self.windows.height, self.windows.width),
                    renderer.fields,
                    strict=True,
                )
            ]
            kind = diffraction or renderer.diffraction
            renderer = replace(renderer, fields=tuple(fields), pupil=None, diffraction=kind)
        return renderer.on(sensor)

    def spots(self, lens: Lens, rings: int, arms: int) -> list[SpotRays]:
        """Return the spots of the zones."""
        depth = self.scene.depths[0]
        (magnification,) = self.scene.magnifications(lens.system())
        half = self.windows.half_diagonal
        fields = [(0.0, share * half / magnification) for share in sorted(set(self.zones.values()))]
        wavelengths = self.scene.wavelengths
        return [gaussian_quadrature(lens, fields, wavelengths, rings, arms, depth, symmetry=False)]

    def spot_weights(self, fields: int) -> list[float]:
        """Return the share of training windows that are nearest to each of the zones' radii."""
        shares = sorted(set(self.zones.values()))
        half = self.windows.half_diagonal
        generator, counts = generator_of(0), [0] * len(shares)
        for _ in range(_DRAWN):
            window = self.windows.training(generator)
            middle = 0.5 * (window.height - 1), 0.5 * (window.width - 1)
            x, y = window.positions(*(torch.tensor(m, dtype=torch.float64) for m in middle))
            share = math.hypot(float(x), float(y)) / half
            nearest = min(range(len(shares)), key=lambda n: abs(shares[n] - share))
            counts[nearest] += 1
        return [count / _DRAWN for count in counts]


def _sampled(
    textures: Tensor,
    object_points: Sequence[tuple[Tensor, Tensor]] | None,
    windows: Sequence[SensorWindow],
) -> Tensor:
    """Return textures (W, 3, h, w) at the object points of windows, a pinhole's where None."""
    if object_points is None:
        found = [
            pinhole_image(texture, window.sensor, window.texture_centre)
            for texture, window in zip(textures, windows, strict=True)
        ]
        return linear_to_srgb(torch.stack(found))
    found = [
        sample_texture(texture, rows[0], columns[0], window.texture_centre)
        for texture, (rows, columns), window in zip(textures, object_points, windows, strict=True)
    ]
    return linear_to_srgb(torch.stack(found))
