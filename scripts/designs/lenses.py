"""A design of others as a lens of dolens, and what it is by dolens's own rays."""

import math
from dataclasses import dataclass, replace

import torch

from dolens.analysis.pupil_quadrature import SpotRays, gaussian_rings
from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.rays import Rays
from dolens.optimize.merit import evaluate_operands
from dolens.optimize.operands import operand
from dolens.prescriptions import lens_from_prescription
from scripts.designs.files import Design, Surface
from scripts.designs.glass import HartmannGlass

# Where nothing is known of an aperture, mm; or this part of where the surface ends.  Edges are put
# where light passes.
_OPEN, _INSIDE = 1e3, 0.999
# Room beside the beams at every edge, so that only the stop clips.
_BESIDE = 1.005
# Rings and arms of the rays that spots are measured with; rays begin so far in front, mm.
_RINGS, _ARMS, _AHEAD = 10, 20, 5.0


def lens_of(design: Design) -> Lens:
    """Return the lens, in double precision, with edges beside the light of its beams.

    Raises:
        InputError: rays do not pass.
    """
    rows: dict[str, dict[str, object]] = {}
    for number, surface in enumerate(design.surfaces, 1):
        row: dict[str, object] = {"semi_diameter": _open(surface), "material": "air"}
        if surface.curvature is None:
            row["type"] = "aperture"
        else:
            row["type"] = "even_asphere" if surface.terms else "sphere"
            row["radius"] = 1.0 / surface.curvature if surface.curvature else math.inf
            if surface.terms:
                row["conic"] = surface.terms[0]
                row |= {f"a{4 + 2 * n}": t for n, t in enumerate(surface.terms[1:])}
        if surface.phase is not None:
            terms, radius = surface.phase
            named = {f"p{2 + 2 * n}": t for n, t in enumerate(terms)}
            row |= {"type": "plane", "phase": {"type": "radial", "norm_radius": radius, **named}}
        if surface.glass is not None:
            row["material"] = f"{design.glasses[surface.glass][0]:.8g}"
        if number < len(design.surfaces):
            row["thickness"] = surface.space
        rows[str(number)] = row
    weights = dict(zip(design.wavelengths, design.weights, strict=True))
    others = [w for w in design.wavelengths if w != design.wavelength]
    lens = lens_from_prescription(
        {
            "name": design.name,
            "index_model": "dfc",
            "stop": stop_of(design),
            "wavelengths": [design.wavelength, *others],
            "wavelength_weights": [weights.get(w, 0.0) for w in (design.wavelength, *others)],
            "reference_wavelength": design.wavelength,
            "fields": {"angles": design.angles},
            "surfaces": rows,
            "sensor": {"distance": design.surfaces[-1].space, "diameter": 2.0 * _OPEN},
        },
        torch.float64,
        where=design.name,
    )
    media = [HartmannGlass.of(*glass) for glass in design.glasses]
    behind = [lens.materials[0]]
    for surface, medium in zip(design.surfaces, lens.materials[1:], strict=True):
        behind.append(medium if surface.glass is None else media[surface.glass])
    lens.materials = tuple(behind)
    set_edges(lens, design)
    return lens


def stop_of(design: Design) -> int:
    """Return the number of the stop among the lens's surfaces."""
    return 1 + next(n for n, s in enumerate(design.surfaces) if s.curvature is None)


def _open(surface: Surface) -> float:
    """Return a semi-diameter inside the surface, mm."""
    square = (surface.curvature or 0.0) ** 2 * (1.0 + (surface.terms[0] if surface.terms else 0.0))
    return min(_OPEN, _INSIDE / math.sqrt(square)) if square > 0.0 else _OPEN


