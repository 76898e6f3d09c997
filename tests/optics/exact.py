"""A second ray tracer, in 80-digit arithmetic, written from the definitions alone.

It shares nothing with dolens but the meaning of a prescription: an intersection is the zero of
sag(x, y) - z along the ray that is crossed in the direction of the light, found from the implicit
quadric or by bracketing, and derivatives are differences at 80 digits.  It takes its numbers from a
`Lens` exactly as stored.
"""

import random
from functools import lru_cache

import numpy as np

from dolens.optics.surfaces.xy_polynomial import monomial_powers
from tests.optics import exact_deflection as deflection
from tests.optics.exact_sags import SAGS, even_asphere_sag, mp

OK, VIGNETTED, TIR, MISSED = 0, 1, 2, 3
SAMPLES = 24
# Half the bracket about a distance that is known already, over the surface's semi-diameter.
NEARBY = mp.mpf(10) ** -12
SLOPE_STEP = mp.mpf(10) ** -25
DERIVATIVE_STEP = mp.mpf(10) ** -18


def values_of(lens):
    """Name → number of every parameter of a lens, as it is stored in its precision.

    The elements of an array are numbers of their own, `name[j,i]`, in row-major order.
    """
    values = {}
    for name, parameter in lens.named_parameters():
        array = parameter.detach()
        if array.dim() == 0:
            values[name] = mp.mpf(float(array))
        else:
            for place in np.ndindex(*array.shape):
                values[f"{name}[{','.join(map(str, place))}]"] = mp.mpf(float(array[place]))
    return values


def trace(lens, values, origin, direction, wavelength, near=None):
    """Status, surface where it arose, sensor point, optical path and distances of one ray.

    The distances are those that it goes to each surface.

    Args:
        lens: what surfaces, media and elements there are.
        values: parameter name → number, in place of the stored ones.
        origin: three numbers, mm.
        direction: three numbers; used as they are.
        wavelength: nm.
        near: distances of nearly the same ray through nearly the same lens: where to look first.
    """
    p, d = mp.matrix(origin), mp.matrix(direction)
    status, surface_number, path = OK, 0, mp.mpf(0)
    distances = []
    indices = _indices(lens, wavelength)
    places = _designed(lens, values)
    # Light comes towards +z; a mirror sends it back, and a break shows it from elsewhere.
    sense = 1
    for i, (number, surface) in enumerate(lens.surfaces.items()):
        rotation, vertex = _place(lens, values, i + 1, places)
        q, e = rotation.T * (p - vertex), rotation.T * d
        if surface.changes_axes:
            sense = mp.sign(e[2])
            distances.append(mp.mpf(0))
            continue
        own = {
            name.rsplit(".", 1)[1]: v
            for name, v in values.items()
            if name.startswith(f"surfaces.{number}.") and ".phase." not in name
        }
        own |= {
            name: mp.mpf(float(b)) if b.dim() == 0 else tuple(mp.mpf(float(k)) for k in b)
            for name, b in surface.named_buffers()
        }
        guess = None if near is None else near[i]
        t, sx, sy = _meet(surface.kind, own, surface.semi_diameter, q, e, guess, sense)
        if t is None:
            return MISSED, i + 1, None, None, None
        distances.append(t)
        path += indices[i] * t
        q = q + t * e
        rho = mp.sqrt(q[0] ** 2 + q[1] ** 2)
        if rho >= surface.semi_diameter and status == OK:
            status, surface_number = VIGNETTED, i + 1
        normal = mp.matrix([-sx, -sy, 1]) / mp.sqrt(1 + sx**2 + sy**2)
        cosine = (e.T * normal)[0]
        if deflection.stands_on(surface):
            behind = -sense if lens.materials[i + 1].name == "mirror" else sense
            length = mp.mpf(wavelength) / 10**6
            at = deflection.Place(mp, lens, values, i, indices, length, sense, behind, sag_of)
            e, more = deflection.deflect(at, q, e, normal)
            if e is None:
                return TIR, i + 1, None, None, None
            path, sense = path + more, behind
        elif lens.materials[i + 1].name == "mirror":
            e = e - 2 * cosine * normal
            sense = -sense
        else:
            ratio = indices[i] / indices[i + 1]
            squared = 1 - ratio**2 * (1 - cosine**2)
            if squared <= 0:
                return TIR, i + 1, None, None, None
            e = ratio * e + (sense * mp.sqrt(squared) - ratio * cosine) * normal
        p, d = rotation * q + vertex, rotation * e
    rotation, vertex = places[-1]
    p, d = rotation.T * (p - vertex), rotation.T * d
    if sense * d[2] <= 0:
        return MISSED, len(lens.surfaces) + 1, None, None, None
    t = -p[2] / d[2]
    if "sensor_curvature" in values:
        own = {n: values[f"sensor_{n}"] for n in ("curvature", "conic") if f"sensor_{n}" in values}
        t, _, _ = _meet("conic", own, None, p, d, None, sense)
        if t is None:
            return MISSED, len(lens.surfaces) + 1, None, None, None
    p = p + t * d
    p[2] += mp.fsum(v for k, v in values.items() if k.startswith("thicknesses."))
    p[2] += values["sensor_distance"]
    return status, surface_number, p, path + indices[-1] * t, distances


