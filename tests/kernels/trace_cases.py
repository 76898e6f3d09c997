"""Lenses and rays that a backend is tried on, and the comparison with the reference."""

import copy
import math
import re
from dataclasses import dataclass

import torch

from dolens import Rays, load_lens
from dolens.optics.surfaces import register_surface, unregister_surface
from dolens.optics.surfaces.b_spline import clamped_knots
from dolens.prescriptions import lens_from_prescription, prescription_of
from tests.kernels.own_surface.paraboloid import Paraboloid

F64 = torch.float64
_GLASS = "1.5168/64.17"
_KNOTS = clamped_knots(6.0, 9)


def _random(*shape, seed):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def _singlet(front, back, **more):
    surfaces = {
        "1": {"semi_diameter": 5.0, "thickness": 3.0, "material": _GLASS, **front},
        "2": {"semi_diameter": 5.0, "material": "air", **back},
    }
    return lens_from_prescription({"surfaces": surfaces, "sensor": {"distance": 40.0}, **more})


def _spline():
    """A curved spline with a random ripple, behind a conic."""
    u = torch.linspace(-6.0, 6.0, 9, dtype=F64)
    bowl = -0.008 * (u[:, None] ** 2 + u[None] ** 2) + 0.004 * _random(9, 9, seed=4)
    back = {"type": "b_spline", "coefficients": bowl.tolist(), "knots_x": _KNOTS, "knots_y": _KNOTS}
    return _singlet({"type": "conic", "radius": 40.0, "conic": -0.7}, back)


def _polynomial():
    """Every kind of monomial, b, and a hole in the order of powers."""
    back = {"type": "xy_polynomial", "x2": -0.008, "y2": -0.007, "xy": 1e-3, "x3": 2e-5,
            "x2y": -3e-5, "xy2": 1e-5, "y3": 4e-5, "x4": 1e-6, "x2y3": 2e-7, "b": 0.03}  # fmt: skip
    return _singlet({"type": "sphere", "radius": 40.0}, back)


def _aspheres():
    """Aspheres of many and of few coefficients; the second has a conic that nothing simplifies,
    and a square term.
    """
    front = {"type": "even_asphere", "radius": 30.0, "conic": -0.8, "a4": 2e-5, "a6": -1e-7,
             "a8": 3e-9, "a10": 1e-11, "a12": -1e-13}  # fmt: skip
    return _singlet(
        front, {"type": "even_asphere", "radius": -60.0, "conic": 0.4, "a2": 1e-3, "a4": 1e-5}
    )


def _mirrors():
    """A Mangin mirror, then mirrors of every kind, and glass behind them."""

    def row(kind, thickness, material="mirror", **more):
        return {"type": kind, "semi_diameter": 6.0, "thickness": thickness, "material": material,
                **more}  # fmt: skip

    surfaces = [
        row("sphere", 2.0, _GLASS, radius=-40.0),
        row("conic", -2.0, radius=-70.0, conic=-0.6),
        row("sphere", -12.0, "air", radius=-40.0),
        row("even_asphere", 12.0, radius=90.0, conic=0.3, a4=1e-5, a6=-1e-8),
        row("sphere", -12.0, radius=-80.0),
        row("plane", 12.0),
        row("xy_polynomial", -12.0, x2=-0.004, y2=-0.005, xy=1e-4, x3=1e-5, y4=-1e-7),
        row("conic", 8.0, radius=200.0, conic=-3.0),
        row("sphere", 2.0, _GLASS, radius=60.0),
        row("plane", None, "air"),
    ]
    surfaces[-1].pop("thickness")
    return lens_from_prescription(
        {"surfaces": {str(n): r for n, r in enumerate(surfaces, 1)}, "sensor": {"distance": 15.0}}
    )


