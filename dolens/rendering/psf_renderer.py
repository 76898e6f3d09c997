"""Rendering by point spread functions on a grid of fields, convolved in overlapping patches."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from dolens.diffraction.pixel_psf import with_diffraction_limit
from dolens.errors import InputError, check_choice
from dolens.optics.lens import Lens
from dolens.optics.ray_tracing import cpu_kernels_serve, say_once, with_chosen_backend
from dolens.rendering.chief_ray_map import chief_ray_maps
from dolens.rendering.differentiable_geometry import differentiable_exit_pupil
from dolens.rendering.exit_pupil import ExitPupil, sampled_exit_pupil, working_f_number
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.patch_convolution import (
    Coordinates,
    PatchLayout,
    convolve_patches,
    node_positions,
    patches,
)
from dolens.rendering.protocol import Renderer, SensorWindow, WindowShare
from dolens.rendering.psf_grid import (
    FieldPointSpreadFunctions,
    PointShare,
    field_point_spread_functions,
    wave_point_spread_functions,
)
from dolens.rendering.relative_illumination import relative_illumination
from dolens.scene.planar import PlanarScene, as_planes
from dolens.scene.scene import Scene, texture_origin
from dolens.sensor.pixels import Sensor

logger = logging.getLogger(__name__)

# A window that loses more of a function's light than this is worth a warning.
_NOTABLE_LOSS = 0.01


@dataclass(frozen=True)
class PsfRenderer(Renderer):
    """Point spread functions at a grid of sensor points, linear in between, convolved by FFT.

    It renders what `RayRenderer` does, with distortion, lateral colour and relative illumination.
    Three things are approximate: between the grid's points functions are interpolated; the pupil is
    sampled once for all pixels that share a function; and where distortion moves pixels by
    fractions of a texel, functions a few pixels wide are resampled by splines, which costs up to
    0.4 grey levels (of 255) on photographs, and nothing where the lens is sharp or very blurred.

    Attributes:
        sensor: the pixels.
        fields: rows and columns of the grid; (1, 1) is one function for all pixels.
        pupil_samples: strata along each side of the pupil, for each function.
        size: pixels along each side of a function, odd; light beyond is lost, or even within where
            a diffractive element's other orders put it there, and warned of.
        registration: `chief_rays`: functions are centred on the lens's own, distorted image points,
            and pixels look there; `pinhole`: on the undistorted ones, and shifts are part of the
            functions, which is cheaper, and exact where shifts change little between fields;
            `centred`: functions are centred on the lens's own image points and pixels look as in a
            pinhole: distortion, and what a decentred lens shifts the image by, are left out.
        illumination: `map`: relative illumination is found on a finer grid than the functions, so
            that only their shape is interpolated; `functions`: it is as they have it.
        depths: `each` has functions of its own, or `one`, the middle in vergence, serves all.
        colours: `each` wavelength has functions of its own, or `one`, the middle, serves all.
        diffraction: `none`: geometric functions; `limit`: these blurred by a perfect pupil's
            diffraction; `orders`: the same, with light in all orders of diffractive elements;
            `wave`: functions of the pupil's wavefront.
        band: nm from each of the scene's wavelengths, whose light a colour has in equal parts, with
            diffraction `wave`; (0,) is the scene's wavelength alone.
        pupil: the disc that is sampled; None looks for it at each render, for the lens as it is.
        jitter: draw points in the pupil's strata anew for each seed, or take their centres.
    """

    sensor: Sensor
    fields: tuple[int, int] = (3, 3)
    pupil_samples: int = 32
    size: int = 65
    registration: Literal["chief_rays", "centred", "pinhole"] = "chief_rays"
    illumination: Literal["map", "functions"] = "map"
    depths: Literal["each", "one"] = "each"
    colours: Literal["each", "one"] = "each"
    jitter: bool = True
    diffraction: Literal["none", "limit", "orders", "wave"] = "none"
    pupil: ExitPupil | None = None
    band: tuple[float, ...] = (0.0,)

    model: ClassVar[str] = "psf"

    def __post_init__(self) -> None:
        object.__setattr__(self, "fields", tuple(int(n) for n in self.fields))
        object.__setattr__(self, "band", tuple(float(n) for n in self.band))
        if self.pupil is not None:
            object.__setattr__(self, "pupil", ExitPupil(*map(float, self.pupil)))
        if len(self.fields) != 2 or min(self.fields) < 1:
            raise InputError(f"renderer: fields must be rows and columns, not {self.fields}")
        if self.size < 3 or self.size % 2 == 0:
            raise InputError(f"renderer: size must be odd and at least 3, not {self.size}")
        if self.pupil_samples < 1:
            raise InputError("renderer: pupil_samples must be at least 1")
        if not self.band or (self.diffraction != "wave" and self.band != (0.0,)):
            raise InputError(
                f"renderer: band {list(self.band)}; allowed: nm from each wavelength, [0.0] where "
                "diffraction is not wave"
            )
        for key, allowed in (
            ("registration", ("chief_rays", "centred", "pinhole")),
            ("illumination", ("map", "functions")),
            ("depths", ("each", "one")),
            ("colours", ("each", "one")),
            ("diffraction", ("none", "limit", "orders", "wave")),
        ):
            check_choice(getattr(self, key), allowed, f"renderer: {key}")

    @property
    def psf_size(self) -> int:
        """Pixels along each side of a function."""
        return self.size

    def rays_per_image(self, scene: Scene, sensor: Sensor | None = None) -> int:
        """Rays traced for the functions of one render, where the lens has no symmetry."""
        channels = len(scene.wavelengths) if self.colours == "each" else 1
        return self.fields[0] * self.fields[1] * self.pupil_samples**2 * channels

    def render(
        self,
        lens: Lens,
        scene: Scene,
        textures: Tensor,
        seed: int,
    ) -> Tensor:
        """Image textures as a scene shows them; see `Renderer.render`.

        The seed is of the points in the pupil's strata.
        """
        whole = SensorWindow(self.sensor, scene.texture_centre)
        (image,) = self._render(lens, scene, [(whole, textures)], seed)
        return image

    def render_windows(
        self,
        lens: Lens,
        scene: Scene,
        textures: Tensor,
        windows: Sequence[SensorWindow],
        seed: int,
    ) -> Tensor:
        """Image each texture on a window of its own, all at once; see `Renderer.render_windows`.

        Rays of all windows are traced together, through a pupil that serves the whole sensor, and
        one set of polynomials gives the object points of all windows.
        """
        shown = [(window, texture[None]) for window, texture in zip(windows, textures, strict=True)]
        return torch.cat(self._render(lens, scene, shown, seed))

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
        shown = [(window, texture[None]) for window, texture in zip(windows, textures, strict=True)]
        return torch.cat(self._render(lens, scene, shown, seed, share))

    def _render(
        self,
        lens: Lens,
        scene: Scene,
        shown: Sequence[tuple[SensorWindow, Tensor]],
        seed: int,
        share: WindowShare | None = None,
    ) -> list[Tensor]:
        """Images (B, images, C, height, width) of windows of the sensor and textures that are shown
        to each, all rays traced at once.
        """
        options: dict[str, Any] = {"device": lens.device, "dtype": lens.dtype}
        textures = [texture.to(**options) for _, texture in shown]
        windows = [window.sensor for window, _ in shown]
        system = with_chosen_backend(lens.system(), textures)
        with torch.no_grad():
            scene.check(system)
            pupil = self.pupil
            if pupil is None:
                pupil = sampled_exit_pupil(system, scene.wavelengths, self.sensor)
        pupil = differentiable_exit_pupil(system, scene.wavelengths, pupil)
        imaging = ImagingSystem(system, scene, self.sensor, pupil)
        parts = [self.on(window) for window in windows]
        points, among = self._points_of(windows), None
        if share is not None:
            nodes = self.fields[0] * self.fields[1]
            among = PointShare(share.first * nodes, self._points_of(share.windows))
        found = self.point_spread_functions(imaging, seed, points, among)
        self._warn_of_loss(found)
        object_points: list[Any] = [None] * len(windows)
        if self.registration == "chief_rays":
            object_points = chief_ray_maps(imaging, windows)
        nodes, images = self.fields[0] * self.fields[1], []
        for i, (part, points) in enumerate(zip(parts, object_points, strict=True)):
            own = slice(i * nodes, (i + 1) * nodes)
            functions = found._replace(functions=found.functions[own], light=found.light[own])
            placed = replace(scene, texture_centre=shown[i][0].texture_centre)
            seen = replace(imaging, scene=placed, sensor=part.sensor)
            images.append(part._blurred(seen, textures[i], functions, points))
        return images

    def _blurred(
        self,
        imaging: ImagingSystem,
        textures: Tensor,
        found: FieldPointSpreadFunctions,
        object_points: tuple[Tensor, Tensor] | None,
    ) -> Tensor:
        """Render by known point spread functions.

        `object_points` are those of the chief rays, None for a pinhole's.
        """
        scene, area = imaging.scene, (self.sensor.height, self.sensor.width)
        size = (textures.shape[-2], textures.shape[-1])
        layout = PatchLayout(
            patches(*area, *self.fields, textures),
            area,
            *places_in_texture(imaging, size, object_points),
            cpu_kernels_serve(imaging.system),
        )
        blur = PlaneBlur(found.functions, layout)
        if self.illumination == "map":
            wanted = relative_illumination(imaging.showing(self.shared(scene)))
            blur = blur.illuminated(found.light, wanted)
        return scene.blend(scene.on_planes(textures), blur)

    def _warn_of_loss(self, found: FieldPointSpreadFunctions) -> None:
        if float(found.truncated) > _NOTABLE_LOSS:
            haze = self.diffraction in ("orders", "wave")
            made = "says where, not evenly within them" if haze else "keeps it"
            say_once(
                f"renderer psf: {100 * float(found.truncated):.0f} % of a function's light falls "
                f"beyond its {self.size} pixels; a larger renderer.size {made}"
            )

    def point_spread_functions(
        self,
        imaging: ImagingSystem,
        seed: int,
        points: tuple[Tensor, Tensor] | None = None,
        among: PointShare | None = None,
    ) -> FieldPointSpreadFunctions:
        """The functions at the grid's points, row after row, or at others; differentiable.

        Args:
            imaging: the lens, its pupil, and the scene with all its depths and wavelengths.
            seed: of the points in the pupil's strata.
            points: x and y on the sensor, mm, each (N,), double precision; None: the grid's.
            among: all points by which samples are numbered, where these are a part of them.
        """
        imaging = imaging.showing(self.shared(imaging.scene))
        points = points or self.points()
        centred = self.registration != "pinhole"
        if self.diffraction == "wave":
            return wave_point_spread_functions(imaging, points, self.size, centred, band=self.band)
        found = field_point_spread_functions(
            imaging,
            points,
            self.size,
            self.pupil_samples,
            seed if self.jitter else None,
            centred,
            among,
            self.diffraction == "orders",
        )
        if self.diffraction == "none":
            return found
        f_number = working_f_number(imaging.pupil, imaging.system.vertices[-1])
        blurred = with_diffraction_limit(
            found.functions, self.sensor.pixel_pitch, imaging.scene.wavelengths, f_number
        )
        return found._replace(functions=blurred)

    def with_pupil(self, lens: Lens, scene: Scene) -> "PsfRenderer":
        """The renderer with the pupil of the lens as it is, for a lens that hardly changes."""
        system = lens.system()
        return replace(self, pupil=sampled_exit_pupil(system, scene.wavelengths, self.sensor))

    def without_diffraction(self) -> "PsfRenderer":
        """The renderer with geometric functions."""
        return replace(self, diffraction="none", band=(0.0,))

    def state(self) -> dict[str, Any]:
        """The pupil that it keeps, where it keeps one."""
        return {} if self.pupil is None else {"pupil": list(self.pupil)}

    def load_state(self, lens: Lens, state: Mapping[str, Any]) -> "PsfRenderer":
        """The renderer with the pupil that was kept."""
        return replace(self, pupil=ExitPupil(*state["pupil"])) if "pupil" in state else self

    def _points_of(self, windows: Sequence[Sensor]) -> tuple[Tensor, Tensor]:
        """x and y of the grids on windows, one after the other, each (windows · fields,)."""
        grids = [self.on(window).points() for window in windows]
        x, y = (torch.cat(coordinate) for coordinate in zip(*grids, strict=True))
        return x, y

    def points(self) -> tuple[Tensor, Tensor]:
        """x and y of the grid on the sensor, mm, each (fields,), double precision."""
        rows = node_positions(self.sensor.height, self.fields[0])
        columns = node_positions(self.sensor.width, self.fields[1])
        row, column = torch.meshgrid(
            torch.tensor(rows, dtype=torch.float64),
            torch.tensor(columns, dtype=torch.float64),
            indexing="ij",
        )
        return self.sensor.positions(row.reshape(-1), column.reshape(-1))

    def shared(self, scene: Scene) -> PlanarScene:
        """The scene of the depths and wavelengths that have functions of their own."""
        depths = (scene.middle_depth,) if self.depths == "one" else scene.depths
        wavelengths = (scene.middle_wavelength,) if self.colours == "one" else scene.wavelengths
        return as_planes(scene, depths, wavelengths)


@dataclass(frozen=True)
class PlaneBlur:
    """Convolution of planes with a lens's kernels, a scene's `Blur`.

    Attributes:
        kernels: (N, D or 1, C or 1, K, K), differentiable.
        layout: N patches, and the object points of their pixels.
        illumination: (C or 1, height, width), what the image of every plane is multiplied by; or
            None.
    """

    kernels: Tensor
    layout: PatchLayout
    illumination: Tensor | None = None

    def __call__(self, maps: Tensor) -> Tensor:
        """(B, D, C, height, width) of maps (B, D or 1, C or 1, H, W)."""
        image = convolve_patches(maps, self.kernels, self.layout)
        return image if self.illumination is None else image * self.illumination

    def white(self) -> Tensor:
        """Return the blurred maps of ones, (D or 1, C or 1, height, width)."""
        image = uniform_image(self.kernels, self.layout)
        return image if self.illumination is None else image * self.illumination

    def illuminated(self, light: Tensor, wanted: Tensor) -> "PlaneBlur":
        """The same with kernels of unit light, and a relative illumination found otherwise.

        Pixels whose kernels are partly dark get their light from the others.

        Args:
            light: (N, C or 1), of each node's kernels.
            wanted: (C or 1, height, width), of each pixel.
        """
        bright = light.detach() > 0.0
        light = torch.where(bright, light, 1.0)
        covered, lit = torch.zeros_like(wanted), []
        for patch, some in zip(self.layout.patches, bright[..., None, None], strict=True):
            share = torch.where(some, patch.weight, 0.0)
            covered[:, patch.top : patch.bottom, patch.left : patch.right] += share
            lit.append(patch._replace(weight=share))
        scale = wanted / torch.where(covered > 0.0, covered, 1.0)
        kernels = self.kernels / light[:, None, :, None, None]
        return PlaneBlur(kernels, replace(self.layout, patches=lit), scale)


def places_in_texture(
    imaging: ImagingSystem, size: tuple[int, int], object_points: tuple[Tensor, Tensor] | None
) -> tuple[tuple[int, int], Coordinates | None]:
    """Find the object points of a sensor's pixels in a texture.

    Args:
        imaging: the sensor, and the scene that says where the texture's centre lies.
        size: height and width of the texture.
        object_points: rows and columns where the pixels' chief rays meet the planes, each
            (D, C, height, width); None: where a pinhole sees them.

    Returns:
        Row and column of the object point of pixel (0, 0), where the others follow texel by texel,
        and None; else (0, 0) and the coordinates of all pixels.
    """
    scene, sensor = imaging.scene, imaging.sensor
    row, column = texture_origin(size, scene.texture_centre)
    if object_points is not None:
        down, across = object_points
        return (0, 0), Coordinates(down + row, across + column)
    top = row - (0.5 * (sensor.height - 1) - sensor.centre_row)
    left = column - (0.5 * (sensor.width - 1) - sensor.centre_column)
    if top.is_integer() and left.is_integer():
        return (int(top), int(left)), None
    options: dict[str, Any] = {"dtype": torch.float64, "device": imaging.system.device}
    rows, columns = torch.meshgrid(
        torch.arange(sensor.height, **options),
        torch.arange(sensor.width, **options),
        indexing="ij",
    )
    shape = (len(scene.depths), len(scene.wavelengths), sensor.height, sensor.width)
    return (0, 0), Coordinates((rows + top).expand(shape), (columns + left).expand(shape))


def uniform_image(kernels: Tensor, layout: PatchLayout) -> Tensor:
    """Compute what `convolve_patches` makes of ones: Σ over nodes of weight · Σ kernel.

    Args:
        kernels: (N, D or 1, C or 1, K, K).
        layout: N patches, all with or all without weights for each channel.

    Returns:
        (D or 1, C or 1, height, width).
    """
    sums = kernels.sum((-2, -1))[..., None, None]
    channels = max(
        [sums.shape[2], *(p.weight.shape[0] for p in layout.patches if p.weight.dim() > 2)]
    )
    image = sums.new_zeros((sums.shape[1], channels, *layout.image_size))
    for total, patch in zip(sums, layout.patches, strict=True):
        image[..., patch.top : patch.bottom, patch.left : patch.right] += patch.weight * total
    return image
