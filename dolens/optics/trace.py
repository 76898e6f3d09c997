"""Sequential tracing, forward and backward (Algorithm 1 of the source)."""

from dataclasses import dataclass, replace
from functools import partial, reduce
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.kernels.table import GRAZING
from dolens.optics.bent_rays import still
from dolens.optics.crystals import Crystal, refract_at_crystal
from dolens.optics.elements import (
    LENS_AXES,
    Axes,
    change_axes,
    from_lens_axes,
    points_to_lens_axes,
    to_lens_axes,
)
from dolens.optics.rays import (
    Components,
    Rays,
    Status,
    TracedRays,
    distance_along,
    finite_rays,
)
from dolens.optics.surfaces.deflection import Media, Travel
from dolens.optics.surfaces.refraction import FAR, PlaneRay, tolerance_scale
from dolens.optics.surfaces.state import SurfaceState
from dolens.optics.system import OpticalSystem, per_radian


class Margins(NamedTuple):
    """Why a ray may end at a surface: each is positive where it does not (None: it cannot)."""

    number: int
    met: Tensor | None
    inside: Tensor | None
    transmitted: Tensor | None


class Shares(NamedTuple):
    """Light is lost on the way to a surface and at it: the shares that are left, tensors or 1."""

    medium: Tensor | float
    surface: Tensor | float


class Crossing(NamedTuple):
    """Rays cross a surface; components are in its axes.

    Attributes:
        number: of the surface, from 1.
        point: x, y, z, mm.
        arriving: direction in front of the surface.
        leaving: direction behind it.
        indices: in front and behind; a `Crystal` where extraordinary rays go.
        axes: of the surface.
    """

    number: int
    point: tuple[Tensor, Tensor, Tensor]
    arriving: tuple[Tensor, Tensor, Tensor]
    leaving: tuple[Tensor, Tensor, Tensor]
    indices: tuple[Any, Any]
    axes: Axes


@dataclass(frozen=True)
class Trace:
    """Rays after the last surface (or on the sensor), as components.

    Attributes:
        ray: in the lens's axes, z from the vertex of the first surface; on the sensor in the
            sensor's own axes, which are the same but for coordinate breaks; z is then the sum of
            all thicknesses.
        valid: bool.
        margins: per surface met.
        path_length: Σ n·t in mm, or None when it was not asked for.
        shares: of unpolarised light, per surface met and then on the way to the sensor; None where
            they were not asked for.
        points: per surface met, x, y, z in the lens's axes; empty when not recorded.  At a
            coordinate break it is where the ray crosses the plane z = 0 behind it.
        local: the rays on the last surface met, in its axes.
        axes: of that surface.
    """

    ray: Components
    valid: Tensor
    margins: list[Margins]
    path_length: Tensor | None
    shares: list[Shares] | None
    points: list[tuple[Tensor, Tensor, Tensor]]
    local: Components
    axes: Axes


def transfer(ray: Components, distance: Tensor) -> Components:
    """Move rays by a distance (mm) along their direction."""
    x, y, z, l, m, n = ray  # noqa: E741
    return Components(x + distance * l, y + distance * m, z + distance * n, l, m, n)


def distance_to_plane(ray: Components, z: Tensor | float, sense: float) -> tuple[Tensor, Tensor]:
    """Distance (mm) along rays to the plane at z, and a margin: their cosine in this sense.

    The margin counts from the smallest cosine that is divided by, `GRAZING`: a ray along the plane
    misses it.  The distance of rays that do not travel towards it is finite and means nothing.
    """
    cosine = (ray.n if sense > 0.0 else -ray.n).clamp(min=GRAZING)
    return distance_along(sense * (z - ray.z), cosine), cosine.detach() - GRAZING


def distance_to_nearest(ray: Components) -> Tensor:
    """Return the distance (mm) along rays to the point that is nearest to the vertex."""
    x, y, z, l, m, n = ray  # noqa: E741
    return -torch.addcmul(torch.addcmul(x * l, y, m), z, n)


class Meeting(NamedTuple):
    """Rays meet a surface.

    Attributes:
        ray: on the surface, in its axes.
        to_plane: distance (mm) to the vertex plane, or to the point nearest to the vertex.
        t: distance (mm) from there to the surface.
        met: a margin that is positive where they meet it.
    """

    ray: Components
    to_plane: Tensor
    t: Tensor
    met: Tensor


