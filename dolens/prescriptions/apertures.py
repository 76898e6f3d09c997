"""Clear apertures of surfaces are read from a prescription and written to it.

A surface gives `semi_diameter`, or `aperture` with a rectangle, an ellipse, a circle or polygons,
which may be beside the vertex, or both, where light must pass both; `obscuration` is what is
blocked, by one outline or by a list of them, each with a centre of its own::

    '1': {type: plane, semi_diameter: 6.35, obscuration: {semi_diameter: 2.0}, ...}
    '2': {type: plane, aperture: {half_width_x: 5.0, half_width_y: 4.0}, ...}
    '3': {type: plane, aperture: {semi_axis_x: 5.0, semi_axis_y: 7.0, decenter_y: 30.0}, ...}
    '4': {type: sphere, radius: 20, semi_diameter: 7.0, clips: false, ...}
    '5': {type: sphere, radius: 25, semi_diameter: auto, ...}
    '6': {type: plane, aperture: {polygons: [[[-4, -3], [4, -3], [0, 5]]]}, ...}
    '7': {type: plane, semi_diameter: 100, obscuration: [{semi_diameter: 34},
          {width: 2, arms: 4, angle: 45}, {inner_semi_diameter: 60, semi_diameter: 62}], ...}
    '8': {type: plane, aperture: {blades: 7, semi_diameter: 5.0, angle: 10}, ...}

`blades` are those of an iris: a regular polygon whose corners lie on a circle, the first at an
`angle` (degrees from +x towards +y).  It is written as `polygons`.

`polygons` are lists of vertices [x, y] (mm): light passes inside each of them, and one inside
another is a hole.  A spider has `arms` of a `width` (mm), the first at an `angle` (degrees from +x
towards +y).

A surface that clips nothing is drawn to its semi-diameter, and light passes it wherever it is.
`auto` clips nothing either: when the lens is built, the semi-diameter becomes the one that the
light of the lens's fields needs, to draw the surface and to set the scale of tolerances.  It is the
largest height of real rays through the rim of the
entrance pupil, of all fields and wavelengths.  The real pupil of a wide field may lie far from the
paraxial one: where fewer than half of a field's rays get through, rays are aimed at the rim of the
stop instead.  Where no ray gets through at all, the height is the paraxial one.
"""

import copy
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError, check_keys
from dolens.optics.aiming import aim
from dolens.optics.elements import from_lens_axes
from dolens.optics.field_and_aperture import with_aperture
from dolens.optics.fields import Fields
from dolens.optics.lens import Lens
from dolens.optics.paraxial import vergence
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Components, Rays, TracedRays
from dolens.optics.surfaces.clear_aperture import (
    Circle,
    ClearAperture,
    Ellipse,
    Outline,
    Polygons,
    Rectangle,
    Ring,
    Spider,
    Together,
    Unlimited,
)
from dolens.optics.surfaces.outlines import CENTRE
from dolens.optics.system import OpticalSystem
from dolens.prescriptions.numbers import as_number, as_numbers, require_mapping

APERTURE_KEYS = ("semi_diameter", "clips", "aperture", "obscuration")
AUTOMATIC = "auto"
# Of what is blocked; light is compared with each.
_MOST_PARTS = 1000
# Stands for an automatic semi-diameter (mm) until the light of the fields is known.
_NOT_YET_KNOWN = 1.0
_BLADES: Any = Polygons.of_blades
# Keys of an outline, all of them necessary, and what is made of their numbers.
_OUTLINES: tuple[tuple[tuple[str, ...], Any], ...] = (
    (("semi_diameter",), Circle),
    (("half_width_x", "half_width_y"), Rectangle),
    (("semi_axis_x", "semi_axis_y"), Ellipse),
    (("polygons",), Polygons),
    (("blades", "semi_diameter"), _BLADES),
)
_BLOCKING: tuple[tuple[tuple[str, ...], Any], ...] = (
    (("inner_semi_diameter", "semi_diameter"), Ring),
    *_OUTLINES,
    (("width", "arms"), Spider),
)
_OPTIONAL: dict[Any, tuple[str, ...]] = {Spider: ("angle",), _BLADES: ("angle",)}
_CENTER = ("decenter_x", "decenter_y")
# Points of the pupil's rim.
_RIM = 16
# Where nothing tells a size, mm.
_UNKNOWN = 1.0
# Of the light's height: a drawn semi-diameter below is not where the light is.
_TINY = 0.01


