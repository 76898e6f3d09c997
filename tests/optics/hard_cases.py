"""Cases that break ray tracers, each stated as optics: a lens, a ray, and what must come of it."""

import math
from dataclasses import dataclass, field
from typing import Any

GLASS = "1.5168/64.17"
AXIAL = (0.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class HardCase:
    """A lens, rays (origin, direction) that pass, and rays that end (…, status, surface)."""

    surfaces: list[dict[str, Any]]
    rays: list[tuple[Any, Any]] = field(default_factory=list)
    ends: list[tuple[Any, Any, str, int]] = field(default_factory=list)
    sensor: float = 10.0
    elements: dict[str, Any] = field(default_factory=dict)
    object_material: str = "air"

    def prescription(self):
        """As `lens_from_prescription` takes it."""
        return {
            "object_material": self.object_material,
            "surfaces": {str(i): row for i, row in enumerate(self.surfaces, 1)},
            "elements": self.elements,
            "sensor": {"distance": self.sensor},
        }


def towards(origin, target):
    """Unit vector from one point to another."""
    step = [t - o for o, t in zip(origin, target, strict=True)]
    length = math.sqrt(math.fsum(s * s for s in step))
    return tuple(s / length for s in step)


def at_angle(degrees, azimuth=0.0):
    """Unit vector at an angle to the axis."""
    a, b = math.radians(degrees), math.radians(azimuth)
    return (math.sin(a) * math.cos(b), math.sin(a) * math.sin(b), math.cos(a))


def surface(kind="sphere", **row):
    """One row of a prescription; None leaves a key out."""
    row = {"type": kind, "semi_diameter": 10.0, "material": GLASS} | row
    return {key: value for key, value in row.items() if value is not None}


def singlet(scale=1.0):
    """A biconvex lens of 20 mm, or scaled."""
    return [
        surface(radius=30.0 * scale, semi_diameter=9.0 * scale, thickness=5.0 * scale),
        surface(radius=-40.0 * scale, semi_diameter=9.0 * scale, material="air"),
    ]


def ball(radius):
    """A ball lens, clear to 0.999 of its radius."""
    return [
        surface(radius=radius, semi_diameter=0.999 * radius, thickness=2.0 * radius),
        surface(radius=-radius, semi_diameter=0.999 * radius, material="air"),
    ]


def from_points(*sources, target=(2.0, -3.0, 0.0)):
    """A ray from each source to one point."""
    return [(source, towards(source, target)) for source in sources]


# sin i = (1 ∓ 1e-6)/n inside glass of n(587.5618 nm) = 1.5168, on a plane exit face.
CRITICAL = math.asin(1.0 / 1.5168)
BELOW = math.degrees(math.asin(math.sin(CRITICAL) * (1.0 - 1e-6)))
ABOVE = math.degrees(math.asin(math.sin(CRITICAL) * (1.0 + 1e-6)))

ASPHERE = {"curvature": 0.08, "conic": -1.2, "a4": -1e-4, "a6": 2e-6, "a8": -1e-8, "a10": 5e-11}

# The last surface of a telephone's lens: its higher terms undo its parabola, whose own intersection
# with these rays lies 6 mm behind the vertex plane, beyond where the polynomial turns.
UNDONE = {
    "curvature": 0.5684633602886572,
    "conic": -1.0,
    "a4": -0.04273731388052537,
    "a6": 0.00421241411897839,
    "a8": -0.0002477096359840808,
    "a10": 5.76124160062603e-06,
}
SLANTED = (-0.01, 0.339, 0.9407332246)

# Of the first order of 1000 grooves per mm at 587.5618 nm, 1 ∓ 1e-6 along the plane behind it.
SPREAD = 587.5618e-6 * 1000.0
DIFFRACTED, EVANESCENT = (math.degrees(math.asin(s - SPREAD)) for s in (1.0 - 1e-6, 1.0 + 1e-6))
RADIAL = {"type": "radial", "norm_radius": 10.0, "p2": -1100.0, "p4": 340.0, "p6": -25.0}
MONOMIALS = {"type": "xy", "norm_radius": 8.0, "x": 900.0, "y": -300.0, "x2": -700.0, "xy": 50.0,
             "y2": -650.0, "x3": 40.0, "xy2": -30.0, "x2y2": 12.0, "y5": 3.0}  # fmt: skip

# Nine by four coefficients: a parabola's depth with bumps; two knots are repeated.
KNOTS_X = [-10.0] * 4 + [-2.0, -2.0, 1.0, 1.0, 1.0] + [10.0] * 4
BUMPS = [[0.02 * ((i - 4) ** 2 + (j - 1.5) ** 2) + 0.1 * ((3 * i + 5 * j) % 4) for i in range(9)]
         for j in range(4)]  # fmt: skip
ODD = {"curvature": 0.05, "conic": -0.5, "a1": 0.02, "a2": -1e-3, "a3": 2e-4, "a5": -1e-6,
       "a7": 3e-9, "a9": 1e-12}  # fmt: skip
TOROID = {"radius_x": 12.0, "radius_y": 25.0, "conic_y": -0.7, "a2": 1e-3, "a4": -1e-5, "a8": 2e-9}
ZERNIKE = {"radius": 30.0, "conic": -0.5, "a4": 1e-5, "normalization_radius": 8.0}
SPLINE = {"coefficients": BUMPS, "knots_x": KNOTS_X, "half_width_y": 10.0}

CASES: dict[str, HardCase] = {
    "near-tangent incidence on a sphere": HardCase(
        [surface(radius=10.0, semi_diameter=9.9999999)],
        rays=[((9.99999, 0.0, -5.0), AXIAL), ((6.0, 7.999, -5.0), AXIAL)],
        sensor=20.0,
    ),
    "grazing incidence on a sphere, 89.9°": HardCase(
        [surface(radius=1000.0, semi_diameter=100.0)],
        rays=[((-20.0, 0.0, 0.0), at_angle(89.9)), ((-1.0, 2.0, 0.5), at_angle(89.0, 30.0))],
    ),
    "asphere whose higher terms undo its conic": HardCase(
        [surface("even_asphere", semi_diameter=3.65, **UNDONE)],
        rays=[
            ((0.022, 2.428, 0.0), towards((0.0, 0.0, 0.0), SLANTED)),
            ((-0.05, 2.380, 0.0), towards((0.0, 0.0, 0.0), SLANTED)),
            ((0.3, -2.2, 0.0), towards((0.0, 0.0, 0.0), (0.1, -0.33, 0.9))),
        ],
        sensor=2.0,
    ),
    "hemisphere near its edge": HardCase(
        [surface(radius=-10.0, semi_diameter=10.0)],
        rays=[((9.999, 0.0, -20.0), AXIAL), ((0.0, -9.9, -20.0), at_angle(1.0, 90.0))],
        ends=[((10.5, 0.0, -20.0), AXIAL, "missed", 1)],
    ),
    "ball lens": HardCase(
        ball(5.0),
        rays=[((4.5, 0.0, -10.0), AXIAL), ((1.0, 4.0, -10.0), AXIAL),
              ((0.0, 0.0, -10.0), at_angle(14.0, 60.0))],
        ends=[((5.1, 0.0, -10.0), AXIAL, "missed", 1)],
    ),
    "ball lens from a point on its own surface": HardCase(
        ball(5.0), rays=[((3.0, 0.0, 1.0), AXIAL), ((0.0, 0.0, 0.0), at_angle(30.0))]
    ),
    "paraboloid, κ = -1": HardCase(
        [surface("conic", radius=8.0, conic=-1.0)],
        rays=[((9.0, 0.0, -5.0), AXIAL), ((-3.0, 4.0, -5.0), at_angle(40.0, 20.0))],
    ),
    "a ray along a paraboloid's axis direction, A = 0": HardCase(
        [surface("conic", radius=-8.0, conic=-1.0)], rays=[((6.0, -5.0, 0.0), AXIAL)]
    ),
    "hyperboloid, κ = -5": HardCase(
        [surface("conic", radius=10.0, conic=-5.0, semi_diameter=30.0)],
        rays=[((20.0, 0.0, -5.0), AXIAL), ((-10.0, 5.0, -5.0), at_angle(30.0, 70.0))],
        sensor=40.0,
    ),
    "G < 0 on a hyperboloid: F/(G + √D) cancels": HardCase(
        [surface("conic", radius=10.0, conic=-5.0, semi_diameter=80.0)],
        rays=[((10.0, 0.0, 0.0), at_angle(60.0)), ((12.0, -3.0, 0.0), at_angle(58.0))],
        sensor=80.0,
    ),
    "oblate ellipsoid, κ = 3": HardCase(
        [surface("conic", radius=20.0, conic=3.0, semi_diameter=9.99)],
        rays=[((9.98, 0.0, -5.0), AXIAL), ((-5.0, 8.0, -5.0), at_angle(5.0))],
        sensor=20.0,
    ),
    "a plane whose curvature can move, c = 0": HardCase(
        [surface(radius=math.inf)],
        rays=[((3.0, -4.0, -5.0), at_angle(25.0, 40.0)), ((0.0, 0.0, 0.0), AXIAL)],
    ),
    "curvature about to change sign, R = 1e12": HardCase(
        [surface(radius=1e12, thickness=2.0), surface(radius=-1e12, material="air")], rays=[
            ((3.0, -4.0, -5.0), at_angle(25.0, 40.0))]
    ),
    "curvature of a kilometre": HardCase(
        [surface(radius=1e6, thickness=2.0), surface(radius=-1e6, material="air")], rays=[
            ((3.0, -4.0, -5.0), at_angle(25.0, 40.0))]
    ),
    "strong asphere far off axis": HardCase(
        [surface("even_asphere", semi_diameter=9.0, **ASPHERE)],
        rays=[((8.5, 0.0, -5.0), AXIAL), ((-5.0, 3.0, -5.0), at_angle(20.0, 100.0))],
    ),
    "asphere at 65°": HardCase(
        [surface("even_asphere", semi_diameter=9.0, **ASPHERE)],
        rays=[((-14.0, 0.0, -5.0), at_angle(65.0)), ((0.0, -12.0, -5.0), at_angle(65.0, 90.0))],
        sensor=20.0,
    ),
    "XY polynomial with b·z²": HardCase(
        [surface("xy_polynomial", semi_diameter=8.0, x2=0.02, y2=0.015, xy=1e-3, x3=2e-4, x2y=-1e-4,
                 y4=1e-5, b=0.05)],
        rays=[((5.0, 3.0, -2.0), at_angle(20.0, 30.0)), ((-4.0, 6.0, -2.0), AXIAL)],
    ),
    "B-spline, beside a double and a triple knot": HardCase(
        [surface("b_spline", semi_diameter=8.0, **SPLINE)],
        rays=[((-2.000001, 3.0, -5.0), AXIAL), ((0.999999, -2.0, -5.0), AXIAL)],
    ),
    "B-spline, 0.01 mm from a corner": HardCase(
        [surface("b_spline", semi_diameter=None, **SPLINE,
                 aperture={"half_width_x": 9.999, "half_width_y": 9.999})],
        rays=[((-9.99, 9.99, -5.0), AXIAL)],
        ends=[((10.01, 0.0, -5.0), AXIAL, "missed", 1)],
        sensor=20.0,
    ),
    "odd asphere with a cusp, near its vertex and far out": HardCase(
        [surface("odd_asphere", semi_diameter=9.0, **ODD)],
        rays=[((1e-6, 2e-6, -5.0), AXIAL), ((8.5, 0.0, -5.0), AXIAL),
              ((-14.0, 0.0, -5.0), at_angle(60.0))],
        sensor=20.0,
    ),
    "axicon alone, steep": HardCase(
        [surface("odd_asphere", radius=math.inf, a1=1.5)],
        rays=[((3.0, -4.0, -5.0), AXIAL), ((4.0, -3.0, 0.0), at_angle(40.0, 150.0))],
    ),
    "biconic, a thousandth inside its end": HardCase(
        [surface("biconic", semi_diameter=None, radius_x=8.0, radius_y=-15.0, conic_x=0.5,
                 conic_y=-3.0, aperture={"half_width_x": 6.53, "half_width_y": 12.0})],
        rays=[((6.525, 0.5, -5.0), AXIAL), ((-3.0, 9.0, -8.0), at_angle(35.0, 250.0))],
        ends=[((9.0, 0.0, -5.0), AXIAL, "missed", 1)],
        sensor=30.0,
    ),
    "toroid, at 99.9 % of the radius of rotation": HardCase(
        [surface("toroid", semi_diameter=None, **TOROID,
                 aperture={"half_width_x": 11.99, "half_width_y": 7.0})],
        rays=[((11.988, 0.1, -5.0), AXIAL), ((-6.0, -4.0, -5.0), at_angle(40.0, 10.0))],
        ends=[((12.1, 0.0, -5.0), AXIAL, "missed", 1)],
        sensor=30.0,
    ),
    "cylinder": HardCase(
        [surface("toroid", radius_x=math.inf, radius_y=-10.0, conic_y=0.0, semi_diameter=9.999)],
        rays=[((0.0, 9.998, -25.0), AXIAL), ((9.0, 0.0, -5.0), at_angle(60.0, 180.0))],
        sensor=20.0,
    ),
    "Zernike standard polynomials to order 20, decentred, beyond their disc": HardCase(
        [surface("zernike_standard", semi_diameter=9.5, **ZERNIKE, decenter_x=0.7,
                 decenter_y=-0.4, z4=1e-2, z7=-4e-3, z22=1e-3, z231=1e-6)],
        rays=[((7.9, 0.0, -5.0), AXIAL), ((-9.0, 1.0, -5.0), AXIAL),
              ((2.0, 5.0, -5.0), at_angle(30.0, 300.0))],
    ),
    "Zernike fringe polynomials at the centre of their disc": HardCase(
        [surface("zernike_fringe", **ZERNIKE, z2=1e-2, z5=-4e-3, z9=2e-3, z37=1e-3)],
        rays=[((0.0, 0.0, -5.0), AXIAL), ((1e-9, 0.0, -5.0), AXIAL), ((0.0, 8.0, -5.0), AXIAL)],
    ),
    "Q_con to order 30": HardCase(
        [surface("q_con", radius=-15.0, conic=-1.5, normalization_radius=9.0, semi_diameter=9.0,
                 q0=0.3, q3=-0.05, q30=1e-5)],
        rays=[((8.99, 0.0, -15.0), AXIAL), ((5.0, -2.0, -15.0), at_angle(35.0, 100.0))],
    ),
    "Q_bfs to order 20, close to its hemisphere": HardCase(
        [surface("q_bfs", radius=10.0, normalization_radius=10.0, semi_diameter=9.99, q0=0.1,
                 q1=-0.05, q20=1e-4)],
        rays=[((9.9, 0.0, -5.0), AXIAL), ((-5.0, 3.0, -5.0), at_angle(30.0))],
        sensor=20.0,
    ),
    "Q_bfs about a conic, where the sphere of its curvature has ended": HardCase(
        [surface("q_bfs", radius=8.0, conic=-0.8, normalization_radius=11.0, q0=-0.3, q2=0.05)],
        rays=[((9.9, 0.0, -5.0), AXIAL), ((-6.0, -7.0, -5.0), at_angle(20.0))],
        sensor=20.0,
    ),
    "a millionth below total reflection": HardCase(
        [surface(radius=math.inf, semi_diameter=50.0, material="air")],
        rays=[((-1.0, 0.0, -0.5), at_angle(BELOW))],
        ends=[((-1.0, 0.0, -0.5), at_angle(ABOVE), "tir", 1)],
        object_material=GLASS,
    ),
    "a millionth below an evanescent order": HardCase(
        [surface("plane", semi_diameter=50.0, material="air",
                 phase={"type": "grating", "grooves": 1000.0})],
        rays=[((0.0, -1.0, -0.5), at_angle(DIFFRACTED, 90.0))],
        ends=[((0.0, -1.0, -0.5), at_angle(EVANESCENT, 90.0), "tir", 1)],
    ),
    "an order that leaves glass where light is totally reflected": HardCase(
        [surface(radius=50.0, semi_diameter=40.0, material="air",
                 phase={"type": "grating", "grooves": 900.0, "order": -1})],
        rays=[((1.0, -3.0, -4.0), at_angle(50.0, 90.0)), ((0.0, 0.0, -4.0), at_angle(60.0, 80.0))],
        ends=[((1.0, -3.0, -4.0), at_angle(50.0, -90.0), "tir", 1)],
        object_material=GLASS,
        sensor=3.0,
    ),
    "an echelle of order 40 on a concave mirror": HardCase(
        [surface(radius=-200.0, semi_diameter=40.0, material="mirror",
                 phase={"type": "grating", "grooves": 79.0, "order": 40})],
        rays=[((3.0, 20.0, -10.0), at_angle(67.0, -90.0)),
              ((-5.0, 24.0, -10.0), at_angle(66.0, -80.0))],
        sensor=-20.0,
    ),
    "a diffractive asphere at 40°": HardCase(
        [surface("even_asphere", semi_diameter=9.0, **ASPHERE, phase=RADIAL)],
        rays=[((-7.0, 0.0, -5.0), at_angle(40.0)), ((4.0, -5.0, -5.0), AXIAL)],
        sensor=20.0,
    ),
    "an XY phase of order -2 on a hyperboloid": HardCase(
        [surface("conic", radius=-30.0, conic=-3.0, semi_diameter=9.0, material="air",
                 phase={**MONOMIALS, "order": -2})],
        rays=[((3.0, -4.0, -5.0), at_angle(20.0, 50.0)), ((-2.0, 6.0, -5.0), AXIAL)],
        object_material=GLASS,
    ),
    "Zernike phases of radial orders 6 and 8 on a plane and a mirror": HardCase(
        [surface("plane", semi_diameter=9.0, material="air", thickness=8.0,
                 phase={"type": "zernike_standard", "order": -2, "norm_radius": 9.0, "z4": 40.0,
                        "z6": -20.0, "z7": 11.0, "z22": 7.0}),
         surface("conic", radius=-90.0, conic=-3.0, semi_diameter=12.0, material="mirror",
                 phase={"type": "zernike_fringe", "norm_radius": 10.0, "z3": 30.0, "z5": -9.0,
                        "z25": 0.5})],
        rays=[((3.0, -4.0, -5.0), at_angle(8.0, 50.0)), ((-2.0, 6.0, -5.0), AXIAL)],
        sensor=-20.0,
    ),
    "an ideal lens in glass at 60°": HardCase(
        [surface(radius=30.0, thickness=5.0),
         surface("paraxial_lens", focal_length=25.0, thickness=5.0, material="1.7"),
         surface("paraxial_lens", focal_length=-40.0, material="air", semi_diameter=40.0)],
        rays=[((-6.0, 1.0, -2.0), at_angle(60.0, 20.0)), ((5.0, -3.0, -2.0), AXIAL)],
        sensor=20.0,
    ),
    "an afocal pair of ideal lenses behind a mirror": HardCase(
        [surface(radius=-400.0, semi_diameter=30.0, thickness=-50.0, material="mirror"),
         surface("paraxial_lens", focal_length=60.0, semi_diameter=30.0, thickness=-85.0,
                 material="air"),
         surface("paraxial_lens", focal_length=25.0, semi_diameter=30.0, material="air")],
        rays=[((12.0, -7.0, -60.0), at_angle(3.0, 40.0)), ((-9.0, 2.0, -60.0), AXIAL)],
        sensor=-30.0,
    ),
    "object at 1 mm": HardCase(singlet(), from_points((0.0, 0.5, -1.0)), sensor=40.0),
    "object at 1 m": HardCase(singlet(), from_points((30.0, -20.0, -1e3)), sensor=40.0),
    "object at 10 m": HardCase(singlet(), from_points((300.0, -200.0, -1e4)), sensor=40.0),
    "object at 10 km": HardCase(singlet(), from_points((3e5, -2e5, -1e7)), sensor=40.0),
    "a lens of micrometres": HardCase(
        singlet(1e-4), from_points((0.0, 1e-4, -5e-3), target=(2e-4, -3e-4, 0.0)), sensor=4e-3
    ),
    "a lens of metres": HardCase(
        singlet(1e3), from_points((0.0, 1e3, -5e5), target=(2e3, -3e3, 0.0)), sensor=4e4
    ),
    "elements tilted by 30°": HardCase(
        [surface(radius=30.0, semi_diameter=9.0, thickness=5.0),
         surface(radius=-40.0, semi_diameter=9.0, thickness=12.0, material="air"),
         surface("even_asphere", semi_diameter=9.0, curvature=0.02, conic=-1.0, a4=1e-5,
                 thickness=4.0),
         surface("plane", semi_diameter=9.0, material="air")],
        rays=[((1.0, -2.0, -30.0), at_angle(3.0, 50.0)), ((-3.0, 1.0, -8.0), AXIAL)],
        elements={"1": {"surfaces": [1, 2], "tilt_x": 30.0, "tilt_y": -10.0, "pivot": [0, 0, 2.5]},
                  "2": {"surfaces": [3, 4], "tilt_y": 30.0, "tilt_z": 45.0, "decenter_x": 1.0}},
        sensor=30.0,
    ),
    "a telescope of metres, folded at 45°": HardCase(
        [surface("conic", radius=-11040.0, conic=-1.0023, semi_diameter=1200.0, thickness=-4906.0,
                 material="mirror"),
         surface("conic", radius=-1358.0, conic=-1.496, semi_diameter=160.0, thickness=6000.0,
                 material="mirror"),
         {"type": "coordinate_break", "tilt_x": 45.0, "decenter_y": 0.5, "thickness": 0.0},
         surface("plane", semi_diameter=50.0, material="mirror", thickness=0.0),
         {"type": "coordinate_break", "tilt_x": 45.0, "thickness": -3000.0},
         {"type": "coordinate_break", "tilt_y": -40.0, "tilt_z": 20.0, "thickness": 0.0},
         surface("sphere", radius=9000.0, semi_diameter=400.0, material="mirror", thickness=0.0),
         {"type": "coordinate_break", "tilt_y": -40.0, "tilt_z": -20.0, "order": "tilt_first"}],
        rays=[((300.0, -900.0, -8000.0), AXIAL), ((-700.0, 400.0, 1.0), at_angle(0.03, 40.0))],
        sensor=4000.0,
    ),
    "a Mangin mirror": HardCase(
        [surface(radius=-60.0, semi_diameter=20.0, thickness=4.0),
         surface(radius=-90.0, semi_diameter=20.0, thickness=-4.0, material="mirror"),
         surface(radius=-60.0, semi_diameter=20.0, thickness=-40.0, material="air"),
         surface("even_asphere", curvature=-0.01, conic=-2.0, a4=1e-6, semi_diameter=15.0,
                 material="mirror")],
        rays=[((12.0, 3.0, -30.0), at_angle(2.0, 30.0)), ((-14.0, 8.0, -60.0), AXIAL)],
        ends=[((12.0, 3.0, -30.0), (0.0, 0.0, -1.0), "missed", 1),
              ((25.0, 0.0, -30.0), AXIAL, "vignetted", 1)],
        sensor=35.0,
    ),
    "light that a mirror sends almost across the axis": HardCase(
        [surface(radius=-20.0, semi_diameter=19.9, material="mirror")],
        rays=[((13.9, 0.0, -30.0), AXIAL), ((-3.0, 13.6, -30.0), AXIAL)],
        ends=[((20.5, 0.0, -30.0), AXIAL, "missed", 1), ((15.0, 0.0, -30.0), AXIAL, "missed", 2)],
        sensor=-100.0,
    ),
    "rays that start beyond the surface": HardCase(
        singlet(), rays=[((1.0, 2.0, 30.0), AXIAL), ((-2.0, 0.5, 4.0), at_angle(10.0))], sensor=40.0
    ),
    "a surface that every ray misses": HardCase(
        [surface(radius=5.0, semi_diameter=4.99)],
        ends=[((6.0, 0.0, -5.0), AXIAL, "missed", 1),
              ((0.0, -1.0, -5.0), at_angle(70.0), "missed", 1),
              ((0.0, 0.0, -5.0), (0.0, 0.0, -1.0), "missed", 1),
              ((0.0, 0.0, -5.0), (1.0, 0.0, 0.0), "missed", 1)],
    ),
    "an asphere that a ray never meets: Newton must not settle": HardCase(
        [surface("even_asphere", semi_diameter=9.0, **ASPHERE)],
        ends=[((-20.0, 0.0, -5.0), at_angle(80.0), "missed", 1),
              ((0.0, 30.0, -5.0), at_angle(45.0, 90.0), "missed", 1)],
    ),
    "a clipped ray goes on": HardCase(
        singlet(), rays=[], ends=[((9.5, 0.0, -5.0), AXIAL, "vignetted", 1)], sensor=40.0
    ),
}  # fmt: skip
