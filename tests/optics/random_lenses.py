"""Lenses and rays at random, from ordinary to wild: every kind of surface, aperture and pose.

A number (the seed) gives a lens and its rays back.
"""

import math

import torch

from dolens import InputError, Lens, Rays
from dolens.prescriptions import lens_from_prescription

KINDS = ("plane", "aperture", "sphere", "conic", "even_asphere", "xy_polynomial", "b_spline")
# Lenses of other kinds are drawn apart, since a seed's lens is meant to stay what it is.
SAG_KINDS = ("sphere", "odd_asphere", "biconic", "toroid", "zernike_standard", "zernike_fringe",
             "q_con", "q_bfs", "grid_sag")  # fmt: skip
ANAMORPHIC = ("biconic", "toroid")
CONICS = ("sphere", "conic", "even_asphere", "odd_asphere", "zernike_standard", "zernike_fringe",
          "q_con", "q_bfs", "grid_sag")  # fmt: skip
MEDIA = ("air", "air", "1.5168/64.17", "1.85/25", "4.0")
MONOMIALS = (("x", 1), ("x2", 2), ("xy", 2), ("y2", 2), ("x3", 3), ("x2y", 3), ("y3", 3),
             ("x4", 4), ("x2y3", 5), ("y6", 6), ("x9", 9))  # fmt: skip
WAVELENGTHS = (486.1327, 587.5618, 656.2725)


class Draw:
    """Random numbers of one seed.

    Args:
        seed: any integer.
        wild: whether `size` spans decades instead of staying near one.
        kinds: of surfaces.
    """

    def __init__(self, seed: int, wild: bool, kinds: tuple[str, ...] = KINDS) -> None:
        self.generator = torch.Generator().manual_seed(seed)
        self.wild = wild
        self.kinds = kinds

    def between(self, low: float, high: float) -> float:
        """One number, evenly distributed."""
        return low + (high - low) * float(torch.rand((), generator=self.generator))

    def one_of(self, things):
        """One of several things."""
        return things[int(torch.randint(len(things), (), generator=self.generator))]

    def chance(self, probability: float) -> bool:
        """True so often."""
        return self.between(0.0, 1.0) < probability

    def size(self, scale: float, decades: float) -> float:
        """A number of either sign, up to `scale`; wild: that times ten to ± the decades."""
        factor = 10.0 ** self.between(-decades, decades) if self.wild else 1.0
        return self.between(-scale, scale) * factor

    def numbers(self, *shape: int) -> torch.Tensor:
        """Evenly distributed on -1 to 1, float64."""
        return 2.0 * torch.rand(shape, generator=self.generator, dtype=torch.float64) - 1.0

    def normal(self, *shape: int) -> torch.Tensor:
        """Normally distributed, float64."""
        return torch.randn(shape, generator=self.generator, dtype=torch.float64)