def meet(
    surface: SurfaceState, ray: Components, sense: float, from_the_side: bool = False
) -> Meeting:
    """Find where rays, in a surface's axes, meet it, coming towards +z (sense +1) or -z.

    Args:
        surface: the surface.
        ray: in its axes.
        sense: of the light.
        from_the_side: whether rays may come along the vertex plane or from behind it.
    """
    shape, limit = surface.shape, FAR * surface.semi_diameter
    if from_the_side:
        nearest = distance_to_nearest(ray)
        moved = transfer(ray, nearest)
        x, y, z = (c.clamp(-limit, limit) for c in moved[:3])
        moved = moved._replace(x=x, y=y, z=z)
        found = shape.intersect_from(surface.parameters, moved, sense)
        if found is not None:
            t, met = found[0].clamp(-limit, limit), found[1]
            for length in (x, y, z, t):
                met = torch.minimum(met, limit - length.detach().abs())
            return Meeting(transfer(moved, t), nearest, t, met)
    to_plane, towards = distance_to_plane(ray, 0.0, sense)
    l, m, n = ray[3:]  # noqa: E741
    x = torch.addcmul(ray.x, to_plane, l).clamp(-limit, limit)
    y = torch.addcmul(ray.y, to_plane, m).clamp(-limit, limit)
    at_plane = PlaneRay(x, y, l, m, n)
    scale = tolerance_scale(surface.semi_diameter)
    t, branch = shape.intersect(surface.parameters, at_plane, sense, scale)
    met = towards if branch is None else torch.minimum(towards, branch)
    t = t.clamp(-limit, limit)
    # What was held at the limit is not where the ray goes.
    across = torch.maximum(x.detach().abs(), y.detach().abs())
    met = torch.minimum(met, limit - torch.maximum(across, t.detach().abs()))
    x, y = torch.addcmul(x, t, l), torch.addcmul(y, t, m)
    if not shape.closed_form:
        # There is no point of the surface to refract at, and a sag far off may overflow.
        lost = ~(met > 0.0)
        x, y, t = (v.masked_fill(lost, 0.0) for v in (x, y, t))
    return Meeting(Components(x, y, t * n, l, m, n), to_plane, t, met)


def enter_lens(
    system: OpticalSystem, rays: Rays, number: int, sense: float
) -> tuple[Components, Tensor | None]:
    """Rays in the lens's precision and on its device, and the optical path to where they are moved.

    Rays of a finer precision than the lens's are moved to the vertex of the surface `number` that
    they meet first, before they lose it: a source at 10 km would come out 0.1 mm off.  The path is
    None for the others, which stay where they start.
    """
    known = finite_rays(rays, system.dtype)
    ray = Components(*(c.to(device=system.device) for c in known.components()))
    finer = torch.promote_types(ray.x.dtype, system.dtype)
    if finer == system.dtype:
        return Components(*(c.to(system.dtype) for c in ray)), None
    front = number - 1 if sense > 0.0 else number
    towards = sense * system.senses[number if number in system.breaks else front]
    axes = system.axes[number - 1]
    if axes.segment:
        distance, _ = distance_to_plane(from_lens_axes(ray, axes), 0.0, towards)
    elif system.from_the_side:
        distance = distance_to_nearest(ray._replace(z=ray.z - system.vertices[number - 1]))
    else:
        distance, _ = distance_to_plane(ray, system.vertices[number - 1].to(finer), towards)
    index = system.indices(rays.wavelength)[front]
    crystal = system.crystals(rays.wavelength).get(front)
    if crystal is not None:
        index = crystal.ray_index(ray[3:])
    moved = Components(*(c.to(system.dtype) for c in transfer(ray, distance)))
    return moved, (index * distance).to(system.dtype)