def clear_aperture(row: Mapping[str, Any], place: str) -> ClearAperture:
    """Read the clear aperture of a surface from its row.

    Raises:
        InputError: none is given, or one that clips nothing has an outline, or a length is not
            positive.
    """
    size, outline = row.get("semi_diameter"), row.get("aperture")
    if size is None and outline is None:
        raise InputError(
            f"{place}: 'semi_diameter' is missing (mm, or {AUTOMATIC}: as the fields need it)"
        )
    clips = row.get("clips", not is_automatic(row))
    if not isinstance(clips, bool):
        raise InputError(f"{place}: 'clips' must be true or false, not {clips!r}")
    if clips and is_automatic(row):
        raise InputError(f"{place}: an automatic semi-diameter clips nothing ('clips: false')")
    if outline is not None and (not clips or is_automatic(row)):
        raise InputError(f"{place}: 'aperture' clips: it goes with no 'clips: false' and no 'auto'")
    centers = []
    edge: Outline | None = None
    window: Outline | None = None
    hole: Outline | None = None
    if size is not None:
        length = (
            _NOT_YET_KNOWN if is_automatic(row) else as_number(size, f"{place}: 'semi_diameter'")
        )
        edge = Circle(length) if clips else Unlimited(length)
    if outline is not None:
        window, center = _outline(outline, _OUTLINES, f"{place}: 'aperture'")
        centers.append(center)
    if row.get("obscuration") is not None:
        hole, center = _obscuration(row["obscuration"], f"{place}: 'obscuration'")
        centers.append(center)
    center = centers[0] if centers else (0.0, 0.0)
    if len(centers) == 2 and any(centers[1]) and centers[1] != center:
        hole = Together(((hole, centers[1]),))
    if isinstance(hole, Together) and len(hole.parts) == 1 and outline is None:
        [(hole, center)] = hole.parts
    elif isinstance(hole, Together):
        # Its parts have centres of their own.
        parts = tuple((part, (x - center[0], y - center[1])) for part, (x, y) in hole.parts)
        hole = parts[0][0] if len(parts) == 1 and parts[0][1] == CENTRE else Together(parts)
    if edge is None:
        edge, window = window, None
        if isinstance(edge, Circle) and any(center):
            edge = Ellipse(edge.semi_diameter, edge.semi_diameter)
    elif isinstance(window, Circle):
        window = Ellipse(window.semi_diameter, window.semi_diameter)
    assert edge is not None  # one of the two is given
    try:
        return ClearAperture(edge, hole, window, center)
    except InputError as error:
        raise InputError(f"{place}: {error}") from None


def is_automatic(row: Mapping[str, Any]) -> bool:
    """Return whether a row leaves its semi-diameter to the light of the fields."""
    return row.get("semi_diameter") == AUTOMATIC


def aperture_rows(aperture: ClearAperture) -> dict[str, Any]:
    """Return the keys of a surface's row that `clear_aperture` reads back."""
    rows: dict[str, Any] = {}
    beside = {key: value for key, value in zip(_CENTER, aperture.center, strict=True) if value}
    outline = aperture.window
    if isinstance(aperture.edge, Circle | Unlimited):
        rows["semi_diameter"] = aperture.edge.semi_diameter
        if not aperture.clips:
            rows["clips"] = False
    else:
        outline = aperture.edge
    if outline is not None:
        named: Any = outline  # all that may be here have a row
        rows["aperture"] = named.row() | beside
    hole = aperture.obscuration
    if isinstance(hole, Together):
        parts = [_beside(part.row(), _absolute(at, aperture.center)) for part, at in hole.parts]
        alone = len(parts) == 1 and not parts[0].keys().isdisjoint(_CENTER)
        rows["obscuration"] = parts[0] if alone else parts
    elif hole is not None:
        rows["obscuration"] = hole.row() | (beside if outline is None else {})
    return rows


