"""Jones pupils: what a lens does to polarised light over the pupil of every field.

A Jones matrix needs two axes across the ray in front of the lens and behind it.  They are
Chipman's double-pole axes about the mean direction of the light on either side (see
`dolens.optics.polarisation.double_pole_axes`; behind the lens they start from the sensor's x and
y, which coordinate breaks may turn), in which a polariser far from the pupil, or a sensor, sees a
converging beam with the least turn.  For small angles the x and y components of the field itself
will do: `cartesian`.

Of the lens's own diattenuation and retardance the turn of the axes by geometry alone is taken off:
that by the same lens with ideal surfaces, along the same rays.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.analysis.conditions import AtConditions, Conditions
from dolens.diffraction.entrance_beam import (
    EntranceBeam,
    ObjectPoints,
    box_grid,
    find_beam,
    launched,
)
from dolens.diffraction.field_wavefronts import light_centroids, object_points
from dolens.diffraction.wavefront import pupil_wavefront
from dolens.diffraction.wavefront_map import stop_coordinates
from dolens.optics.jones import (
    diattenuation,
    ideal_elements,
    mean_transmission,
    mueller,
    retardance,
)
from dolens.optics.lens import Lens
from dolens.optics.polarisation import PolarisedRays, double_pole_axes, trace_polarised
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Components, Rays
from dolens.optics.system import OpticalSystem


@dataclass(frozen=True)
class JonesPupils(AtConditions):
    """Jones matrices of F fields and W wavelengths at S × S rays each; complex128 on the CPU.

    Where no light passes, matrices are zero, and their diattenuation and retardance NaN.

    Attributes:
        stop: (F, W, S, S, 2), where the rays cross the stop, over its semi-diameter, in its axes.
        weight: (F, W, S, S), the ray's share of the light that apertures pass; their sum is one.
        inside: (F, W, S, S), bool: the ray itself passes.
        jones: (F, W, S, S, 2, 2), of the ideal elements in front, the lens and those behind, in
            double-pole axes on both sides.
        own: (F, W, S, S, 2, 2), of the lens alone, behind it in the axes that geometry carries
            there from those in front.
        cartesian: (F, W, S, S, 2, 2), of the lens alone: x and y of the field behind it, in the
            sensor's axes, over those in front.
        scalar: (F, W), the mean of the trace's `transmission`, which multiplies means over s and p
            of each surface.
    """

    stop: Tensor
    weight: Tensor
    inside: Tensor
    jones: Tensor
    own: Tensor
    cartesian: Tensor
    scalar: Tensor

    @property
    def power(self) -> Tensor:
        """(F, W, S, S), share of unpolarised light that passes lens and elements."""
        return mean_transmission(self.jones)

    @property
    def transmission(self) -> Tensor:
        """(F, W), share of unpolarised light that passes lens and elements."""
        return (self.weight * self.power).sum((-2, -1))

    @property
    def diattenuation(self) -> tuple[Tensor, Tensor]:
        """(F, W, S, S) of the lens, and the angle of the axis that passes most, degrees."""
        return diattenuation(self.own)

    @property
    def retardance(self) -> tuple[Tensor, Tensor]:
        """(F, W, S, S), degrees, of the lens without geometry, and the angle of the fast axis."""
        return retardance(self.own)

    @property
    def mueller(self) -> Tensor:
        """(F, W, 4, 4), mean over the light, of the elements and the lens."""
        return (self.weight[..., None, None] * mueller(self.jones)).sum((2, 3))

    def between(
        self, front: Sequence[Mapping[str, Any]] = (), behind: Sequence[Mapping[str, Any]] = ()
    ) -> "JonesPupils":
        """Return these pupils with ideal elements in front of all and behind all.

        Args:
            front: in the order of the light, as `ideal_elements` takes them: `[{"polariser": 0}]`;
                angles are in the double-pole axes there.
            behind: likewise.

        Raises:
            InputError: an element that cannot be used.
        """
        ahead, after = ideal_elements(front, "front"), ideal_elements(behind, "behind")
        return replace(self, jones=after @ self.jones @ ahead)

    def stokes(self, light: Sequence[float] | Tensor = (1.0, 0.0, 0.0, 0.0)) -> Tensor:
        """Return the Stokes vectors (F, W, 4) of the field points' images.

        Args:
            light: the Stokes vector of every object point; unpolarised unless given.  See
                `dolens.optics.jones` for its signs.
        """
        return self.mueller @ torch.as_tensor(light, dtype=torch.float64)


@torch.no_grad()
def jones_pupils(
    lens: Lens,
    where: Conditions,
    samples: int = 64,
    front: Sequence[Mapping[str, Any]] = (),
    behind: Sequence[Mapping[str, Any]] = (),
) -> JonesPupils:
    """Trace the Jones pupil of every field and wavelength; see `JonesPupils`.

    Args:
        lens: the lens.
        where: fields, wavelengths and object distance.
        samples: S, rays along each side of a box about each beam.
        front: ideal elements in front of the lens; see `JonesPupils.between`.
        behind: ideal elements behind it.

    Raises:
        InputError: an element that cannot be used, or a coating that is a table of shares.
    """
    system = lens.system().double()
    field, waves = where.fields.to(system.device), where.wavelengths.to(system.device)
    shape = (len(field), len(waves))
    points = object_points(field.repeat_interleave(len(waves), 0), where.object_distance)
    wave = waves.repeat(len(field))
    beam = find_beam(system, points, wave)
    middle = light_centroids(system, points, wave, beam)
    # Each ray's own share is counted beside the light in front of the lens.
    wavefront = pupil_wavefront(system.uncoated(), points, wave, middle, samples, beam=beam)
    stop, _ = stop_coordinates(system, points, wave, beam, samples)
    light = (wavefront.amplitude * wavefront.weight).where(stop.isfinite().all(-1), 0.0)
    light = (light / light.sum((-2, -1), keepdim=True)).nan_to_num(0.0)

    lit, rays, traced, axes, sensor = polarised_pupil(system, points, wave, beam, light)
    # Behind ideal surfaces the axes in front are where geometry carries them.
    turn = (traced.front[..., :2].mT @ axes[0]).to(traced.jones)
    scalar = trace_rays(system.opened(), rays, transmission=True).transmission
    assert scalar is not None  # it was asked for

    def found(values: Tensor) -> Tensor:
        return values.cpu().unflatten(0, shape)

    def over_pupil(values: Tensor) -> Tensor:
        every = values.new_zeros(*lit.shape, *values.shape[1:])
        every[lit] = values
        return found(every)

    pupils = JonesPupils(
        where,
        found(stop),
        found(light),
        found(lit & (wavefront.coverage >= 0.5)),
        over_pupil(traced.in_axes(*axes)),
        over_pupil(turn.mT @ traced.jones @ turn),
        over_pupil((sensor.mT.to(turn) @ traced.matrix)[..., :2, :2]),
        (over_pupil(scalar) * found(light)).sum((-2, -1)),
    )
    return pupils.between(front, behind)


class PolarisedPupil(NamedTuple):
    """The M rays of N pupils that carry light are traced with their fields.

    Attributes:
        lit: (N, S, S), bool: they.
        rays: in front of the lens.
        traced: behind it.
        axes: (M, 3, 2) in front and behind: double-pole axes about the mean direction there.
        sensor: (3, 3), columns: the sensor's axes in the lens's.
    """

    lit: Tensor
    rays: Rays
    traced: PolarisedRays
    axes: tuple[Tensor, Tensor]
    sensor: Tensor


def polarised_pupil(
    system: OpticalSystem, points: ObjectPoints, wave: Tensor, beam: EntranceBeam, light: Tensor
) -> PolarisedPupil:
    """Trace the rays of `pupil_wavefront` that carry light, and the field along them.

    Args:
        system: the lens, in double precision.
        points: N object points.
        wave: (N,), nm.
        beam: of these points.
        light: (N, S, S), flux of each ray; the others are not traced.
    """
    samples = light.shape[-1]
    half_width = beam.half_width * (samples / (samples - 2.0))
    ray = launched(points, box_grid(beam.centre, half_width, samples))
    # Rays without light may take long to miss.
    lit = light > 0.0
    owner = torch.nonzero(lit)[:, 0]
    rays = Rays.from_components(Components(*(c[lit] for c in ray)), wave[owner])
    traced = trace_polarised(system.opened(), rays)
    # Behind coordinate breaks the sensor has axes of its own.
    sensor = system.all_axes[-1].place(system.device)[0]
    front, behind = (
        double_pole_axes(way, _mean_directions(way, light[lit], owner, len(points))[owner])
        for way in (traced.front[..., 2], traced.behind[..., 2] @ sensor)
    )
    return PolarisedPupil(lit, rays, traced, (front, sensor @ behind), sensor)


def _mean_directions(direction: Tensor, light: Tensor, owner: Tensor, count: int) -> Tensor:
    """Return unit vectors (N, 3), the means of directions (M, 3) over the light (M,) of each."""
    total = direction.new_zeros(count, 3).index_add(0, owner, light[:, None] * direction)
    return total / total.norm(dim=-1, keepdim=True).clamp(min=1e-300)