def _folded():
    """Breaks before, between and behind mirrors and a lens that is out of place."""

    def broken(**row):
        return {"type": "coordinate_break", "thickness": 0.0, **row}

    glass = {"semi_diameter": 5.0, "material": _GLASS}
    mirror = {"semi_diameter": 9.0, "material": "mirror", "thickness": 0.0}
    surfaces = [
        broken(tilt_x=2.0, decenter_x=0.2, thickness=1.0),
        {"type": "sphere", "radius": 60.0, "thickness": 2.0, **glass},
        {"type": "sphere", "radius": -90.0, "thickness": 20.0, **glass, "material": "air"},
        broken(tilt_x=45.0, decenter_y=0.3),
        {"type": "plane", **mirror},
        broken(tilt_x=45.0, thickness=-15.0),
        broken(tilt_y=-20.0, tilt_z=10.0),
        {"type": "conic", "radius": 90.0, "conic": -0.8, **mirror},
        broken(tilt_y=-20.0, tilt_x=3.0, order="tilt_first", decenter_x=-0.4, thickness=10.0),
        {"type": "even_asphere", "radius": 80.0, "conic": 0.0, "a4": 1e-5, **glass,
         "thickness": 3.0},
        {"type": "sphere", "radius": -70.0, **glass, "material": "air", "thickness": 4.0},
        broken(tilt_x=-8.0),
    ]  # fmt: skip
    surfaces[-1].pop("thickness", None)
    elements = {
        "1": {"surfaces": [2, 3], "tilt_x": 1.0, "decenter_x": 0.1, "shift_z": 0.05},
        "2": {"surfaces": [8, 11], "tilt_y": 0.5, "decenter_y": -0.1, "pivot": [0.0, 1.0, 2.0]},
    }
    return lens_from_prescription(
        {"surfaces": {str(n): r for n, r in enumerate(surfaces, 1)}, "elements": elements,
         "sensor": {"distance": 12.0}, "stop": 2}
    )  # fmt: skip


def _odd_aspheres():
    """An axicon's cusp under many powers, and an asphere with one odd power."""
    front = {"type": "odd_asphere", "radius": 35.0, "conic": -0.5, "a1": 0.01, "a2": 1e-4,
             "a3": 1e-5, "a4": 1e-6, "a5": -1e-7, "a7": 1e-9, "a9": 1e-11,
             "a11": -1e-13}  # fmt: skip
    return _singlet(front, {"type": "odd_asphere", "radius": -60.0, "conic": 0.0, "a3": 2e-5})


def _anamorphic():
    """A toroid and a biconic, crossed."""
    front = {"type": "toroid", "radius_x": 30.0, "radius_y": 80.0, "conic_y": -0.5, "a2": 1e-3,
             "a4": 1e-5, "a6": -1e-7}  # fmt: skip
    back = {
        "type": "biconic",
        "radius_x": -90.0,
        "radius_y": -40.0,
        "conic_x": 1.5,
        "conic_y": -2.0,
    }
    return _singlet(front, back)


def _cylinders():
    """Two crossed cylinders, one of them with its curve in x."""
    front = {"type": "toroid", "radius_x": math.inf, "radius_y": 40.0, "conic_y": 0.2}
    back = {"type": "biconic", "radius_x": -40.0, "radius_y": math.inf, "conic_x": -0.6}
    return _singlet(front, back)


def _zernike():
    """Terms of several orders with gaps between them, decentred; and some of the other table."""
    front = {"type": "zernike_standard", "radius": 35.0, "conic": -0.4, "a4": 1e-6, "z1": 0.1,
             "z2": -2e-3, "z4": 4e-3, "z5": 2e-3, "z11": -1e-3, "z17": 5e-4, "z24": 2e-4,
             "normalization_radius": 5.5, "decenter_x": 0.4, "decenter_y": -0.2}  # fmt: skip
    back = {"type": "zernike_fringe", "radius": -60.0, "z3": 1e-3, "z9": 2e-3, "z12": -1e-3,
            "z37": 1e-4, "normalization_radius": 5.0}  # fmt: skip
    return _singlet(front, back)