def surface(draw: Draw, radius: float) -> dict:
    """A row of a prescription, of an aperture that reaches `radius` mm from the vertex."""

    def some(probability: float, scale: float, decades: float) -> float:
        """A number, or zero: a kind's lenses have the same terms, so each kernel is made once."""
        return draw.size(scale, decades) if draw.chance(probability) else 0.0

    kind = draw.one_of(draw.kinds)
    row = {"type": kind, "material": draw.one_of(MEDIA)}
    if kind == "aperture":
        row["material"] = None
    if draw.chance(0.75):
        row["semi_diameter"] = radius
    else:
        angle = draw.between(0.2, 1.3)
        row["aperture"] = {"half_width_x": radius * math.cos(angle),
                           "half_width_y": radius * math.sin(angle)}  # fmt: skip
    if draw.chance(0.15):
        blocked = radius * draw.between(0.05, 0.5)
        row["obscuration"] = draw.one_of(
            (
                {"semi_diameter": blocked},
                {"half_width_x": 0.8 * blocked, "half_width_y": 0.3 * blocked},
            )
        )
    # In units of the aperture; a conic's sag must reach its edge.
    if kind in CONICS:
        conic = 0.0 if kind == "sphere" else draw.size(2.0, 2.0)
        steepest = (1.0 if draw.wild else 0.8) / math.sqrt(max(1.0 + conic, 0.2))
        if draw.wild and conic < -1.0 and draw.chance(0.3):
            steepest *= 10.0 ** draw.between(0.0, 3.0)
        row["curvature"] = steepest * draw.between(-1.0, 1.0) / radius
        if draw.wild and draw.chance(0.1):
            row["curvature"] = math.copysign(steepest / radius, row["curvature"])
        if draw.chance(0.05):
            row["curvature"] = draw.one_of((0.0, 1e-12, -1e-17))
        if kind != "sphere":
            row["conic"] = conic
    if kind in ANAMORPHIC:
        for axis in "xy":
            row[f"curvature_{axis}"] = draw.size(0.6 if draw.wild else 0.5, 1.0) / radius
            row[f"conic_{axis}"] = draw.size(1.0, 1.0)
        if kind == "toroid":
            del row["conic_x"]
    if kind == "toroid" and draw.chance(0.5):
        row["a4"] = draw.size(0.1, 2.0) / radius**3
    if kind == "odd_asphere":
        for power in range(1, 9):
            row[f"a{power}"] = some(0.4, 0.1, 2.0) / radius ** (power - 1)
    if kind in ("zernike_standard", "zernike_fringe"):
        for number in (2, 4, 5, 8):
            row[f"z{number}"] = some(0.5, 0.02, 2.0) * radius
        row["decenter_x"] = draw.size(0.2, 1.0) * radius if draw.chance(0.5) else 0.0
    if kind in ("q_con", "q_bfs"):
        for order in (0, 1, 4):
            row[f"q{order}"] = some(0.6, 0.02, 2.0) * radius
    if kind in ("zernike_standard", "zernike_fringe", "q_con", "q_bfs"):
        row["normalization_radius"] = radius * draw.one_of((0.8, 1.0, 1.0, 3.0))
    if kind == "grid_sag":
        rows, columns = draw.one_of((2, 5, 8)), draw.one_of((3, 6, 11))
        row["sag"] = (radius * abs(draw.size(0.02, 2.0)) * draw.numbers(rows, columns)).tolist()
        wider = draw.one_of((1.0, 1.01, 2.0))
        row["spacing_x"], row["spacing_y"] = (
            wider * 2.0 * radius / (count - 1) for count in (columns, rows)
        )
    if kind == "even_asphere":
        for power in (4, 6, 8, 10, 16, 20)[: draw.one_of((0, 1, 2, 4, 6))]:
            row[f"a{power}"] = draw.size(0.1, 3.0) / radius ** (power - 1)
    if kind == "xy_polynomial":
        for name, power in MONOMIALS:
            if draw.chance(0.5):
                row[name] = draw.size(0.1, 3.0) / radius ** (power - 1)
        if draw.chance(0.5):
            row["b"] = draw.size(0.3, 3.0) / radius
    if kind == "b_spline":
        rows, columns = draw.one_of((4, 6, 9)), draw.one_of((4, 5, 12))
        heights = draw.numbers(rows, columns) * abs(draw.size(0.2, 3.0))
        row["coefficients"] = (radius * heights).tolist()
        row["half_width"] = radius * draw.one_of((1.0, 1.01, 1.5, 100.0 if draw.wild else 2.0))
    return row


def prescription(draw: Draw) -> dict:
    """One to six surfaces, half of the time with tilted elements, one in another perhaps."""
    scale = 10.0 ** draw.between(-3.0, 3.0) if draw.wild else draw.between(2.0, 20.0)
    count = draw.one_of((1, 2, 2, 3, 4, 6))
    rows = [surface(draw, scale * draw.between(0.5, 1.5)) for _ in range(count)]
    medium = draw.one_of(MEDIA)
    before = medium
    for row in rows:
        # An aperture stop leaves the medium as it is.
        row["material"] = before = before if row["material"] is None else row["material"]
    for row in rows[:-1]:
        row["thickness"] = abs(draw.size(3.0 * scale, 1.0))
        if draw.wild and draw.chance(0.2):
            row["thickness"] = draw.one_of((0.0, -row["thickness"]))
    elements = {}
    if draw.chance(0.5):
        tilt = draw.one_of((3.0, 30.0, 90.0)) if draw.wild else 3.0
        for number in range(draw.one_of((1, 1, 2))):
            first = draw.one_of(range(1, count + 1)) if number == 0 else 1
            last = draw.one_of(range(first, count + 1)) if number == 0 else count
            pose = {f"tilt_{axis}": draw.between(-tilt, tilt) for axis in "xyz" if draw.chance(0.7)}
            for name in ("decenter_x", "decenter_y", "shift_z"):
                if draw.chance(0.5):
                    pose[name] = draw.size(0.1 * scale, 1.0)
            pivot = [scale * draw.between(-1.0, 1.0) if draw.chance(0.3) else 0.0 for _ in "xyz"]
            if number == 0 or (first, last) != tuple(elements["1"]["surfaces"]):
                elements[str(number + 1)] = {"surfaces": [first, last], "pivot": pivot, **pose}
    return {
        "object_material": medium,
        "surfaces": {str(i): row for i, row in enumerate(rows, 1)},
        "elements": elements,
        "sensor": {"distance": draw.between(0.5, 10.0) * scale},
    }


