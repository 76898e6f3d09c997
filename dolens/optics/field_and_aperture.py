"""Fields and aperture of a lens, from what a prescription or a user gives.

Object points follow from image heights or pupil angles.  The stop's size follows from an f-number,
from the diameter of the entrance pupil, or from the real marginal ray.
"""

import copy
import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.elements import from_lens_axes
from dolens.optics.lens import Lens
from dolens.optics.paraxial import matrix_to_stop, vergence
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Components, Rays, Status, arrives
from dolens.optics.surfaces.clear_aperture import Circle, Unlimited

# The secant method needs a few steps; a distorted edge of a field some more.
_STEPS, _HALVINGS = 60, 12
# Of the largest height: where the chief ray is taken to land as asked for, and where at the worst.
_CLOSE, _ENOUGH = 1e-14, 1e-10
# A slope at the stop whose ray is paraxial.
_SMALL = 1e-6


def object_fields(lens: Lens, heights: Tensor, real: bool) -> Tensor:
    """Return the fields of a lens whose chief rays land at given heights.

    Paraxially, a field of tangent t at infinity has the height t·n/power, with n the index of
    object space, and a point of the object that times the magnification.  A real chief ray passes
    the centre of the stop: its slope there is searched by the secant method, for all fields
    together, until it lands at the height; traced backwards, it then leads to the object.

    Args:
        lens: the lens; its reference wavelength and object distance count.
        heights: (F, 2), x and y in mm: on the paraxial image, or on the sensor.
        real: whether the real chief ray is meant.

    Returns:
        (F, 2), degrees for an object at infinity, else mm on the object; float64.

    Raises:
        InputError: the lens has no power, or no real chief ray lands there, or real ones are asked
            for in a lens without rotational symmetry.
    """
    infinite = vergence(lens.object_distance) == 0.0
    lens = in_double_precision(lens)
    with torch.no_grad():
        first = lens.first_order(lens.primary_wavelength, lens.object_distance)
        if real:
            return _of_real_rays(lens, heights.double())
        n = float(lens.materials[0].index(lens.primary_wavelength))
        scale = n * float(first.efl) if infinite else float(first.magnification)
        if not (math.isfinite(scale) and scale != 0.0):
            raise InputError("fields by their image heights need a lens that forms an image")
        found = heights.double() / scale
    return torch.rad2deg(found.atan()) if infinite else found


def heights_of_pupil_angles(lens: Lens, angles: Tensor) -> Tensor:
    """Return the object points (F, 2), mm, whose lines to the centre of the paraxial entrance pupil
    have these angles to the axis, (F, 2) in degrees: -tan(angle) times the distance.

    Raises:
        InputError: the entrance pupil is at infinity.
    """
    with torch.no_grad():
        first = in_double_precision(lens).first_order(lens.primary_wavelength)
    away = math.inf if lens.object_distance is None else float(lens.object_distance)
    distance = away + float(first.entrance_pupil.z)
    if not math.isfinite(distance):
        raise InputError("fields by angles need an entrance pupil that is not at infinity")
    return -torch.deg2rad(angles).tan() * distance


def in_double_precision(lens: Lens) -> Lens:
    """Return the lens in double precision: itself, if it is."""
    return lens if lens.dtype == torch.float64 else lens.storing_its_values().to(torch.float64)


