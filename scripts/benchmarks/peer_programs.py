"""Other programs' models of our lenses: dO, DeepLens and Optiland, each from a path.

Each gets the lens's shapes and places, and constant indices: the lens's own at the rays'
wavelength.  Nothing of theirs is installed or copied; `scripts/benchmark.py --peers` names where
they lie.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor

from benchmarks.cases import WAVELENGTH
from dolens import Lens, Rays
from dolens.errors import InputError
from dolens.optics.surfaces import Surface

_FLAT = ("plane", "aperture")


class Peer(ABC):
    """Another program's model of a lens.

    Args:
        lens: ours; on the CPU.

    Attributes:
        name: as tables say it.
        module: that it is imported as; a folder of its path.
        word: that names it on the command line.
        clips: whether its traces have our apertures.
        leaf_is_radius: its parameter is the radius R, and not the curvature 1/R.
    """

    name: str
    module: str
    word: str
    clips = True
    leaf_is_radius = False

    @abstractmethod
    def __init__(self, lens: Lens) -> None: ...

    @abstractmethod
    def sensor_points(self, rays: Rays, gradients: bool) -> tuple[Tensor, dict[str, Tensor]]:
        """Points (N, 2) on the sensor, mm, and by surface number its curvature or radius.

        The points are of all rays, whatever became of them.  With `gradients` the parameters are
        leaves of the graph.
        """


class SourceProgram(Peer):
    """The dO paper's own program, `diffoptics`."""

    name, module, word = "dO", "diffoptics", "do"

    def __init__(self, lens: Lens) -> None:
        import diffoptics

        self._program = diffoptics
        indices = lens.system().indices(WAVELENGTH)
        self.model = source_lens(lens, [(float(index), 0.0) for index in indices])
        numbers = list(lens.surfaces)
        self._curved = [(n, numbers.index(n)) for n, _ in _curved(lens)]

    def sensor_points(self, rays: Rays, gradients: bool) -> tuple[Tensor, dict[str, Tensor]]:
        """Trace as `Peer` says; the leaves are curvatures."""
        leaves = {}
        for number, place in self._curved:
            surface = self.model.surfaces[place]
            surface.c = leaves[number] = surface.c.detach().requires_grad_(gradients)
        ray = self._program.Ray(rays.position, rays.direction, rays.wavelength)
        return self.model.trace_to_sensor(ray)[:, :2], leaves


def source_lens(lens: Lens, dispersions: Sequence[tuple[float, float]] | None = None):  # noqa: ANN201
    """A lens of ours as dO's, with the constants A and B of each medium, or with its own."""
    import diffoptics

    places = [float(z.detach()) for z in lens.system().vertices]
    materials = []
    for a, b in dispersions or [(own.a, own.b) for own in lens.materials]:
        material = diffoptics.Material("vacuum")
        material.A, material.B = a, b
        materials.append(material)
    model = diffoptics.Lensgroup()
    model.load(
        [_source_surface(s, z) for s, z in zip(lens.surfaces.values(), places[:-1], strict=True)],
        materials,
    )
    model.d_sensor = places[-1]
    return model


def _source_surface(surface: Surface, z: float):  # noqa: ANN202 - of another program
    """A surface of ours at z (mm) as dO's."""
    import diffoptics

    p = {name: float(value.detach()) for name, value in surface.named_parameters()}
    rim = surface.semi_diameter
    if surface.kind == "xy_polynomial":
        names = ("", "y", "x", "y2", "xy", "x2", "y3", "xy2", "x2y", "x3")
        coefficients = [p.get(name, 0.0) for name in names]
        return diffoptics.XYPolynomial(rim, z, J=3, ai=coefficients, b=p.get("b", 0.0))
    powers = _even_powers(p)
    return diffoptics.Aspheric(
        rim, z, p.get("curvature", 0.0), p.get("conic", 0.0), powers if powers else None
    )