def random_lens(seed: int, wild: bool, kinds: tuple[str, ...] = KINDS) -> tuple[Lens, Draw]:
    """A lens in double precision, and the random numbers that follow."""
    draw = Draw(2 * seed + int(wild), wild, kinds)
    while True:
        try:
            lens = lens_from_prescription(prescription(draw))
        except InputError:
            continue  # an aperture beyond the surface's end
        if all(fits(p.detach().abs()) for p in lens.parameters()):
            return lens, draw


def fits(size: torch.Tensor) -> bool:
    """Whether float32 holds a parameter, and derivatives by it (r²⁰ by a20, say)."""
    return bool(((size < 1e30) & ((size == 0.0) | (size > 1e-30))).all())


def random_rays(lens: Lens, draw: Draw, count: int, sense: float) -> Rays:
    """Rays towards a lens: most of them into it, others past it, grazing, or away from it.

    Args:
        lens: any.
        draw: where the numbers come from.
        count: how many.
        sense: +1 from the object, -1 from the sensor.
    """
    system = lens.system()
    numbers = range(1, len(system.surfaces) + 1)
    number = numbers[0] if sense > 0.0 else numbers[-1]
    with torch.no_grad():
        axes = system.axes[number - 1]
        origin = torch.tensor([0.0, 0.0, float(axes.z)], dtype=torch.float64)
        turn = torch.eye(3, dtype=torch.float64)
        if axes.origin is not None:
            origin, turn = axes.origin, axes.rotation
        radius = system.surfaces[number - 1].semi_diameter
    overfill = draw.one_of((0.5, 1.1, 1.1, 3.0))
    target = overfill * radius * draw.numbers(count, 3)
    target[:, 2] *= 0.1
    spread = draw.one_of((0.02, 0.2, 1.0))
    direction = spread * draw.normal(count, 3)
    direction[:, 2] = sense
    # One in eight each: any direction, and along the vertex plane to within 1e-12 to 0.1.
    kind = torch.arange(count) % 8
    direction[kind == 1] = draw.normal(int((kind == 1).sum()), 3)
    grazing = kind == 2
    direction[grazing] = draw.normal(int(grazing.sum()), 3)
    direction[grazing, 2] *= 10.0 ** (6.5 * draw.numbers(int(grazing.sum())) - 6.5)
    direction = direction / direction.norm(dim=1, keepdim=True)
    direction[: min(count, 1), :] = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    distance = radius * 10.0 ** draw.between(-1.0, 6.0 if draw.wild else 2.0)
    position = origin + target @ turn.mT - distance * direction @ turn.mT
    wavelength = draw.one_of((WAVELENGTHS[1], torch.tensor(WAVELENGTHS, dtype=torch.float64)))
    if isinstance(wavelength, torch.Tensor):
        wavelength = wavelength[torch.arange(count) % 3]
    return Rays(position, direction @ turn.mT, wavelength)


def returning(lens: Lens, rays: Rays, draw: Draw) -> Rays:
    """The light that arrived at the sensor, sent back a little astray; or no ray."""
    with torch.no_grad():
        hit = lens.trace(rays)
    direction = draw.one_of((1e-9, 0.01, 0.3)) * draw.normal(*hit.direction.shape) - hit.direction
    direction = direction / direction.norm(dim=-1, keepdim=True)
    kept = hit.valid & torch.isfinite(hit.position).all(-1)
    wavelength = rays.wavelength
    if isinstance(wavelength, torch.Tensor):
        wavelength = wavelength[kept]
    return Rays(hit.position[kept], direction[kept], wavelength)