def _of_real_rays(lens: Lens, heights: Tensor) -> Tensor:
    """Return the fields of real chief rays; see `object_fields`."""
    if not lens.system().rotationally_symmetric:
        raise InputError(
            "fields by their real image heights need a lens of rotational symmetry "
            "(allowed: angles, heights, image_heights)"
        )
    radius = heights.norm(dim=-1)
    slope = _slopes_at_stop(lens, radius)
    ray = _from_stop(lens, slope, -1.0)
    if lens.stop > 1:
        back = lens.sensor_to_scene(ray, last=lens.stop - 1)
        if not bool(arrives(back.status).all()):
            raise InputError("a chief ray of a real image height does not come from the object")
        ray = Rays(back.position, back.direction, ray.wavelength)
        if bool((ray.direction[..., 2] >= 0.0).any()):
            raise InputError("a chief ray of a real image height comes at 90 degrees to the axis")
    _, y, z = ray.position.unbind(-1)
    tangent = ray.direction[..., 1] / ray.direction[..., 2]
    distance = lens.object_distance
    near = vergence(distance)
    if distance is None or near == 0.0:
        height = torch.rad2deg(tangent.atan())
    else:
        height = y + tangent * (-float(distance) - z)
    towards = heights / torch.where(radius > 0.0, radius, 1.0)[:, None]
    if near == 0.0:
        # An angle of a field is one of each component of its tangent.
        return torch.rad2deg((tangent[:, None] * towards).atan())
    return height[:, None] * towards


def _slopes_at_stop(lens: Lens, radius: Tensor) -> Tensor:
    """Return the slopes in y, in front of the stop, of chief rays that land at y = radius (mm)."""
    size = float(radius.max())
    if size == 0.0:
        return torch.zeros_like(radius)

    def landing(slope: Tensor) -> Tensor:
        """Return y on the sensor, NaN where the ray is lost."""
        hit = lens.trace(_from_stop(lens, slope, 1.0), first=lens.stop)
        return torch.where(arrives(hit.status), hit.position[..., 1], torch.nan)

    rate = float(landing(radius.new_full((1,), _SMALL))[0]) / _SMALL
    if not (math.isfinite(rate) and rate != 0.0):
        raise InputError("fields by their image heights need a lens that forms an image")
    # From the axis, where a slope of zero lands, to the paraxial slope.
    old, old_error = torch.zeros_like(radius), -radius
    slope, error = _kept(landing, old, radius / rate, radius)
    for _ in range(_STEPS):
        done = error.abs() <= _CLOSE * size
        if bool(done.all()):
            break
        change = slope - old
        difference = error - old_error
        flat = (difference == 0.0) | done
        step = torch.where(flat, 0.0, -error * change / torch.where(flat, 1.0, difference))
        if not bool((step != 0.0).any()):
            break
        further, further_error = _kept(landing, slope, slope + step, radius)
        better = further_error.abs() < error.abs()
        # Rounding alone is left where a short step does no good.
        stuck = ~better & (error.abs() <= _ENOUGH * size)
        old, old_error = torch.where(stuck, old, slope), torch.where(stuck, old_error, error)
        slope, error = torch.where(stuck, slope, further), torch.where(stuck, error, further_error)
        if bool((stuck | done).all()):
            break
    bad = ~(error.abs() <= _ENOUGH * size)
    if bool(bad.any()):
        height = float(radius[int(torch.nonzero(bad)[0])])
        raise InputError(f"no chief ray lands at the real image height {height:g} mm")
    return slope


def _kept(
    landing: Callable[[Tensor], Tensor], old: Tensor, new: Tensor, radius: Tensor
) -> tuple[Tensor, Tensor]:
    """Return slopes on the way from old to new whose rays arrive, and by how much they miss."""
    error = landing(new) - radius
    for _ in range(_HALVINGS):
        lost = error.isnan()
        if not bool(lost.any()):
            break
        new = torch.where(lost, 0.5 * (old + new), new)
        error = landing(new) - radius
    return new, error


def _from_stop(lens: Lens, slope: Tensor, sense: float) -> Rays:
    """Return rays in the y-z plane at the stop's vertex, in the medium before it."""
    zero = torch.zeros_like(slope)
    z = lens.system().vertices[lens.stop - 1].detach().expand_as(slope)
    direction = sense * torch.stack((zero, slope, torch.ones_like(slope)), -1)
    direction = direction / direction.norm(dim=-1, keepdim=True)
    return Rays(torch.stack((zero, zero, z), -1), direction, lens.primary_wavelength)


