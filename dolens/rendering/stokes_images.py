"""Images of polarised scenes: what a lens does to Stokes vectors, and a sensor behind analysers.

The image's Stokes vectors are M·S.  S are the scene's, blurred as its power is.  M is the mean over
the pupil of the Mueller matrices that the Jones pupil of the place in the field has (see
`dolens.diffraction.jones_pupils`), over its share of unpolarised light, which the blurred image
has already.  Left out is that the point spread functions of the four components differ: what one
place in the pupil does more than another is lost from the picture's finest detail, and from no
mean.

Angles run from x to the right towards y upwards in the upright picture, which faces the light as
who looks towards the scene does; see `dolens.optics.jones` for the signs of Stokes vectors.
"""

import math
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from dolens.analysis.conditions import conditions
from dolens.diffraction.jones_pupils import jones_pupils
from dolens.diffraction.pupil_fit import chebyshev
from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.photograph import LensCamera, read_out
from dolens.rendering.stray_light import object_point

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ANALYSERS = (0.0, 45.0, 90.0, 135.0)
# Places along each side of the sensor, through which polynomials are laid, and rays along each side
# of a pupil.
_PLACES, _RAYS = 13, 16
# Of the power, by which light may seem more than fully polarised.
_ROUNDING = 1e-4


@dataclass(frozen=True, eq=False)
class StokesPhotograph:
    """A polarised scene, as a sensor with analysers behind a lens sees it.

    Attributes:
        scene: (4, 3, H, W), Stokes vectors in linear light, blurred, of a lens that changes no
            polarisation.
        image: likewise, of this lens, in front of the analysers.
        analysers: (4, 3, H, W), what the sensor gives behind ideal polarisers at 0, 45, 90 and 135
            degrees, with its noise.
        measured: (3, 3, H, W), S₀, S₁ and S₂ of these four.
        distance: of the scene from the first vertex, mm.
    """

    scene: Tensor
    image: Tensor
    analysers: Tensor
    measured: Tensor
    distance: float

    @property
    def error(self) -> Tensor:
        """(3, H, W), by how much the lens alone changes the degree of linear polarisation."""
        return linear_polarisation(self.image)[0] - linear_polarisation(self.scene)[0]

    def figure(self) -> "Figure":
        """Return the figure of `plotting.stokes_images.stokes_figure`."""
        make = resolve_name("dolens.plotting.stokes_images.stokes_figure")
        found: Figure = make(self)
        return found


def linear_polarisation(stokes: Tensor) -> tuple[Tensor, Tensor]:
    """Return the degree of linear polarisation of Stokes vectors (3 or 4, ...), and the angle of
    its axis, degrees from -90 to 90; zero without light.
    """
    size = torch.hypot(stokes[1], stokes[2])
    degree = torch.where(stokes[0] > 0.0, size / stokes[0].clamp(min=1e-30), 0.0)
    return degree, torch.rad2deg(0.5 * torch.atan2(stokes[2], stokes[1]))


@torch.no_grad()
def stokes_photograph(
    lens: Lens, camera: LensCamera, scene: Tensor, seed: int = 0
) -> StokesPhotograph:
    """Photograph a polarised scene.

    Args:
        lens: of the camera; surfaces without a coating change no polarisation.
        camera: its readout has no colour filters; its first distance counts.
        scene: (4, 3, h, w), Stokes vectors in linear light; S₀ is 1 for white, of all polarisations
            together.
        seed: of the noise.

    Raises:
        InputError: more polarised than fully, or of another shape.
    """
    check_stokes(scene)
    power = scene[0]
    # All that is blurred is light: none is negative.
    parts = [power, *(0.5 * (power + part) for part in scene[1:])]
    blurred = [camera.field.image(camera.field.texture(part.float())) for part in parts]
    before = torch.stack([blurred[0], *(2.0 * part - blurred[0] for part in blurred[1:])]).double()
    matrices = mueller_matrices(lens, camera.field.imaging, 0)
    image = torch.einsum("chwij,jchw->ichw", matrices, before)
    behind = []
    for number, angle in enumerate(ANALYSERS):
        twice = torch.deg2rad(torch.tensor(2.0 * angle, dtype=torch.float64))
        light = 0.5 * (image[0] + twice.cos() * image[1] + twice.sin() * image[2])
        behind.append(read_out(light.to(blurred[0]), camera.readout, seed + number))
    first, second, third, fourth = behind
    total = 0.5 * (first + second + third + fourth)
    measured = torch.stack((total, first - third, second - fourth))
    return StokesPhotograph(before, image, torch.stack(behind), measured, camera.distances[0])


def check_stokes(scene: Tensor) -> None:
    """Refuse Stokes vectors that no light has.

    Raises:
        InputError: a shape other than (4, 3, h, w), or more polarised than fully.
    """
    if scene.ndim != 4 or scene.shape[:2] != (4, 3) or not scene.is_floating_point():
        raise InputError(
            f"scene: {scene.dtype} of shape {tuple(scene.shape)}; allowed: Stokes vectors (4, 3, "
            "height, width) in linear light"
        )
    polarised = scene[1:].square().sum(0).sqrt()
    if not bool((polarised <= scene[0] * (1.0 + _ROUNDING) + 1e-6).all()):
        raise InputError("scene: allowed: S₀ ≥ √(S₁² + S₂² + S₃²), finite, everywhere")


@torch.no_grad()
def mueller_matrices(lens: Lens, imaging: ImagingSystem, plane: int) -> Tensor:
    """Return the Mueller matrix of every pixel and colour over its share of unpolarised light.

    Args:
        lens: of the imaging system.
        imaging: planes, C wavelengths and pixels.
        plane: number of the plane, from 0.

    Returns:
        (C, height, width, 4, 4), double precision; the unit matrix where no light passes.
    """
    scene, sensor = imaging.scene, imaging.sensor
    depth, scale = scene.depths[plane], scene.magnifications(lens.system())[plane]
    (rows, down), (columns, across) = (_places(n) for n in (sensor.height, sensor.width))
    points = [object_point(r, c, sensor, scale) for r in rows.tolist() for c in columns.tolist()]
    where = conditions(lens, points, list(scene.wavelengths), depth)
    found = jones_pupils(lens, where, _RAYS).mueller
    power = found[..., :1, :1]
    unit = torch.eye(4, dtype=found.dtype)
    found = torch.where(power > 0.0, found / power.clamp(min=1e-30), unit)
    places = found.permute(1, 2, 3, 0).unflatten(-1, (_PLACES, _PLACES))
    return (down @ places @ across.mT).permute(0, 3, 4, 1, 2)


def _places(length: int) -> tuple[Tensor, Tensor]:
    """Return Chebyshev's nodes along a side of pixels, and the matrix (length, nodes) of the
    polynomial through values there.
    """
    count = torch.arange(_PLACES, dtype=torch.float64)
    nodes = torch.cos(math.pi * (count + 0.5) / _PLACES)
    half = 0.5 * max(length - 1, 1)
    pixels = torch.arange(length, dtype=torch.float64) / half - 1.0
    at_nodes, at_pixels = (chebyshev(u[None], _PLACES - 1)[0][0].mT for u in (nodes, pixels))
    return half * (nodes + 1.0), at_pixels @ torch.linalg.inv(at_nodes)
