"""A lens photographs a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from dolens.views.overview import as_lens

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from dolens.optics.lens import Lens
    from dolens.rendering.photograph import Photograph
    from dolens.rendering.stokes_images import StokesPhotograph

_FROM_PICTURE = "from picture"


class PhotographViews:
    """Methods of `Lens` that photograph."""

    def with_iris(self, blades: int, angle: float = 0.0, f_number: float | None = None) -> Lens:
        """Return a copy of this lens whose stop has an iris of straight blades, their corners on
        its circle.

        Args:
            blades: how many, 3 to 100.
            angle: of the first corner, degrees from +x towards +y.
            f_number: of the circle; None: as it is.

        Raises:
            InputError: a number out of range, or a stop that is no circle.
        """
        from dolens.prescriptions.apertures import with_iris

        return with_iris(as_lens(self), blades, angle, f_number)

    def photograph(
        self,
        picture: str | Path | np.ndarray | Tensor,
        distance: float | None = None,
        light: float | None = 100.0,
        *,
        read_noise: float = 3.0,
        pattern: str | None = None,
        sensor: tuple[float, float] | None = None,
        pixel_pitch: float | None = None,
        diffraction: str | None = None,
        seed: int = 0,
        lights: Sequence[Sequence[float]] | str | None = None,
        sensor_reflectance: float = 0.0,
        bounces: int = 2,
    ) -> Photograph:
        """Return what a sensor behind the lens sees of a picture, which is a plane before it.

        The picture fills the sensor.  Each place has the blur of its own, with distortion, lateral
        colour, relative illumination and diffraction.  Red, green and blue are the longest, the
        reference and the shortest wavelength of the lens.  `dolens.restore` restores what it gives.

        512×512 pixels take about a second of one core, and five to twenty where blur is hundreds of
        pixels wide; the first call of a session takes three more.  The pictures take about 110
        bytes a pixel.

        >>> import torch
        >>> lens = dolens.load_lens("cooke_triplet")
        >>> picture = torch.rand(3, 48, 64)  # or a path
        >>> photo = lens.photograph(picture, distance=2000, light=1000)
        >>> photo.image.shape, photo.distance
        (torch.Size([3, 48, 64]), 2000.0)
        >>> photo.noise  # variance 0.001·light + 0.000009
        (0.001, 9e-06)

        Args:
            picture: a file, an array (H, W, 3) or (H, W), or a tensor (3, H, W) or (H, W), of sRGB
                values: uint8, uint16, or fractions from 0 to 1.
            distance: mm in front of the first vertex, `inf` for infinity; None: the lens's own
                object distance.
            light: electrons of a white pixel on the axis; None: no noise at all.

        Rarely needed:
            read_noise: electrons, standard deviation.
            pattern: of colour filters in front of the pixels, as `RGGB`; None: each pixel sees all
                three colours.
            sensor: its width and height, mm; None: the largest of the picture's shape in the image
                circle.
            pixel_pitch: mm; None: a pixel of the picture is one of the sensor.
            diffraction: `none`, `limit` or `wave`; None: where it shows, by the model it needs.
            seed: of the noise.
            lights: points that are brighter than white by far, each a row and a column of the
                picture and its power over that of a white pixel, one number or three; with their
                starbursts where these show and `diffraction` is not `none`, with their ghosts, and
                the veil of the scene's own (see `dolens.rendering.stray_light`).  An empty list:
                the veil alone; None: no stray light.  `from picture`: those of a picture that
                holds radiance over white (see `dolens.rendering.scene_lights`): a file of Radiance,
                or floating-point numbers, which are linear light then, 1 for white.
            sensor_reflectance: share of the light that the sensor reflects, for ghosts.
            bounces: most reflections of a ghost's path, 2, 4 or 6, which take ever longer.

        Returns:
            A `Photograph`: `image` and `truth` (3, H, W), sRGB; `save(path)`; it shows itself in a
            notebook.

        Raises:
            InputError: the picture cannot be read; a number out of range; or a lens that has no
                image circle, sees too wide a field for a plane, or that renderers refuse.
        """
        from dolens.errors import InputError
        from dolens.rendering.lens_camera import required_number, sensor_behind
        from dolens.rendering.photograph import LensCamera, StrayLight, readout_in
        from dolens.rendering.scene_lights import lights_in
        from dolens.rendering.stray_light import lights_of
        from dolens.sensor.display import linear_picture
        from dolens.sensor.radiance import radiance_picture

        lens = as_lens(self)
        distances = (
            []
            if distance is None
            else [required_number("distance", distance, math.inf, "mm, or infinity")]
        )
        if not isinstance(seed, int) or not 0 <= seed < 2**63:
            raise InputError(f"seed: {seed}; allowed: whole numbers from 0 to 2^63 - 1")
        readout = readout_in(light, read_noise, pattern)
        if isinstance(lights, str) and lights != _FROM_PICTURE:
            raise InputError(f"lights: {lights!r}; allowed: a list, or {_FROM_PICTURE!r}")
        linear = (radiance_picture if lights == _FROM_PICTURE else linear_picture)(picture)
        height, width = linear.shape[-2:]
        pixels = sensor_behind(lens, (height, width), sensor, pixel_pitch)
        camera = LensCamera.of(lens, pixels, readout, distances, diffraction)
        if lights is not None:
            share = required_number(
                "sensor_reflectance", sensor_reflectance, 1.0, "of the light", from_zero=True
            )
            if isinstance(lights, str):
                linear, found = lights_in(linear, pixels, camera.field.cover())
            else:
                found = lights_of(lights, (height, width), pixels, camera.field.cover())
            stray = StrayLight(lens, tuple(found), share, diffraction != "none", bounces)
            camera = replace(camera, stray_light=stray)
        return next(camera.photographs(linear, seed))

    def photograph_polarised(
        self,
        scene: Tensor,
        distance: float | None = None,
        light: float | None = 1000.0,
        *,
        read_noise: float = 3.0,
        sensor: tuple[float, float] | None = None,
        pixel_pitch: float | None = None,
        seed: int = 0,
    ) -> StokesPhotograph:
        """Return what a sensor with polarisers at 0, 45, 90 and 135 degrees sees of a polarised
        scene behind the lens, which changes polarisation where its surfaces have coatings or are
        bare; see `dolens.rendering.stokes_images`.

        Args:
            scene: (4, 3, h, w) or (4, h, w), Stokes vectors in linear light; S₀ is 1 for white.
            distance: see `photograph`, as the other arguments that are not named here.
            light: electrons of a white, unpolarised pixel without a polariser; None: no noise.
            read_noise: see `photograph`.
            sensor: see `photograph`.
            pixel_pitch: see `photograph`.
            seed: see `photograph`.

        Returns:
            A `StokesPhotograph`: Stokes vectors before and behind the lens, what the sensor gives
            and what it makes of it; `figure()` shows them.

        Raises:
            InputError: as `photograph`; more polarised than fully, or a coating that is a table of
                shares.
        """
        from dolens.rendering.lens_camera import required_number, sensor_behind
        from dolens.rendering.photograph import LensCamera, readout_in
        from dolens.rendering.stokes_images import check_stokes, stokes_photograph

        lens = as_lens(self)
        scene = scene[:, None].expand(-1, 3, -1, -1) if scene.ndim == 3 else scene
        check_stokes(scene)
        distances = (
            []
            if distance is None
            else [required_number("distance", distance, math.inf, "mm, or infinity")]
        )
        height, width = scene.shape[-2:]
        pixels = sensor_behind(lens, (height, width), sensor, pixel_pitch)
        camera = LensCamera.of(lens, pixels, readout_in(light, read_noise), distances)
        return stokes_photograph(lens, camera, scene, seed)