def _forbes():
    """Both families, with orders left out."""
    front = {"type": "q_bfs", "radius": 25.0, "conic": -0.6, "q0": 0.05, "q1": -0.01, "q4": 2e-3,
             "normalization_radius": 5.2}  # fmt: skip
    back = {"type": "q_con", "radius": -50.0, "conic": 0.5, "q0": 0.03, "q3": -2e-3, "q5": 1e-3,
            "normalization_radius": 5.0}  # fmt: skip
    return _singlet(front, back)


def _grid():
    """A smooth bump with ripples on a conic, off its middle."""
    u = torch.linspace(-6.0, 6.0, 13, dtype=F64)
    ripple = 0.003 * _random(13, 13, seed=6) - 0.002 * (u[:, None] ** 2 + 0.5 * u[None] ** 2)
    back = {"type": "grid_sag", "radius": -60.0, "conic": 0.4, "a4": 1e-6, "sag": ripple.tolist(),
            "spacing_x": 1.0, "spacing_y": 1.0, "decenter_x": 0.5, "decenter_y": -0.3}  # fmt: skip
    return _singlet({"type": "sphere", "radius": 40.0}, back)


def _own_surface():
    """A surface of a user's own behind a sphere; it is registered while the lens is made."""
    back = {"type": "paraboloid", "curvature_x": -0.02, "curvature_y": -0.015, "twist": 0.002}
    register_surface(Paraboloid)
    try:
        return _singlet({"type": "sphere", "radius": 40.0}, back)
    finally:
        unregister_surface("paraboloid")


def _posed(root):
    import yaml

    text = (root / "conf/lens/cooke_triplet.yaml").read_text(encoding="utf-8")
    elements = {
        "1": {"surfaces": [1, 2], "tilt_x": 1.0, "decenter_x": 0.1, "shift_z": 0.05},
        "2": {"surfaces": [5, 6], "tilt_y": -2.0, "tilt_z": 15.0, "decenter_y": -0.1},
    }
    return lens_from_prescription(yaml.safe_load(text) | {"elements": elements})


def _clipped():
    """A rectangle with a round obscuration, and a circle with a rectangular one."""
    front = {"type": "sphere", "radius": 40.0, "obscuration": {"semi_diameter": 0.8},
             "aperture": {"half_width_x": 3.0, "half_width_y": 2.0}}  # fmt: skip
    obscured = {"type": "plane", "obscuration": {"half_width_x": 1.0, "half_width_y": 0.3}}
    surfaces = {
        "1": {"thickness": 3.0, "material": _GLASS, **front},
        "2": {"semi_diameter": 5.0, "material": "air", **obscured},
    }
    return lens_from_prescription({"surfaces": surfaces, "sensor": {"distance": 60.0}})


def _figures():
    """A pentagon, which is not convex, with a hole, and what blocks a circle in several ways."""
    pentagon = [[-3.0, -2.0], [3.0, -2.0], [0.5, 0.0], [2.5, 2.5], [-2.5, 2.5]]
    hole = [[-1.0, 0.5], [-0.5, 0.5], [-0.75, 1.25]]
    front = {"type": "sphere", "radius": 40.0, "semi_diameter": 6.0,
             "aperture": {"polygons": [pentagon, hole], "decenter_x": 0.25}}  # fmt: skip
    blocked = [
        {"semi_diameter": 0.4},
        {"width": 0.2, "arms": 3, "angle": 30.0},
        {"inner_semi_diameter": 1.5, "semi_diameter": 1.7, "decenter_x": 0.2},
        {"half_width_x": 0.3, "half_width_y": 0.2, "decenter_y": -1.0},
        {"semi_axis_x": 0.3, "semi_axis_y": 0.5, "decenter_x": 1.0},
        {"polygons": [[[-1.5, 0.5], [-1.0, 0.5], [-1.25, 1.5]]]},
    ]
    surfaces = {
        "1": {"thickness": 3.0, "material": _GLASS, **front},
        "2": {"type": "conic", "radius": -90.0, "conic": -1.0, "semi_diameter": 5.0,
              "material": "air", "obscuration": blocked},
    }  # fmt: skip
    return lens_from_prescription({"surfaces": surfaces, "sensor": {"distance": 60.0}})