@torch.no_grad()
def beams(lens: Lens, design: Design, rings: int = _RINGS, arms: int = _ARMS) -> SpotRays:
    """Return rays of every field and wavelength through the paraxial entrance pupil.

    A field stop in object space, as wide as the pupil, leaves the lower part of a pupil dark; what
    is left is taken for an ellipse, as the designs' authors take it.

    Args:
        lens: whose entrance pupil it is.
        design: says how wide it is, and what fields and wavelengths there are.
        rings: radii of Gaussian quadrature; 1 is the rim alone.
        arms: of the whole pupil, even; one half stands for both.
    """
    radii, shares = gaussian_rings(rings, rim=rings == 1)
    angle = (torch.arange(arms // 2).double() + 0.5) * (2.0 * math.pi / arms) - 0.5 * math.pi
    unit = torch.stack((angle.cos(), angle.sin()), -1)
    disc = (radii[:, None, None] * unit).reshape(-1, 2)
    weight = shares[:, None].expand(-1, arms // 2).reshape(-1)
    weight = weight / weight.sum()
    width = pupil_of(lens, design)
    place = float(lens.first_order(design.wavelength).entrance_pupil.z)
    positions, directions, light = [], [], []
    for _, degrees in design.angles:
        theta = math.radians(degrees)
        lost = 0.0
        if design.field_stop is not None:
            stop = design.field_stop + before_lens(lens, design)
            lost = max(place - stop, 0.0) * math.tan(theta)
        scale = torch.tensor([1.0 - 0.5 * lost / width, 1.0 - lost / width], dtype=torch.float64)
        point = 0.5 * width * disc * scale + torch.tensor([0.0, 0.5 * lost])
        direction = torch.tensor([0.0, math.sin(theta), math.cos(theta)], dtype=torch.float64)
        start = torch.cat([point, torch.full_like(point[:, :1], place)], 1)
        positions.append(start - direction * ((start[:, 2:] + _AHEAD) / direction[2]))
        directions.append(direction.expand(start.shape))
        light.append(float(scale.prod()))
    waves = torch.tensor(design.wavelengths, dtype=torch.float64)
    fields = torch.tensor(design.angles, dtype=torch.float64)
    colours, rays = len(waves), len(disc)
    spots = len(fields) * colours
    axis = (fields == 0.0).repeat_interleave(colours, 0)
    return SpotRays(
        Rays(
            torch.stack(positions).repeat_interleave(colours, 0).flatten(0, 1),
            torch.stack(directions).repeat_interleave(colours, 0).flatten(0, 1),
            waves.repeat(len(fields)).repeat_interleave(rays),
        ),
        torch.arange(spots).repeat_interleave(rays),
        weight.repeat(spots),
        fields.repeat_interleave(colours, 0),
        waves.repeat(len(fields)),
        axis,
        spots * rays,
        torch.tensor(light, dtype=torch.float64).repeat_interleave(colours),
    )


@torch.no_grad()
def set_edges(lens: Lens, design: Design) -> None:
    """Put every edge beside the light of the beams.

    Raises:
        InputError: a ray does not pass.
    """
    for surface, read in zip(lens.surfaces.values(), design.surfaces, strict=True):
        now = read
        if read.refracting is not None:
            now = replace(read, curvature=float(surface.curvature))
        surface.aperture = surface.aperture.resized(_open(now))
    hit = lens.trace(beams(lens, design, 1).rays, record=True)
    if not bool(hit.valid.all()):
        raise InputError(f"{design.name}: {int((~hit.valid).sum())} rays at the rim do not pass")
    sizes = hit.points[..., :2].norm(dim=-1).flatten(1).amax(1)
    for surface, size in zip(lens.surfaces.values(), sizes.tolist(), strict=True):
        surface.aperture = surface.aperture.resized(_BESIDE * size)


def _first(design: Design) -> int:
    """Return the number of the first surface that refracts."""
    return 1 + next(n for n, s in enumerate(design.surfaces) if s.refracting is not None)


def pupil_of(lens: Lens, design: Design) -> float:
    """Return the diameter of the entrance pupil, mm."""
    if design.pupil is not None:
        return design.pupil
    assert design.f_number is not None  # one of both is there
    return float(lens.first_order(design.wavelength).efl) / design.f_number


@dataclass(frozen=True)
class Measures:
    """What a lens is.

    Attributes:
        efl: mm.
        f_number: EFL over the diameter of the entrance pupil.
        track: mm, from the first refracting vertex to the image.
        total: mm, from the first surface, which may be the stop, to the image.
        back: mm, from the last vertex to the image.
        distortion: largest share that chief rays are from f·tan θ, with the f that is asked for.
        glass: least and largest on the axis, and least at an edge, mm.
        air: least on the axis and least at an edge, mm.
        spots: RMS about the polychromatic centroid at each field, µm.
        incidence: largest angle of a ray with a normal, on either side, degrees.
        slope: largest angle of a normal with the axis where light passes, degrees.
        light: least share of a field's beam that the field stop leaves.
    """

    efl: float
    f_number: float
    track: float
    total: float
    back: float
    distortion: float
    glass: tuple[float, float, float]
    air: tuple[float, float]
    spots: tuple[float, ...]
    incidence: float
    slope: float
    light: float

    @property
    def mean(self) -> float:
        """Return the mean spot over the fields, µm."""
        return sum(self.spots) / len(self.spots)


@torch.no_grad()
def measures(lens: Lens, design: Design) -> Measures:
    """Return what the lens is by its own rays, its edges as they are.

    Raises:
        InputError: a field whose light does not pass.
    """
    light = beams(lens, design)
    spots = spots_of(lens, design, light)
    incidence, slope = angles_of(lens, design)
    first = lens.first_order(design.wavelength)
    values = values_of(lens, design)
    heights = [1.0 + 0.01 * v for k, v in values.items() if k.startswith("distortion")]
    scale = float(first.efl) / design.focal_length
    by_kind = {
        kind: [v for k, v in values.items() if k.split("/")[0] == kind]
        for kind in ("centre_thickness", "edge_thickness", "air_gap", "edge_air_gap")
    }
    return Measures(
        efl=float(first.efl),
        f_number=float(first.efl) / pupil_of(lens, design),
        track=values["total_track"] - before_lens(lens, design),
        total=values["total_track"],
        back=float(lens.sensor_distance),
        distortion=max((abs(h * scale - 1.0) for h in heights), default=0.0),
        glass=(
            min(by_kind["centre_thickness"]),
            max(by_kind["centre_thickness"]),
            min(by_kind["edge_thickness"]),
        ),
        air=(min(by_kind["air_gap"]), min(by_kind["edge_air_gap"])),
        spots=tuple(spots),
        incidence=incidence,
        slope=slope,
        light=float(light.light.amin()),
    )


@torch.no_grad()
def spots_of(lens: Lens, design: Design, light: SpotRays) -> list[float]:
    """Return the RMS spot of each field about its centroid of all wavelengths, µm.

    Args:
        lens: rays are traced through.
        design: weighs the wavelengths.
        light: rays of its fields and wavelengths, in that order, one half standing for both.

    Raises:
        InputError: a ray does not pass.
    """
    hit = lens.trace(light.rays)
    if not bool(hit.valid.all()):
        raise InputError(f"{design.name}: {int((~hit.valid).sum())} rays do not pass")
    share = torch.tensor(design.weights, dtype=torch.float64)
    share = share / share.sum()
    field, wave = light.spot // len(share), light.spot % len(share)
    weight = light.weight.double() * share[wave]
    # What stands for its mirror image has its centroid in the meridional plane.
    points = hit.position[:, :2].double()
    mean = torch.zeros(design.fields, 2, dtype=torch.float64)
    mean.index_add_(0, field, weight[:, None] * points)
    mean[:, 0] = 0.0
    mean[0, 1] = 0.0
    squares = torch.zeros(design.fields, dtype=torch.float64)
    squares.index_add_(0, field, weight * (points - mean[field]).square().sum(-1))
    return [1e3 * math.sqrt(s) for s in squares.tolist()]


@torch.no_grad()
def angles_of(lens: Lens, design: Design) -> tuple[float, float]:
    """Return the largest angles of incidence or refraction, and of normals with the axis, degrees.

    Rays at the rim of every field's beam are looked at, at all refracting surfaces.
    """
    rays = beams(lens, design, 1).rays
    hit = lens.trace(rays, record=True)
    assert hit.points is not None  # they were asked for
    points = torch.cat([rays.position[None], hit.points, hit.position[None]])
    along = torch.nn.functional.normalize(points.diff(dim=0), dim=-1)
    vertices, incidence, slope = lens.system().vertices, 0.0, 0.0
    for number, read in enumerate(design.surfaces, 1):
        if read.refracting is None:
            continue
        surface = lens.surfaces[str(number)]
        values = {name: value.detach() for name, value in surface.named_parameters()}
        x, y, z = hit.points[number - 1].unbind(-1)
        normal = torch.stack(surface.normal(values, x, y, z - vertices[number - 1]), -1)
        for segment in (along[number - 1], along[number]):
            cosine = (segment * normal).sum(-1).abs().clamp(max=1.0)
            incidence = max(incidence, float(torch.rad2deg(cosine.acos()).amax()))
        steep = normal[:, 2].abs().clamp(max=1.0)
        slope = max(slope, float(torch.rad2deg(steep.acos()).amax()))
    return incidence, slope


def operands_of(design: Design, weight: float = 1.0) -> list[dict[str, object]]:
    """Return settings of operands, without limits, of all that `Measures` and limits speak of.

    Args:
        design: whose fields and spaces they are; spaces that are held are left out.
        weight: of lengths; a per cent of distortion weighs a tenth of a millimetre.
    """
    free = [
        (n, s) for n, s in enumerate(design.surfaces[:-1], 1) if s.spaced not in design.held["s"]
    ]
    glass = [n for n, s in free if s.glass is not None]
    air = [n for n, s in free if s.glass is None and s.spaced is not None]
    found: list[dict[str, object]] = [{"kind": "total_track", "weight": weight}]
    found += [
        {"kind": kind, "gaps": gaps, "weight": weight}
        for kind, gaps in (
            ("centre_thickness", glass),
            ("edge_thickness", glass),
            ("air_gap", air),
            ("edge_air_gap", air),
        )
    ]
    outer = [a for a in design.angles if a[1] > 0.0]
    chosen = {0.5, 0.75, 1.0}
    fields = [a for a in outer if any(abs(a[1] / design.half_field - c) < 0.051 for c in chosen)]
    found += [{"kind": "distortion", "field": a, "weight": 0.1 * weight} for a in fields]
    return found


def values_of(lens: Lens, design: Design) -> dict[str, float]:
    """Return the values of `operands_of`, mm and per cent, by label."""
    settings = [{**entry, "min": -_OPEN} for entry in operands_of(design)]
    found = evaluate_operands([operand(e, lens) for e in settings], lens, None)
    return {label: float(v) for label, v in zip(found.labels, found.tensors, strict=True)}


def before_lens(lens: Lens, design: Design) -> float:
    """Return the distance from the first surface to the first one that refracts, mm."""
    return sum(float(lens.thicknesses[str(n)]) for n in range(1, _first(design)))