@torch.no_grad()
def with_aperture(
    lens: Lens, f_number: float | None = None, entrance_pupil_diameter: float | None = None
) -> Lens:
    """Return a copy of a lens whose stop makes a given pupil; the lens itself where none is given.

    The stop's semi-diameter becomes the one whose paraxial image has the diameter asked for at the
    reference wavelength.  Other apertures stay as they are, and may clip what a wider stop passes.

    Args:
        lens: the lens.
        f_number: EFL over the diameter of the entrance pupil, both of the y-z section; or
        entrance_pupil_diameter: mm.

    Raises:
        InputError: both are given, one is not positive, the stop is no circle, or no stop on its
            surface makes this pupil.
    """
    either = {"f_number": f_number, "entrance_pupil_diameter": entrance_pupil_diameter}
    given = {name: value for name, value in either.items() if value is not None}
    if not given:
        return lens
    if len(given) > 1:
        raise InputError("give f_number or entrance_pupil_diameter, not both")
    ((name, target),) = given.items()
    if not (target > 0.0 and math.isfinite(target)):
        raise InputError(f"{name} must be positive, not {target}")
    lens = lens.storing_its_values()
    exact = copy.deepcopy(lens).to(torch.float64)
    first = exact.first_order(lens.primary_wavelength, meridian="y")
    diameter = abs(float(first.efl)) / target if name == "f_number" else target
    surface = lens.surfaces[str(lens.stop)]
    if not isinstance(surface.aperture.edge, Circle):
        raise InputError(f"{name} needs a circular stop; surface {lens.stop} has another edge")
    size = surface.semi_diameter * diameter / float(first.entrance_pupil.diameter)
    if not (math.isfinite(size) and size > 0.0):
        raise InputError(f"{name} {target:g}: no size of the stop makes this pupil")
    try:
        lens.stop_note = ""
        surface.aperture = surface.aperture.resized(size)
        surface.check_aperture()
    except InputError as error:
        raise InputError(f"{name} {target:g}: stop surface {lens.stop}: {error}") from None
    return lens


@torch.no_grad()
def real_marginal_height(lens: Lens, paraxial: float) -> float:
    """Return how far from the axis (mm) the real marginal ray crosses the stop, at the reference
    wavelength and whatever the apertures are.

    Args:
        lens: its reference wavelength and object distance count.
        paraxial: where the paraxial marginal ray crosses the stop, mm.

    Raises:
        InputError: the ray does not reach the stop.
    """
    system = lens.system().opened().traced_by("reference")
    stop = system.surfaces[lens.stop - 1]
    surfaces = list(system.surfaces)
    surfaces[lens.stop - 1] = replace(
        stop, aperture=replace(stop.aperture, edge=Unlimited(paraxial))
    )
    system = replace(system, surfaces=surfaces)
    wavelength = lens.primary_wavelength
    # The height at the stop is a·y + b·n·u of a ray that meets the first vertex at y with slope u.
    (a, b), _ = matrix_to_stop(system.section("y"), wavelength).tolist()
    if lens.object_distance is None or vergence(lens.object_distance) == 0.0:
        start, slope = [0.0, paraxial / abs(a), 0.0], 0.0
    else:
        distance = float(lens.object_distance)
        index = float(lens.materials[0].index(wavelength))
        start, slope = [0.0, 0.0, -distance], paraxial / abs(a * distance + b * index)
    length = math.hypot(1.0, slope)
    position = torch.tensor([start], dtype=torch.float64)
    direction = torch.tensor([[0.0, slope / length, 1.0 / length]], dtype=torch.float64)
    hit = trace_rays(system, Rays(position, direction, wavelength), 1.0, True, 1, lens.stop)
    if int(hit.status[0]) != Status.OK:
        raise InputError(
            "the real marginal ray, which gives the stop its size ('real_pupil'), does not reach it"
        )
    assert hit.points is not None  # they were recorded
    at = hit.points[-1][0]
    local = from_lens_axes(Components(*at, *direction[0].to(at)), system.axes[lens.stop - 1])
    return float(torch.hypot(local.x, local.y))