def _diffractive():
    """A radial phase on an asphere and an XY phase on a conic, and an ideal lens behind them."""
    front = {"type": "even_asphere", "radius": 30.0, "conic": -0.8, "a4": 2e-5, "phase": {
        "type": "radial", "norm_radius": 5.0, "p2": -250.0, "p4": 30.0, "p6": -8.0}}  # fmt: skip
    back = {"type": "conic", "radius": -70.0, "conic": 0.6, "thickness": 4.0, "phase": {
        "type": "xy", "order": -1, "norm_radius": 4.0, "x": 60.0, "x2": 30.0, "xy": -9.0,
        "y2": 25.0, "x2y": 4.0, "y4": -3.0}}  # fmt: skip
    lens = {"type": "paraxial_lens", "focal_length": 60.0, "semi_diameter": 6.0, "material": 1.3}
    surfaces = {
        "1": {"semi_diameter": 5.0, "thickness": 3.0, "material": _GLASS, **front},
        "2": {"semi_diameter": 5.0, "material": "air", **back},
        "3": lens,
    }
    return lens_from_prescription({"surfaces": surfaces, "sensor": {"distance": 25.0}})


def _zernike_phases():
    """Zernike phases in both orders, of a plane and of a sphere that refracts."""
    front = {"type": "plane", "thickness": 2.0, "phase": {
        "type": "zernike_fringe", "norm_radius": 4.0, "z2": 4.0, "z4": 12.0, "z5": -3.0, "z6": 2.0,
        "z8": 1.5, "z9": -2.0, "z11": 0.4, "z37": 0.1}}  # fmt: skip
    back = {"type": "sphere", "radius": -40.0, "phase": {
        "type": "zernike_standard", "order": 2, "norm_radius": 6.0, "z3": 3.0, "z7": -0.5,
        "z14": 0.3, "z22": 0.2, "z91": 0.01}}  # fmt: skip
    surfaces = {
        "1": {"semi_diameter": 4.0, "material": _GLASS, **front},
        "2": {"semi_diameter": 5.0, "material": "air", **back},
    }
    return lens_from_prescription({"surfaces": surfaces, "sensor": {"distance": 70.0}})


def _spectrometer():
    """A grating that transmits, one on a concave mirror, whose higher orders vanish, and an ideal
    lens that the light comes back to.
    """
    surfaces = {
        "1": {"type": "plane", "semi_diameter": 6.0, "thickness": 40.0, "material": "air",
              "phase": {"type": "grating", "grooves": 100.0, "order": -1}},
        "2": {"type": "sphere", "radius": -150.0, "semi_diameter": 12.0, "thickness": -30.0,
              "material": "mirror", "phase": {"type": "grating", "grooves": 1740.0}},
        "3": {"type": "paraxial_lens", "focal_length": 50.0, "semi_diameter": 90.0,
              "material": "air"},
    }  # fmt: skip
    return lens_from_prescription({"surfaces": surfaces, "sensor": {"distance": -20.0}})


def _retina():
    """A lens out of place in front of a deep sphere, whose rim some rays miss."""
    front = {"type": "sphere", "radius": 12.0, "semi_diameter": 5.0, "thickness": 3.0,
             "material": _GLASS}  # fmt: skip
    back = {"type": "sphere", "radius": -12.0, "semi_diameter": 5.0, "material": "air"}
    return lens_from_prescription({
        "surfaces": {"1": front, "2": back},
        "elements": {"1": {"surfaces": [1, 2], "tilt_x": 4.0, "tilt_y": -3.0, "decenter_x": 0.3}},
        "sensor": {"distance": 9.0, "radius": -1.6},
    })  # fmt: skip


def _folded_film():
    """The folded lens with a conic for a sensor, behind its last break."""
    row = prescription_of(_folded())
    return lens_from_prescription(
        row | {"sensor": {"distance": 12.0, "radius": -15.0, "conic": -0.6}}
    )


