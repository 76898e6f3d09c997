"""Lenses of all that a prescription can hold, and rays of all that a program can ask for.

They are drawn apart from `random_lenses`, whose seeds are meant to keep their lenses.
"""

import math

import torch

from dolens import InputError, Lens, Rays
from dolens.optics.packing import unsupported
from dolens.prescriptions import lens_from_prescription
from tests.optics.random_lenses import KINDS, SAG_KINDS, Draw, fits, prescription, random_rays

SHAPES = tuple(dict.fromkeys((*KINDS, *SAG_KINDS, "paraxial_lens", "coordinate_break")))
_PLAIN = tuple(kind for kind in SHAPES if kind not in ("paraxial_lens", "coordinate_break"))
PHASES = ("grating", "radial", "xy", "zernike_fringe", "zernike_standard")


def phase(draw: Draw, radius: float) -> dict:
    """A phase that turns light by up to some 0.3 at the edge, or in wild lenses by any angle."""
    kind = draw.one_of(PHASES)
    row = {"type": kind, "order": draw.one_of((-2, -1, 0, 1, 1, 3))}
    if kind == "grating":
        return row | {"grooves": abs(draw.size(300.0, 1.5))}
    # Radians over the radius in mm, in waves of half a micrometre.
    steep = 0.1 * radius * 2.0 * math.pi / 550e-6
    row["norm_radius"] = radius * draw.one_of((0.7, 1.0, 2.5))
    names = {
        "radial": ("p2", "p4", "p10"),
        "xy": ("x", "y", "x2", "xy", "x2y", "y4"),
        "zernike_fringe": ("z2", "z4", "z8", "z16"),
        "zernike_standard": ("z3", "z5", "z11", "z22"),
    }[kind]
    # Unlike a constant, some term must be there.
    for number, name in enumerate(names):
        if number == 0 or draw.chance(0.5):
            row[name] = draw.size(steep / len(names), 1.5)
    return row


def aperture(draw: Draw, radius: float) -> dict:
    """An aperture or obscuration of the shapes that `random_lenses` does not draw."""
    x, y = radius * draw.between(-0.2, 0.2), radius * draw.between(-0.2, 0.2)
    turn = [2.0 * math.pi * k / 5.0 for k in range(5)]
    corners = [[radius * math.cos(a), 0.8 * radius * math.sin(a)] for a in turn]
    return draw.one_of((
        {"aperture": {"semi_axis_x": radius, "semi_axis_y": 0.6 * radius}},
        {"aperture": {"polygons": [corners]}},
        {"aperture": {"semi_axis_x": 0.8 * radius, "semi_axis_y": 0.6 * radius,
                      "decenter_x": x, "decenter_y": y}},
        {"obscuration": {"inner_semi_diameter": 0.2 * radius, "semi_diameter": 0.4 * radius}},
        {"obscuration": [{"width": 0.05 * radius, "arms": 3, "angle": draw.between(0.0, 90.0)},
                         {"semi_diameter": 0.2 * radius, "decenter_x": x}]},
    ))  # fmt: skip


def system(draw: Draw) -> dict:
    """A prescription of any surfaces, with phases, mirrors, breaks and a curved sensor."""
    found = prescription(draw)
    rows = list(found["surfaces"].values())
    sense = 1.0
    for number, row in enumerate(rows):
        radius = row.get("semi_diameter") or max(row["aperture"].values())
        if draw.chance(0.1):
            kept = {key: row[key] for key in ("material", "thickness") if key in row}
            row = rows[number] = {"type": "paraxial_lens", "semi_diameter": radius, **kept,
                                  "focal_length": math.copysign(
                                      radius * draw.between(1.5, 20.0), draw.between(-1.0, 1.0)
                                  )}  # fmt: skip
        elif row["type"] != "aperture" and draw.chance(0.25):
            row["phase"] = phase(draw, radius)
        if draw.chance(0.2):
            more = aperture(draw, radius)
            if "aperture" in more:
                row.pop("semi_diameter", None)
            row.update(more)
        if row["type"] not in ("aperture", "paraxial_lens") and draw.chance(0.2):
            row["material"] = "mirror"
            sense = -sense
        if "thickness" in row:
            row["thickness"] *= sense
    found["sensor"]["distance"] *= sense
    if draw.chance(0.3):
        distance = abs(found["sensor"]["distance"])
        found["sensor"] |= {"radius": draw.one_of((-3.0, 5.0)) * distance,
                            "conic": draw.between(-1.0, 1.0)}  # fmt: skip
    if not found["elements"] and draw.chance(0.5):
        place = draw.one_of(range(len(rows)))
        degrees = 60.0 if draw.wild else 5.0
        rows.insert(place, {
            "type": "coordinate_break", "thickness": 0.0,
            "tilt_x": draw.between(-degrees, degrees), "tilt_y": draw.between(-degrees, degrees),
            "decenter_x": 0.1 * draw.size(1.0, 0.5),
        })  # fmt: skip
    first = next(i for i, row in enumerate(rows, 1) if row["type"] != "coordinate_break")
    surfaces = {str(i): row for i, row in enumerate(rows, 1)}
    return {**found, "surfaces": surfaces, "stop": first}


def random_system(seed: int, wild: bool) -> tuple[Lens, Draw]:
    """A lens in double precision, and the random numbers that follow."""
    draw = Draw(1_000_003 + 2 * seed + int(wild), wild, _PLAIN)
    while True:
        try:
            lens = lens_from_prescription(system(draw))
        except InputError:
            continue  # as where an aperture is beyond the surface's end
        # Some phases have kernels on some shapes only.
        sizes = (p.detach().abs() for p in lens.parameters())
        if unsupported(lens.system()) is None and all(map(fits, sizes)):
            return lens, draw


def any_rays(lens: Lens, draw: Draw, count: int, sense: float) -> Rays:
    """Those of `random_rays`, one in 64 of them with a number that no light has."""
    rays = random_rays(lens, draw, count, sense)
    position, direction = rays.position.clone(), rays.direction.clone()
    odd = torch.arange(count) % 64
    direction[odd == 8] = 0.0
    direction[odd == 16] *= 1e-30
    position[odd == 24] *= 1e9
    position[odd == 32] -= 1e12 * direction[odd == 32]
    position[odd == 40, 0] = math.nan
    position[odd == 41] -= 1e28 * direction[odd == 41]
    position[odd == 42] -= 1e34 * direction[odd == 42]
    direction[odd == 48, 2] = math.nan
    direction[odd == 49, 2] = math.inf
    direction[odd == 50] *= 1e25
    position[odd == 56, 1] = -math.inf
    direction[odd == 57] *= -1.0
    direction[odd == 58, 2] = 0.0  # along the vertex plane
    # Of a direction of another length, each backend has derivatives of its own.
    direction[odd == 58] = torch.nn.functional.normalize(direction[odd == 58])
    return Rays(position, direction, rays.wavelength)
