"""Gratings, diffractive phases and ideal lenses, in 80 digits, from their definitions alone."""

from dataclasses import dataclass
from typing import Any

from dolens.optics.surfaces.xy_polynomial import monomial_powers
from dolens.optics.surfaces.zernike import fringe, noll


@dataclass(frozen=True)
class Place:
    """Where a ray stands: on surface `number` + 1, in media `indices`, at a wavelength in mm."""

    mp: Any
    lens: Any
    values: dict
    number: int
    indices: list
    wavelength: Any
    sense: int
    behind: int
    sag: Any

    @property
    def surface(self):
        return self.lens.surfaces[str(self.number + 1)]

    def own(self, number):
        """The parameters of a surface's shape, and those of its phase."""
        prefix = f"surfaces.{number + 1}."
        mine = {n.removeprefix(prefix): v for n, v in self.values.items() if n.startswith(prefix)}
        phase = {n.removeprefix("phase."): v for n, v in mine.items() if n.startswith("phase.")}
        return {n: v for n, v in mine.items() if not n.startswith("phase.")}, phase


def stands_on(surface):
    """Whether a law deflects light at a surface."""
    return surface.phase is not None or surface.kind == "paraxial_lens"


def deflect(at, point, direction, normal):
    """The direction behind, and what is added to the path; None and None where light ends."""
    if at.surface.phase is None:
        return _ideal_lens(at, point, direction)
    mp, n, n2 = at.mp, at.indices[at.number], at.indices[at.number + 1]
    h = mp.mpf(10) ** -25
    x, y = point[0], point[1]
    phase = _phase_path(at, at.number)
    slope = mp.matrix(
        [
            (phase(x + h, y) - phase(x - h, y)) / (2 * h),
            (phase(x, y + h) - phase(x, y - h)) / (2 * h),
            0,
        ]
    )
    # The wavevector along the surface, over that of vacuum.
    along = n * direction + slope
    along = along - (along.T * normal)[0] * normal
    squared = n2**2 - (along.T * along)[0]
    if squared <= 0:
        return None, None
    return (along + at.behind * mp.sqrt(squared) * normal) / n2, phase(x, y)


def _phase_path(at, number):
    """m·φ(x, y)·λ/2π of a surface's phase, as a function."""
    mp, phase = at.mp, at.lens.surfaces[str(number + 1)].phase
    p = at.own(number)[1]
    order = mp.mpf(float(phase.order))
    if phase.type == "grating":
        return lambda x, y: order * at.wavelength * p["grooves"] * y
    radius = mp.mpf(float(phase.norm_radius))
    scale = order * at.wavelength / (2 * mp.pi)
    if phase.type == "radial":
        return lambda x, y: (
            scale
            * mp.fsum(
                a * ((x / radius) ** 2 + (y / radius) ** 2) ** (int(name[1:]) // 2)
                for name, a in p.items()
            )
        )
    if phase.type.startswith("zernike"):
        term = fringe if phase.type == "zernike_fringe" else noll
        return lambda x, y: (
            order
            * at.wavelength
            * mp.fsum(a * _zernike(mp, term(int(name[1:])), x / radius, y / radius)
                      for name, a in p.items())
        )  # fmt: skip
    powers = {name: monomial_powers(name) for name in p}
    return lambda x, y: (
        scale
        * mp.fsum(
            a * (x / radius) ** powers[name][0] * (y / radius) ** powers[name][1]
            for name, a in p.items()
        )
    )


def _zernike(mp, term, u, v):
    """norm · R_n^m(ρ) · cos(mφ) or sin(mφ), less its value at the centre, by the sum of powers."""
    n, m, sine, _ = term
    rho, phi = mp.sqrt(u**2 + v**2), mp.atan2(v, u)
    radial = mp.fsum(
        (-1) ** s * mp.factorial(n - s) * rho ** (n - 2 * s)
        / (mp.factorial(s) * mp.factorial((n + m) // 2 - s) * mp.factorial((n - m) // 2 - s))
        for s in range((n - m) // 2 + 1)
    )  # fmt: skip
    norm = 1 if term.norm == 1.0 else mp.sqrt((n + 1) * (2 if m else 1))
    centre = (-1) ** (n // 2) if m == 0 else 0
    return norm * (radial * (mp.sin(m * phi) if sine else mp.cos(m * phi)) - centre)


def _ideal_lens(at, point, direction):
    """From the object point of the ray, on the conjugate plane, to its image point."""
    mp, n, n2 = at.mp, at.indices[at.number], at.indices[at.number + 1]
    power, reduced = at.own(at.number)[0]["power"], _vergence(at)
    r = [point[0], point[1]]
    q = 1 / abs(direction[2])
    u = [direction[0] * q, direction[1] * q]
    v = [(n * a - power * b) / n2 for a, b in zip(u, r, strict=True)]
    length = mp.sqrt(1 + v[0] ** 2 + v[1] ** 2)
    behind = mp.matrix([v[0] / length, v[1] / length, at.sense / length])
    arrives = _from_point(mp, r, u, reduced / n)
    leaves = _from_point(mp, r, [-a for a in v], (power - reduced) / n2)
    return behind, n * arrives + n2 * leaves


def _from_point(mp, r, u, vergence):
    """How much longer the ray through the lens's centre is than that through r.

    Both come from the point a distance 1/vergence in front, on the line through r with slopes u.
    """
    if vergence == 0:
        return -(r[0] * u[0] + r[1] * u[1]) / mp.sqrt(1 + u[0] ** 2 + u[1] ** 2)
    s = 1 / vergence
    start = [a - s * b for a, b in zip(r, u, strict=True)]
    centre = mp.sqrt(s**2 + start[0] ** 2 + start[1] ** 2)
    ray = mp.sqrt(s**2 + (s * u[0]) ** 2 + (s * u[1]) ** 2)
    return mp.sign(s) * (centre - ray)


def _vergence(at):
    """The reduced vergence of the axial beam that arrives: y-nu from the object on the axis."""
    mp, h = at.mp, at.mp.mpf(10) ** -15
    y, nu = mp.mpf(1), mp.mpf(0)
    sense = 1
    indices = _indices(at)
    for number in range(at.number):
        surface = at.lens.surfaces[str(number + 1)]
        if surface.changes_axes:
            continue
        own, _ = at.own(number)
        mirror = at.lens.materials[number + 1].name == "mirror"
        n, n2 = sense * indices[number], (-sense if mirror else sense) * indices[number + 1]
        sense = -sense if mirror else sense
        curvature = 0
        if surface.kind != "paraxial_lens":
            curvature = (at.sag(surface.kind, own, h, mp.mpf(0)) * 2) / h**2
        power = (n2 - n) * curvature + own.get("power", 0)
        if surface.phase is not None and surface.phase.type != "grating":
            power -= 2 * _phase_path(at, number)(h, mp.mpf(0)) / h**2
        nu -= y * power
        y += at.values[f"thicknesses.{number + 1}"] * nu / n2
    return nu / y


def _indices(at):
    """At the primary wavelength, which vergences are of."""
    waves = at.mp.mpf(at.lens.primary_wavelength)
    found = []
    for m in at.lens.materials:
        mirror = m.name == "mirror"
        found.append(found[-1] if mirror else at.mp.mpf(m.a) + at.mp.mpf(m.b) / waves**2)
    return found