def _plate(root):
    lens = load_lens(root / "conf/lens/wavefront_coding.yaml", F64)
    with torch.no_grad():
        for name, value in {"x3": 1e-4, "x2y": -2e-5, "xy2": 3e-5, "y3": 8e-5}.items():
            lens.variables([f"surfaces.5.{name}"])[f"surfaces.5.{name}"].fill_(value)
    return lens


def _loaded(name):
    return lambda root: load_lens(root / "conf" / "lens" / f"{name}.yaml", F64)


LENSES = {
    "cooke_triplet": _loaded("cooke_triplet"),
    "nikon": _loaded("nikon"),
    "asphere": _loaded("asphere"),
    "wavefront_coding": _plate,
    "posed": _posed,
    "b_spline": lambda root: _spline(),
    "polynomial": lambda root: _polynomial(),
    "even_aspheres": lambda root: _aspheres(),
    "odd_aspheres": lambda root: _odd_aspheres(),
    "anamorphic": lambda root: _anamorphic(),
    "cylinders": lambda root: _cylinders(),
    "zernike": lambda root: _zernike(),
    "forbes": lambda root: _forbes(),
    "grid": lambda root: _grid(),
    "clipped": lambda root: _clipped(),
    "figures": lambda root: _figures(),
    "own_surface": lambda root: _own_surface(),
    "diffractive": lambda root: _diffractive(),
    "zernike_phases": lambda root: _zernike_phases(),
    "spectrometer": lambda root: _spectrometer(),
    "mirrors": lambda root: _mirrors(),
    "folded": lambda root: _folded(),
    "retina": lambda root: _retina(),
    "folded_film": lambda root: _folded_film(),
}


def bundle(lens, count=100, fill=1.3, wavelengths=None):
    """Skew rays from a finite source that overfill the entrance pupil: some of them fail."""
    pupil = lens.first_order(550.0).entrance_pupil
    radius = 0.5 * fill * float(pupil.diameter.detach())
    generator = torch.Generator().manual_seed(1)
    r, angle = torch.rand((2, count), generator=generator, dtype=F64)
    r, angle = radius * r.sqrt(), 2.0 * math.pi * angle
    z = torch.full_like(r, float(pupil.z.detach()))
    target = torch.stack((r * torch.cos(angle), r * torch.sin(angle), z), -1)
    source = torch.tensor([4.0, -6.0, -200.0], dtype=F64)
    direction = target - source
    direction = direction / direction.norm(dim=-1, keepdim=True)
    if wavelengths is None:
        return Rays(source.expand(count, 3), direction, 550.0)
    return Rays(source.expand(count, 3), direction, torch.tensor(wavelengths, dtype=F64))


def returning(lens, rays):
    """The light that arrived, sent back: a little astray, and every eighth ray far."""
    hit = lens.trace(rays, record=True)
    direction = 0.01 * _random(*hit.direction.shape, seed=8) - hit.direction.detach()
    direction[::8, 0] += 0.8
    direction = direction / direction.norm(dim=-1, keepdim=True)
    ok = hit.valid.nonzero()[:, 0]
    # As many as there were: those that never arrived give way to others.
    kept = ok[torch.arange(len(hit.valid)) % len(ok)]
    return Rays(hit.position.detach()[kept], direction[kept], rays.wavelength)


@dataclass
class Traced:
    """What a trace gave, and the gradients of one number that all its outputs go into."""

    position: torch.Tensor
    direction: torch.Tensor
    path: torch.Tensor
    status: torch.Tensor
    surface: torch.Tensor
    valid: torch.Tensor
    gradients: dict