def _beside(row: dict[str, Any], center: tuple[float, ...]) -> dict[str, Any]:
    """Return an outline's row with the place of its centre."""
    return row | {key: value for key, value in zip(_CENTER, center, strict=True) if value}


def _absolute(relative: tuple[float, float], center: tuple[float, float]) -> tuple[float, ...]:
    """Return the place whose difference from a centre is this one to the last bit."""
    found = []
    for part, middle in zip(relative, center, strict=True):
        guess = part + middle
        near = (guess, math.nextafter(guess, -math.inf), math.nextafter(guess, math.inf))
        found.append(next((x for x in near if x - middle == part), guess))
    return tuple(found)


def _obscuration(value: object, place: str) -> tuple[Outline, tuple[float, float]]:
    """Return what is blocked, and the centre of it: that of the vertex where there are several."""
    if not isinstance(value, list | tuple):
        return _outline(value, _BLOCKING, place)
    if not value:
        raise InputError(f"{place}: is an empty list")
    if len(value) > _MOST_PARTS:
        raise InputError(f"{place}: has {len(value)} parts (allowed: {_MOST_PARTS} at most)")
    parts = [_outline(part, _BLOCKING, f"{place} {number}") for number, part in enumerate(value, 1)]
    return Together(tuple(parts)), (0.0, 0.0)


def _outline(
    value: Any, outlines: tuple[tuple[tuple[str, ...], Any], ...], place: str
) -> tuple[Outline, tuple[float, float]]:
    """Return an outline, one of some kinds, and the centre of it."""
    require_mapping(value, place)
    optional = [key for _, make in outlines for key in _OPTIONAL.get(make, ())]
    known = dict.fromkeys((*(key for keys, _ in outlines for key in keys), *optional, *_CENTER))
    check_keys(value, tuple(known), place)
    x, y = (as_number(value.get(key, 0.0), f"{place}: '{key}'") for key in _CENTER)
    given = [entry for entry in outlines if any(key in value for key in entry[0])]
    # A ring and an iris have a semi-diameter, too: their first key tells them from a circle.
    given = [(k, make) for k, make in given if k[0] in value or "semi_diameter" not in k]
    if any("semi_diameter" in k[1:] for k, _ in given):
        given = [entry for entry in given if entry[1] is not Circle]
    if len(given) != 1:
        kinds = dict.fromkeys(" and ".join(keys) for keys, _ in outlines)
        raise InputError(f"{place}: give one of {', '.join(kinds)}")
    keys, make = given[0]
    for key in keys:
        if value.get(key) is None:
            raise InputError(f"{place}: '{key}' is missing (mm)")
    taken = (*keys, *_OPTIONAL.get(make, ()))
    check_keys(value, (*taken, *_CENTER), place)
    numbers = {key: value[key] for key in taken if value.get(key) is not None}
    try:
        if make is Polygons:
            return Polygons(_vertices(numbers["polygons"], f"{place}: 'polygons'")), (x, y)
        given_by_numbers: Any = make
        read = {k: as_number(v, f"{place}: '{k}'") for k, v in numbers.items()}
        return given_by_numbers(**read), (x, y)
    except InputError as error:
        message = str(error)
        raise InputError(message if message.startswith(place) else f"{place}: {message}") from None


def _vertices(value: object, place: str) -> tuple[tuple[tuple[float, float], ...], ...]:
    """Return the vertices of polygons."""
    found = as_numbers(value, place)
    polygons = found if isinstance(found, list) else []
    for polygon in polygons:
        if not isinstance(polygon, list) or not all(
            isinstance(vertex, list)
            and len(vertex) == 2
            and not any(isinstance(number, list) for number in vertex)
            for vertex in polygon
        ):
            polygons = []
            break
    if not polygons:
        raise InputError(f"{place}: must be a list of lists of vertices [x, y] (mm)")
    return tuple(tuple((x, y) for x, y in polygon) for polygon in polygons)