def trace_surfaces(
    system: OpticalSystem,
    ray: Components,
    wavelength: float | Tensor,
    sense: float = 1.0,
    path_length: bool = False,
    record: bool = False,
    first: int = 1,
    last: int | None = None,
    transmission: bool = False,
    crossings: list[Crossing] | None = None,
) -> Trace:
    """Trace rays through surfaces `first` to `last`, in the order that light meets them.

    Args:
        system: the lens.
        ray: one broadcast shape, mm, z from the first vertex.
        wavelength: nm.
        sense: +1 from the object towards the sensor, -1 from the sensor towards the object.
        path_length: whether to sum n·t.
        record: whether to keep the intersections.
        first: number of the first surface, from 1, as the prescription counts in either sense.
        last: number of the last surface; None: of the lens.
        transmission: whether to find the shares of light that each surface and medium passes.
        crossings: of every surface met one is appended, where a list is given.

    Returns:
        The rays on the last surface met, travelling in the medium behind it.
    """
    indices, places, senses = system.indices(wavelength), system.axes, system.senses
    crystals = system.crystals(wavelength)
    spaces = system.spaces(wavelength)
    numbers = range(first, (len(system.surfaces) if last is None else last) + 1)
    path = torch.zeros_like(ray.n) if path_length else None
    shares: list[Shares] | None = [] if transmission else None
    absorptions = system.absorptions(wavelength) if transmission else []
    forward = sense > 0.0
    margins: list[Margins] = []
    points: list[tuple[Tensor, Tensor, Tensor]] = []
    # Positions count from the vertex at hand: float32 then errs by the sag's rounding only.
    axes = LENS_AXES
    for number in numbers if sense > 0 else reversed(numbers):
        i = number - 1
        surface = system.surfaces[i]
        shape, parameters = surface.shape, surface.parameters
        if shape.changes_axes:
            if record:
                crossing, _ = change_axes(ray, axes, places[i])
                points.append(points_to_lens_axes(crossing[:3], places[i]))
            continue
        front, back = (i, i + 1) if sense > 0 else (i + 1, i)
        before: Any = indices[front]
        after: Any = indices[back]
        if crystals:
            before, after = (
                crystals[k].seen_from(places[i], system.dtype) if k in crystals else indices[k]
                for k in (front, back)
            )
        arriving, leaving = sense * senses[front], sense * senses[back]
        towards = partial(meet, surface, sense=arriving, from_the_side=system.from_the_side)
        bent = None
        if front in spaces:
            held = replace(surface, parameters={k: still(v) for k, v in parameters.items()})
            here, found, bent = spaces[front].cross(
                *(ray, axes, places[i], towards, partial(towards.func, held, **towards.keywords))
            )
            carried = None
        else:
            here, carried = change_axes(ray, axes, places[i])
            found = towards(here)
        axes = places[i]
        (x, y, z, l, m, n), to_plane, t, met = found  # noqa: E741
        if front in spaces:
            before = spaces[front].index((x, y, z), axes)
        if back in spaces:
            after = spaces[back].index((x, y, z), axes)
        inside = surface.aperture.margin(x, y)
        if path is not None or shares is not None:
            distance = to_plane + t if carried is None else carried + to_plane + t
            along = before.ray_index((l, m, n)) if isinstance(before, Crystal) else before
            path = None if path is None else path + (along * distance if bent is None else bent)
        if record:
            points.append(points_to_lens_axes((x, y, z), axes))
        if shares is not None:
            passes: Tensor | float = 1.0
            if surface.coating is not None:
                passes = surface_share(
                    surface, (x, y, z), (l, m, n), (before, after), wavelength,
                    number in system.mirrors, forward,
                )  # fmt: skip
            shares.append(Shares(_within(absorptions[front], distance), passes))
        transmitted = None
        if surface.deflection is not None:
            media = Media(before, after, per_radian(wavelength, ray.n))
            travel = Travel(arriving, leaving, forward)
            l, m, n, transmitted, added = surface.deflect(  # noqa: E741
                (x, y, z), (l, m, n), media, travel
            )
            path = None if path is None else path + added
        elif front in crystals or back in crystals:
            normal = shape.normal(parameters, x, y, z)
            l, m, n, transmitted = refract_at_crystal(  # noqa: E741
                (l, m, n), normal, before, after, leaving
            )
        elif system.refracts(number):
            l, m, n, transmitted = shape.refract(  # noqa: E741
                parameters, (x, y, z), (l, m, n), before / after, leaving
            )
        margins.append(Margins(number, met, inside, transmitted))
        if crossings is not None:
            crossings.append(
                Crossing(number, (x, y, z), here[3:], (l, m, n), (before, after), axes)
            )
        ray = Components(x, y, z, l, m, n)
    valid = _all_positive(margins, ray.n)
    return Trace(to_lens_axes(ray, axes), valid, margins, path, shares, points, ray, axes)


def _within(absorption: float | Tensor, distance: Tensor) -> Tensor | float:
    """Return the share of light that passes a distance (mm) of a medium, exp(-a·t)."""
    if isinstance(absorption, float) and absorption == 0.0:
        return 1.0
    return torch.exp(-absorption * distance)


def surface_share(
    surface: SurfaceState,
    point: tuple[Tensor, Tensor, Tensor],
    direction: tuple[Tensor, Tensor, Tensor],
    indices: tuple[float | Tensor, float | Tensor],
    wavelength: float | Tensor,
    mirror: bool,
    forward: bool,
) -> Tensor:
    """Return the share of unpolarised light that a coated surface passes, or a mirror reflects.

    Args:
        surface: with a coating.
        point: on it, mm, in its axes.
        direction: of the light that arrives.
        indices: in front and behind, in the order of the light's travel.
        wavelength: nm.
        mirror: whether the surface reflects.
        forward: whether light travels from the object to the sensor; the other way it meets the
            coating of a refracting surface from behind.
    """
    coating = surface.coating
    assert coating is not None  # as the argument says
    if not (mirror or forward):
        coating = coating.turned_round()
    cosine = surface.cosine_of_incidence(point, direction)
    found = coating.shares(*indices, cosine, wavelength)
    return found.reflected if mirror else found.passed