def _indices(lens, wavelength):
    """Before surface 1 and behind each; behind a mirror is the medium in front of it.

    A glass of a catalogue has the index that dolens computes for it, in double precision.
    """
    found = []
    for m in lens.materials:
        if m.name == "mirror":
            found.append(found[-1])
        elif hasattr(m, "a"):
            found.append(mp.mpf(m.a) + mp.mpf(m.b) / mp.mpf(wavelength) ** 2)
        else:
            found.append(mp.mpf(float(m.index(wavelength))))
    return found


def _designed(lens, values):
    """Rotation and vertex of every surface and of the sensor, before elements are posed.

    A break's own are those behind it.
    """
    rotation, vertex, places = mp.eye(3), mp.matrix([0, 0, 0]), []
    for number, surface in lens.surfaces.items():
        if surface.changes_axes:
            prefix = f"surfaces.{number}."
            v = {name: values[prefix + name] for name, _ in surface.named_parameters()}
            shift = mp.matrix([v["decenter_x"], v["decenter_y"], 0])
            turns = [_about(axis, v[f"tilt_{'xyz'[axis]}"]) for axis in range(3)]
            if surface.order == "decenter_first":
                vertex = vertex + rotation * shift
                rotation = rotation * turns[0] * turns[1] * turns[2]
            else:
                rotation = rotation * turns[2] * turns[1] * turns[0]
                vertex = vertex + rotation * shift
        places.append((rotation, vertex))
        gap = values.get(f"thicknesses.{number}", mp.mpf(0))
        if int(number) == len(lens.surfaces):
            gap = values["sensor_distance"]
        vertex = vertex + rotation * mp.matrix([0, 0, gap])
    return [*places, (rotation, vertex)]


def _about(axis, angle):
    """The right-handed rotation about x, y or z."""
    turn = mp.eye(3)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    turn[a, a], turn[a, b] = mp.cos(angle), -mp.sin(angle)
    turn[b, a], turn[b, b] = mp.sin(angle), mp.cos(angle)
    return turn


def derivatives(function, values):
    """∂function/∂value of every named value, by central differences at 80 digits."""
    result = {}
    for name, value in values.items():
        h = DERIVATIVE_STEP * max(abs(value), mp.mpf("1e-3"))
        ends = [function(values | {name: value + k * h}) for k in (-1, 1)]
        result[name] = (ends[1] - ends[0]) / (2 * h)
    return result


def sag_of(kind, p, x, y):
    """Sag, or None beyond the knots of a B-spline or the end of a branch."""
    if kind == "b_spline":
        bx, by = (_basis(p[f"knots_{axis}"], u) for axis, u in (("x", x), ("y", y)))
        if not (bx and by):
            return None
        return mp.fsum(
            p[f"coefficients[{j},{i}]"] * v * u for j, v in by.items() for i, u in bx.items()
        )
    if kind in ("plane", "aperture", "paraxial_lens"):
        return mp.mpf(0)
    if kind == "xy_polynomial":
        total = mp.mpf(0)
        for name, a in p.items():
            if name != "b":
                i, j = monomial_powers(name)
                total += a * x**i * y**j
        b = p.get("b", mp.mpf(0))
        # The branch through the vertex of b·z² - z + P = 0.
        return total if b == 0 else 2 * total / (1 + mp.sqrt(1 - 4 * b * total))
    if kind in SAGS:
        return SAGS[kind](p, x, y)
    return even_asphere_sag(p, x, y)


@lru_cache(maxsize=4096)  # most derivatives leave the place on the surface where it was
def _basis(knots, u):
    """Index → value of the cubic B-splines that do not vanish at u, by their definition."""
    value = {i: mp.mpf(1) for i in range(len(knots) - 1) if knots[i] <= u < knots[i + 1]}
    for degree in (1, 2, 3):
        higher = {}
        for i, v in value.items():
            width = knots[i + degree] - knots[i]
            if width > 0:
                # N_i rises in N_i of the next degree, and falls in N_{i-1}.
                higher[i] = higher.get(i, 0) + v * (u - knots[i]) / width
                higher[i - 1] = higher.get(i - 1, 0) + v * (knots[i + degree] - u) / width
        value = higher
    return value if knots[3] < u < knots[-4] else {}


def _slopes(kind, p, x, y):
    h = SLOPE_STEP
    return tuple(
        (sag_of(kind, p, x + h * u, y + h * v) - sag_of(kind, p, x - h * u, y - h * v)) / (2 * h)
        for u, v in ((1, 0), (0, 1))
    )