def with_iris(lens: Lens, blades: int, angle: float = 0.0, f_number: float | None = None) -> Lens:
    """Return a copy of a lens whose stop has an iris of straight blades, their corners on its
    circle.

    Args:
        lens: it stays as it is.
        blades: how many, 3 to 100.
        angle: of the first corner, degrees from +x towards +y.
        f_number: of the circle; None: as it is.

    Raises:
        InputError: a number out of range, or a stop that is no circle.
    """
    found = copy.deepcopy(with_aperture(lens, f_number))
    stop = found.surfaces[str(found.stop)]
    if not isinstance(stop.aperture.edge, Circle) or stop.aperture.window is not None:
        raise InputError(f"lens '{lens.name}': an iris needs a stop whose edge is a circle")
    window = Polygons.of_blades(blades, stop.aperture.semi_diameter, angle)
    stop.aperture = replace(stop.aperture, window=window)
    return found


@torch.no_grad()
def set_automatic_semi_diameters(lens: Lens, prescription: Mapping[str, Any]) -> Lens:
    """Give the surfaces of a new lens the semi-diameters that its prescription leaves to the light.

    A surface that clips nothing is also drawn no farther than it reaches, whatever its prescription
    says, and where what it says is nothing beside the light, as far as the light goes.
    """
    rows = {str(n): row for n, row in prescription["surfaces"].items()}
    # The stop has its size from the pupil, and clips.
    others = [n for n in lens.surfaces if n in rows and n != str(lens.stop)]
    automatic = [n for n in others if is_automatic(rows[n])]
    automatic += _too_small(lens, [n for n in others if n not in automatic])
    if automatic:
        heights = _paraxial_heights(lens)
        for n in automatic:
            _resize(lens, n, heights[n])
        heights = heights | _real_heights(lens)
        for n in automatic:
            _resize(lens, n, heights[n])
    for n, surface in lens.surfaces.items():
        if not surface.aperture.clips and surface.semi_diameter > surface.reach:
            _resize(lens, n, surface.reach)
    return lens


def set_common_semi_diameters(lenses: Sequence[Lens], numbers: Iterable[str]) -> None:
    """Give automatic semi-diameters of states of one lens the largest value of all.

    Args:
        lenses: the lens as each of its states has it.
        numbers: of the surfaces.
    """
    for n in numbers:
        largest = max(lens.surfaces[n].semi_diameter for lens in lenses)
        for lens in lenses:
            _resize(lens, n, largest)


def _too_small(lens: Lens, numbers: Sequence[str]) -> list[str]:
    """Return the surfaces that clip nothing and whose semi-diameter cannot be meant for the light:
    programs give a tiny one to what is not to be drawn.
    """
    sizes = {n: surface.semi_diameter for n, surface in lens.surfaces.items()}
    free = [n for n in numbers if not lens.surfaces[n].aperture.clips]
    least = _TINY * max(sizes.values())
    small = [n for n in free if sizes[n] < least]
    heights = _paraxial_heights(lens) if small else {}
    return [n for n in small if sizes[n] < _TINY * heights[n]]


def _resize(lens: Lens, number: str, semi_diameter: float) -> None:
    surface = lens.surfaces[number]
    if not (math.isfinite(semi_diameter) and semi_diameter > 0.0):
        semi_diameter = _UNKNOWN
    edge = Unlimited(min(semi_diameter, surface.reach))
    surface.aperture = replace(surface.aperture, edge=edge)


def _fields(lens: Lens) -> Fields:
    if lens.fields is not None:
        return lens.fields
    return Fields("angles" if vergence(lens.object_distance) == 0.0 else "heights", ((0.0, 0.0),))


def _points(lens: Lens) -> Tensor:
    """Return the field points as `Lens.aim` takes them, (F, 2)."""
    fields = _fields(lens)
    points = torch.tensor(fields.points, dtype=lens.dtype)
    near = vergence(lens.object_distance)
    if fields.kind == "heights" or near == 0.0:
        return points
    return -torch.deg2rad(points).tan() / near