def traced(lens, rays, backend, sense=1.0, device="cpu", dtype=F64):
    """Trace, and sweep back, in a precision and on a device; results in double, on the CPU."""
    lens = copy.deepcopy(lens).to(device=device, dtype=dtype)
    lens.backend = backend
    position = rays.position.to(device, dtype).clone().requires_grad_()
    direction = rays.direction.to(device, dtype).clone().requires_grad_()
    wavelength = rays.wavelength
    if isinstance(wavelength, torch.Tensor):
        wavelength = wavelength.to(device)
    send = lens.trace if sense > 0.0 else lens.sensor_to_scene
    hit = send(Rays(position, direction, wavelength))
    shape = hit.valid.shape
    weights = _random(*shape, 7, seed=5).to(device, dtype)
    outputs = torch.cat((hit.position, hit.direction, hit.path_length[..., None]), -1)
    total = torch.where(hit.valid[..., None], outputs * weights, 0.0).sum()
    inputs = {"position": position, "direction": direction, **dict(lens.named_parameters())}
    found = torch.autograd.grad(total, list(inputs.values()), allow_unused=True)
    gradients = {
        k: torch.zeros_like(v) if g is None else g
        for (k, v), g in zip(inputs.items(), found, strict=True)
    }
    # A unit vector moves across itself only.
    across, along = gradients["direction"], direction.detach()
    gradients["direction"] = across - (across * along).sum(-1, keepdim=True) * along
    return Traced(
        *(v.detach().cpu().to(F64) for v in (hit.position, hit.direction, hit.path_length)),
        *(v.cpu() for v in (hit.status, hit.surface, hit.valid)),
        {k: g.cpu().to(F64) for k, g in gradients.items()},
    )


def _kind(name):
    """What a parameter is: its name without numbers and axes.

    The sensor's distance is a shift, as a ray's start: where rays begin at the sensor, shifts of
    both cancel, and what is left is rounding that the processor decides.
    """
    if name == "sensor_distance":
        return "position"
    return re.sub(r"\d+|_[xyz]$", "", name)


def _sizes(gradients):
    """How large each gradient is, and the largest of its kind.

    Some vanish by symmetry, but for rounding: their like say how large that may be.
    """
    own = {name: float(g.abs().max()) for name, g in gradients.items()}
    return {
        name: (size, max(s for other, s in own.items() if _kind(other) == _kind(name)))
        for name, size in own.items()
    }


def require_equal(found, expected, length=1e-11, relative=1e-11):
    """Same fates of all rays; of valid ones the same numbers (mm) and gradients."""
    assert torch.equal(found.status, expected.status)
    assert torch.equal(found.surface, expected.surface)
    valid = expected.valid
    assert valid.sum() > 0
    for name in ("position", "direction", "path"):
        a, b = getattr(found, name), getattr(expected, name)
        assert (a - b)[valid].abs().max() < length, name
    for name, (own, alike) in _sizes(expected.gradients).items():
        error = (found.gradients[name] - expected.gradients[name]).abs().max()
        assert error <= relative * max(own, 1e-2 * alike), name


def root_mean_square(values):
    """Of all numbers in a tensor."""
    return float(values.square().mean().sqrt())


def require_no_worse(found, reference, exact):
    """Errors in single precision, of what was found and of the reference's, against double.

    Both are rounding: half as much again passes for rays, and two and a half times for gradients:
    Triton's interpreter rounds products that the reference adds without, and processors differ
    (2.04 was seen on an Intel Xeon, for the phase plate's lens).
    """
    same = found.valid & reference.valid & exact.valid
    assert same.sum() > 0.9 * exact.valid.sum()
    for name in ("position", "direction", "path"):
        true = getattr(exact, name)[same]
        errors = [root_mean_square(getattr(t, name)[same] - true) for t in (found, reference)]
        assert errors[0] <= 1.5 * errors[1], name
    sizes = _sizes(exact.gradients)
    errors = [
        root_mean_square(
            torch.cat(
                [
                    (t.gradients[name] - exact.gradients[name]).flatten() / alike
                    for name, (_, alike) in sizes.items()
                    if alike > 0.0
                ]
            )
        )
        for t in (found, reference)
    ]
    assert errors[0] <= 2.5 * errors[1], errors