def _all_positive(margins: list[Margins], like: Tensor) -> Tensor:
    """Return where every margin is positive; a NaN is not.  True for rays that met no surface."""
    kept = [m for row in margins for m in row[1:] if m is not None]
    if not kept:
        return torch.ones_like(like, dtype=torch.bool)
    return reduce(torch.minimum, kept) > 0.0


def trace_to_sensor(system: OpticalSystem, traced: Trace, wavelength: float | Tensor) -> Trace:
    """Carry rays on from the last surface to the sensor, plane or curved, and into its axes.

    Rays that do not travel in the sense of the light there, or miss a curved sensor, are no longer
    valid.
    """
    z = system.vertices[-1]
    if system.image is not None:
        at_level, carried = change_axes(traced.local, traced.axes, system.all_axes[-1])
        landed, to_plane, t, towards = meet(system.image, at_level, system.senses[-1])
        distance = to_plane + t if carried is None else carried + to_plane + t
        ray = landed._replace(z=landed.z + z)
    elif system.breaks:
        # Carried to the level of the sensor's vertex before they are turned.
        at_level, carried = change_axes(traced.local, traced.axes, system.all_axes[-1])
        to_plane, towards = distance_to_plane(at_level, 0.0, system.senses[-1])
        distance = to_plane if carried is None else carried + to_plane
        landed = transfer(at_level, to_plane)
        ray = landed._replace(z=landed.z + z)
    else:
        distance, towards = distance_to_plane(traced.ray, z, system.senses[-1])
        ray = transfer(traced.ray, distance)
    path, shares = traced.path_length, traced.shares
    if path is not None:
        path = path + system.indices(wavelength)[-1] * distance
    if shares is not None:
        shares = [*shares, Shares(_within(system.absorptions(wavelength)[-1], distance), 1.0)]
    return replace(
        traced,
        shares=shares,
        ray=ray,
        valid=traced.valid & (towards > 0.0),
        margins=[*traced.margins, Margins(len(system.surfaces) + 1, towards, None, None)],
        path_length=path,
    )


def first_failure(traced: Trace) -> tuple[Tensor, Tensor]:
    """Status (int8) of every ray and the surface where that happened (int16, 0 if valid).

    A miss or a total reflection ends a ray, so the first of them is its status.  A vignetted ray
    is traced on as if unclipped and is VIGNETTED, at the first aperture that it fails, when
    nothing ends it.  A ray that leaves the last surface away from the sensor missed surface N + 1.
    """
    status = torch.zeros_like(traced.valid, dtype=torch.int8)
    surface = torch.zeros_like(traced.valid, dtype=torch.int16)
    goes_on = torch.ones_like(traced.valid)
    for number, met, inside, transmitted in traced.margins:
        for cause, margin in (
            (Status.MISSED, met),
            (Status.VIGNETTED, inside),
            (Status.TIR, transmitted),
        ):
            if margin is None:
                continue
            fails = goes_on & ~(margin > 0.0)
            if cause == Status.VIGNETTED:
                fails = fails & (status == Status.OK)
            else:
                goes_on = goes_on & (margin > 0.0)
            status = status.masked_fill(fails, int(cause))
            surface = surface.masked_fill(fails, number)
    return status, surface


def stop_gradient_where_invalid(values: Tensor, valid: Tensor) -> Tensor:
    """The same numbers; those of invalid rays pass no gradient, and are finite."""
    return torch.where(valid, values, values.detach().nan_to_num(0.0, 0.0, 0.0))


def traced_rays(traced: Trace, path_before: Tensor | None) -> TracedRays:
    """Join a trace for users: components, statuses, and no gradient of invalid rays.

    Args:
        traced: with path lengths.
        path_before: optical path (mm) before the trace began, or None.
    """
    path = traced.path_length
    assert path is not None  # as the argument says
    if path_before is not None:
        path = path + path_before
    status, surface = first_failure(traced)
    kept = [stop_gradient_where_invalid(c, traced.valid) for c in traced.ray]
    points = None
    if traced.points:
        points = torch.stack(
            [
                torch.stack([stop_gradient_where_invalid(c, traced.valid) for c in point], -1)
                for point in traced.points
            ]
        )
    passed = None
    if traced.shares is not None:
        passed = torch.ones_like(traced.ray.x)
        for medium, surface_passes in traced.shares:
            passed = passed * medium * surface_passes
        passed = stop_gradient_where_invalid(passed, traced.valid)
    return TracedRays(
        transmission=passed,
        position=torch.stack(kept[:3], -1),
        direction=torch.stack(kept[3:], -1),
        valid=traced.valid,
        status=status,
        surface=surface,
        path_length=stop_gradient_where_invalid(path, traced.valid),
        points=points,
    )