def _paraxial_heights(lens: Lens) -> dict[str, float]:
    """Return |y| + |ȳ| of the marginal and the chief ray at every surface; of fields from the side,
    which have no paraxial chief ray, the marginal ray's alone.
    """
    points = _points(lens)
    if _fields(lens).from_the_side:
        points = torch.where(points.abs() < 90.0, points, 0.0)
    field = float(points.norm(dim=-1).max())
    rays = lens.paraxial_rays(field, lens.primary_wavelength, lens.object_distance)
    heights = (rays.marginal.height.abs() + rays.chief.height.abs()).tolist()
    return dict(zip(lens.surfaces, heights, strict=True))


def _real_heights(lens: Lens) -> dict[str, float]:
    """Return the largest height of real rays at every surface: from every field to the rim of the
    paraxial entrance pupil, or of what vignetting factors leave of it.

    Light from the side never crosses that pupil, and of a wide field half the rays may miss: such
    rays are aimed at the rim of the stop.
    """
    points, fields = _points(lens), _fields(lens)
    pupil = lens.first_order(lens.primary_wavelength).entrance_pupil
    if not (fields.from_the_side or math.isfinite(float(pupil.z))):
        return {}
    angle = torch.arange(_RIM, dtype=lens.dtype) * (2.0 * math.pi / _RIM)
    rim = torch.stack((angle.sin(), angle.cos()), -1).expand(len(points), _RIM, 2)
    if fields.vignetting is not None:
        rim = torch.stack([of.on_stop(one) for of, one in zip(fields.vignetting, rim, strict=True)])
        rim = rim / rim.norm(dim=-1, keepdim=True).clamp(min=1.0)
    waves = torch.tensor(lens.wavelengths or (lens.primary_wavelength,), dtype=torch.float64)
    system = lens.system().opened().traced_by("reference")
    if fields.from_the_side:
        return _heights_of(system, [_aimed(lens, system, points, rim, waves)])
    # An inverted pupil has the rim of an upright one.
    at = torch.cat([0.5 * pupil.diameter * rim, pupil.z.expand(*rim.shape[:-1], 1)], -1)
    distance = lens.object_distance
    if distance is None or vergence(distance) == 0.0:
        towards = torch.cat([torch.deg2rad(points).tan(), torch.ones_like(points[:, :1])], -1)
        towards = towards[:, None].expand_as(at)
    else:
        start = torch.full_like(points[:, :1], -float(distance))
        towards = at - torch.cat([points, start], -1)[:, None]
        towards = torch.where(towards[..., 2:] < 0.0, -towards, towards)
    towards = towards / towards.norm(dim=-1, keepdim=True)
    traced = [trace_rays(system, Rays(at[:, :, None], towards[:, :, None], waves), 1.0, True)]
    missing = traced[0].valid.double().mean((1, 2)) < 0.5
    if bool(missing.any()):
        traced.append(_aimed(lens, system, points[missing], rim[missing], waves))
    return _heights_of(system, traced)


def _aimed(
    lens: Lens, system: OpticalSystem, points: Tensor, rim: Tensor, waves: Tensor
) -> TracedRays:
    """Trace rays of field points (F, 2) that are aimed at points (F, N, 2) of the stop."""
    field = _radians(lens, points)[:, None, None]
    rays = aim(system, field, rim[:, :, None], waves, lens.object_distance)
    hit = trace_rays(system, rays, 1.0, True)
    return replace(hit, valid=hit.valid & rays.converged)


def _heights_of(system: OpticalSystem, traced: Sequence[TracedRays]) -> dict[str, float]:
    """Return the largest height of rays at every surface; nothing where none gets through."""
    passed = torch.cat([h.points[:, h.valid] for h in traced if h.points is not None], 1)
    if not passed.shape[1]:
        return {}
    found = {}
    for number, (axes, point) in enumerate(zip(system.axes, passed, strict=True), 1):
        x, y, z = point.unbind(-1)
        local = from_lens_axes(Components(x, y, z, x, y, z), axes)
        found[str(number)] = float(torch.hypot(local.x, local.y).max())
    return found


def _radians(lens: Lens, points: Tensor) -> Tensor:
    """Return field points as `dolens.optics.aiming.aim` takes them: radians or mm."""
    return torch.deg2rad(points) if vergence(lens.object_distance) == 0.0 else points