class DeepLens(Peer):
    """DeepLens's surfaces, traced one after the other as its `GeoLens` does.

    Only its optics are imported: its package asks for networks' libraries as a whole.
    """

    name, module, word = "DeepLens", "deeplens", "deeplens"

    def __init__(self, lens: Lens) -> None:
        from deeplens import geometric_surface as shapes
        from deeplens.light.ray import Ray

        self._ray = Ray
        system = lens.system()
        self._indices = [float(index) for index in system.indices(WAVELENGTH)]
        gaps = [float(gap.detach()) for gap in (*system.thicknesses, system.sensor_distance)]
        self._surfaces, self._curved = [], {}
        for (number, surface), gap in zip(lens.surfaces.items(), gaps, strict=True):
            p = {name: float(value.detach()) for name, value in surface.named_parameters()}
            rim, c = surface.semi_diameter, p.get("curvature", 0.0)
            if surface.kind == "aperture":
                made = shapes.Aperture(rim, gap)
            elif surface.kind in _FLAT or c == 0.0:
                made = shapes.Plane(rim, gap, "air")
            elif surface.kind == "sphere":
                made = shapes.Spheric(c, rim, gap, "air")
            elif surface.kind in ("conic", "even_asphere"):
                made = shapes.Aspheric(rim, gap, c, p["conic"], _even_powers(p), "air")
            else:
                raise InputError(f"no model of type '{surface.kind}'")
            self._surfaces.append(made)
            if c != 0.0:
                self._curved[number] = made

    def sensor_points(self, rays: Rays, gradients: bool) -> tuple[Tensor, dict[str, Tensor]]:
        """Trace as `Peer` says; the leaves are curvatures."""
        leaves = {}
        for number, surface in self._curved.items():
            surface.c = leaves[number] = surface.c.detach().requires_grad_(gradients)
        ray = self._ray(rays.position.clone(), rays.direction.clone(), WAVELENGTH * 1e-3)
        for surface, before, behind in zip(
            self._surfaces, self._indices[:-1], self._indices[1:], strict=True
        ):
            ray = surface.ray_reaction(ray, before, behind)
            # Each surface has its vertex at z = 0, and so has the sensor behind them.
            ray.o[..., 2] -= surface.d_next
        return ray.prop_to(0.0).o[:, :2], leaves


class Optiland(Peer):
    """Optiland with its PyTorch backend; apertures are not given to it."""

    name, module, word = "Optiland", "optiland", "optiland"
    clips, leaf_is_radius = False, True

    def __init__(self, lens: Lens) -> None:
        import optiland.backend as be

        be.set_backend("torch")
        be.set_precision(str(lens.dtype)[6:])
        be.grad_mode.disable()
        self._backend = be
        self.optic = optiland_optic(lens)
        self._surfaces = self.optic.surfaces
        numbers = list(lens.surfaces)
        self._curved = {
            n: self._surfaces.surfaces[1 + numbers.index(n)].geometry for n, _ in _curved(lens)
        }

    def sensor_points(self, rays: Rays, gradients: bool) -> tuple[Tensor, dict[str, Tensor]]:
        """Trace as `Peer` says; the leaves are radii."""
        from optiland.rays import RealRays

        be = self._backend
        leaves = {}
        for number, shape in self._curved.items():
            shape.radius = torch.as_tensor(shape.radius).detach().requires_grad_(gradients)
            leaves[number] = shape.radius
        one = torch.ones_like(rays.position[:, 0])
        components = (*rays.position.unbind(-1), *rays.direction.unbind(-1))
        (be.grad_mode.enable if gradients else be.grad_mode.disable)()
        traced = RealRays(*components, one, one * WAVELENGTH * 1e-3)
        # The object's surface is left out: the rays start where ours do.
        traced = self._surfaces.trace(traced, skip=1, record=False)
        return torch.stack((traced.x, traced.y), -1), leaves


def optiland_optic(lens: Lens):  # noqa: ANN201 - of another program
    """A lens of ours as Optiland's, whatever backend it works with."""
    from optiland.materials import IdealMaterial
    from optiland.optic import Optic

    system = lens.system()
    indices = system.indices(WAVELENGTH)
    gaps = [float(gap.detach()) for gap in (*system.thicknesses, system.sensor_distance)]
    optic = Optic()
    add = optic.surfaces.add
    add(index=0, thickness=float("inf"))
    for place, surface in enumerate(lens.surfaces.values(), 1):
        p = {name: float(value.detach()) for name, value in surface.named_parameters()}
        c = p.get("curvature", 0.0)
        options = {"radius": 1.0 / c if c else float("inf")}
        if surface.kind in ("conic", "even_asphere"):
            options |= {"surface_type": "even_asphere", "conic": p["conic"]}
            options |= {"coefficients": [0.0, *_even_powers(p)]}
        add(
            index=place,
            thickness=gaps[place - 1],
            material=IdealMaterial(n=float(indices[place])),
            is_stop=place == lens.stop,
            **options,
        )
    add(index=len(gaps) + 1)
    return optic


PEERS: tuple[type[Peer], ...] = (SourceProgram, DeepLens, Optiland)


@contextmanager
def default_dtype(dtype: torch.dtype) -> Iterator[None]:
    """Torch's default precision, which dO and DeepLens take for theirs."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def _curved(lens: Lens) -> list[tuple[str, Surface]]:
    """Surfaces that are not flat, with their numbers."""
    return [
        (number, surface)
        for number, surface in lens.surfaces.items()
        if surface.kind not in _FLAT and float(getattr(surface, "curvature", torch.zeros(())))
    ]


def _even_powers(parameters: Mapping[str, float]) -> list[float]:
    """Coefficients of r⁴, r⁶, ... up to the last that there is."""
    powers = [int(name[1:]) for name in parameters if name[0] == "a" and name[1:].isdecimal()]
    return [parameters.get(f"a{power}", 0.0) for power in range(4, max(powers, default=2) + 1, 2)]