def _meet(kind, p, semi_diameter, q, e, guess, sense):
    """Distance to the point where the ray crosses the sag branch in the light's direction.

    With the sag's slopes there; three times None where there is no such point.
    """
    if kind in ("plane", "aperture", "paraxial_lens"):
        return (None,) * 3 if sense * e[2] <= 0 else (-q[2] / e[2], mp.mpf(0), mp.mpf(0))
    roots = _quadric_roots if kind in ("sphere", "conic") else _bracketed_roots
    crossing = []
    for t in roots(kind, p, semi_diameter, q, e, guess):
        sx, sy = _slopes(kind, p, q[0] + t * e[0], q[1] + t * e[1])
        if sense * (e[2] - e[0] * sx - e[1] * sy) > 0:
            crossing.append((t, sx, sy))
    assert len(crossing) <= 1, "the case is ambiguous"
    return crossing[0] if crossing else (None,) * 3


def _quadric_roots(kind, p, semi_diameter, q, e, guess):
    """Both zeros of c(x² + y² + (1+k)z²) - 2z that lie on the sag's sheet."""
    c, k = p["curvature"], p.get("conic", mp.mpf(0))
    if c == 0:
        return [-q[2] / e[2]]
    a = c * (e[0] ** 2 + e[1] ** 2 + (1 + k) * e[2] ** 2)
    b = 2 * (c * (q[0] * e[0] + q[1] * e[1] + (1 + k) * q[2] * e[2]) - e[2])
    d = c * (q[0] ** 2 + q[1] ** 2 + (1 + k) * q[2] ** 2) - 2 * q[2]
    if abs(a) < mp.mpf(10) ** -40:
        roots = [-d / b]
    elif b**2 < 4 * a * d:
        return []
    else:
        # Both without cancellation, however flat the surface is.
        large = -(b + mp.sign(b) * mp.sqrt(b**2 - 4 * a * d)) / 2
        roots = [large / a, d / large]
    return [t for t in roots if 1 - (1 + k) * c * (q[2] + t * e[2]) > 0]


def _bracketed_roots(kind, p, semi_diameter, q, e, guess):
    """Zeros of z - sag along the ray within 1.2 apertures of the axis, by sampling and bracketing.

    Surfaces must have their sag branch there.  About a guess that a change of sign confirms, no
    other is looked for.
    """

    def f(t):
        sag = sag_of(kind, p, q[0] + t * e[0], q[1] + t * e[1])
        return None if sag is None else q[2] + t * e[2] - sag

    def zero(low, high):
        return mp.findroot(f, (low, high), solver="anderson", tol=mp.mpf(10) ** -140)

    def bracketed(ends):
        return None not in ends and (ends[0] < 0) != (ends[1] < 0)

    if guess is not None:
        around = (guess - NEARBY * semi_diameter, guess + NEARBY * semi_diameter)
        if bracketed([f(t) for t in around]):
            return [zero(*around)]
    reach = mp.mpf("1.2") * semi_diameter
    low, high = sorted(((-q[2] - 2 * reach) / e[2], (-q[2] + 2 * reach) / e[2]))
    a = e[0] ** 2 + e[1] ** 2
    if a > 0:
        b = q[0] * e[0] + q[1] * e[1]
        inside = b**2 - a * (q[0] ** 2 + q[1] ** 2 - reach**2)
        if inside <= 0:
            return []
        low = max(low, (-b - mp.sqrt(inside)) / a)
        high = min(high, (-b + mp.sqrt(inside)) / a)
    ts = [low + (high - low) * i / SAMPLES for i in range(SAMPLES + 1)]
    fs = [f(t) for t in ts]
    return [zero(ts[i], ts[i + 1]) for i in range(SAMPLES) if bracketed(fs[i : i + 2])]


def _place(lens, values, number, places):
    """Rotation and vertex of a surface, the elements that carry it applied from the inside out."""
    rotation, vertex = places[number - 1]
    carrying = [(name, e) for name, e in lens.elements.items() if e.first <= number <= e.last]
    for name, element in sorted(carrying, key=lambda item: item[1].last - item[1].first):
        v = {k.rsplit(".", 1)[1]: x for k, x in values.items() if k.startswith(f"elements.{name}.")}
        own, first = places[element.first - 1]
        pivot = first + own * mp.matrix(element.pivot)
        turn = _about(0, v["tilt_x"]) * _about(1, v["tilt_y"]) * _about(2, v["tilt_z"])
        turn = own * turn * own.T
        shift = own * mp.matrix([v["decenter_x"], v["decenter_y"], v["shift_z"]])
        rotation, vertex = turn * rotation, pivot + turn * (vertex - pivot) + shift
    return rotation, vertex


def sensitivity(function, values, base, draws=4):
    """How far each output moves when every input is off by one part in itself, at worst.

    Backward error analysis: arithmetic of relative precision ε cannot be asked for less than a few
    ε times this.  Inputs are perturbed with random signs.

    Args:
        function: values → list of numbers.
        values: name → number.
        base: what the function makes of them.
        draws: sign patterns tried.
    """
    generator = random.Random(0)
    h = mp.mpf(10) ** -20
    worst = [abs(b) for b in base]
    for _ in range(draws):
        near = {n: v * (1 + generator.choice((-1, 1)) * h) for n, v in values.items()}
        moved = function(near)
        worst = [max(w, abs(m - b) / h) for w, m, b in zip(worst, moved, base, strict=True)]
    return worst
