"""Other programs, where they are installed, on the same rays in turn.

A peer traces lenses of spheres with constant indices: those of the lens at the rays' wavelength.
Apertures are left to the peer, and errors are those of rays that our float64 reference finds valid.
"""

from abc import ABC, abstractmethod
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor

from benchmarks.cases import WAVELENGTH, Case, chunks, load, make_rays
from benchmarks.errors import compared_rays, reference_case
from benchmarks.results import Results, Row
from benchmarks.timing import Contender, by_turns
from benchmarks.tracing import (
    FORWARD,
    GRADIENT,
    Plan,
    ratio_to,
    row_of_timing,
)
from benchmarks.tracing import forward as forward_trace
from benchmarks.tracing import gradient as gradient_trace
from dolens import Lens, Rays

# Peers keep kilobytes a ray too.
CHUNK = 100_000
SPHERES = ("cooke_triplet",)


class Peer(ABC):
    """Another program's model of a lens of spheres.

    Args:
        lens: ours; on the CPU.
    """

    name: str
    module: str
    precisions: tuple[torch.dtype, ...]

    @abstractmethod
    def __init__(self, lens: Lens) -> None: ...

    @abstractmethod
    def sensor_points(self, rays: Rays, gradients: bool) -> tuple[Tensor, list[Tensor]]:
        """Points (N, 2) on the sensor, mm, and leaves with gradients: curvatures or radii."""


class Optiland(Peer):
    """Optiland 0.6 with its PyTorch backend; apertures are not given to it."""

    name, module = "Optiland", "optiland"
    precisions = (torch.float32, torch.float64)

    def __init__(self, lens: Lens) -> None:
        import optiland.backend as be
        from optiland.materials import IdealMaterial
        from optiland.optic import Optic

        be.set_backend("torch")
        be.set_precision(str(lens.dtype)[6:])
        be.grad_mode.disable()
        self._backend = be
        system = lens.system()
        indices = system.indices(WAVELENGTH)
        gaps = [float(gap.detach()) for gap in (*system.thicknesses, system.sensor_distance)]
        self._optic = Optic()
        add = self._optic.surfaces.add
        add(index=0, thickness=float("inf"))
        for number, surface in enumerate(system.surfaces, 1):
            add(
                index=number,
                radius=1.0 / float(surface.parameters["curvature"].detach()),
                thickness=gaps[number - 1],
                material=IdealMaterial(n=float(indices[number])),
                is_stop=number == lens.stop,
            )
        add(index=len(gaps) + 1)
        self._geometries = [s.geometry for s in self._optic.surfaces.surfaces[1:-1]]
        self._surfaces = self._optic.surfaces

    def sensor_points(self, rays: Rays, gradients: bool) -> tuple[Tensor, list[Tensor]]:
        """As `Peer`; the leaves are radii."""
        from optiland.rays import RealRays

        be = self._backend
        leaves = []
        for geometry in self._geometries:
            geometry.radius = torch.as_tensor(geometry.radius).detach().requires_grad_(gradients)
            leaves.append(geometry.radius)
        one = torch.ones_like(rays.position[:, 0])
        components = (*rays.position.unbind(-1), *rays.direction.unbind(-1))
        (be.grad_mode.enable if gradients else be.grad_mode.disable)()
        traced = RealRays(*components, one, one * WAVELENGTH * 1e-3)
        # The object's surface is left out: the rays start where ours do.
        traced = self._surfaces.trace(traced, skip=1, record=False)
        return torch.stack((traced.x, traced.y), -1), leaves


class SourceProgram(Peer):
    """The dO paper's own program, `diffoptics`; it works in float32."""

    name, module = "dO", "diffoptics"
    precisions = (torch.float32,)

    def __init__(self, lens: Lens) -> None:
        import diffoptics

        self._ray = diffoptics.Ray
        system = lens.system()
        places = [float(z.detach()) for z in system.vertices]
        surfaces, materials = [], []
        for surface, z in zip(system.surfaces, places, strict=False):
            curvature = float(surface.parameters["curvature"].detach())
            surfaces.append(diffoptics.Aspheric(surface.semi_diameter, z, curvature))
        for index in system.indices(WAVELENGTH):
            material = diffoptics.Material("vacuum")
            material.A, material.B = float(index), 0.0
            materials.append(material)
        self._lens = diffoptics.Lensgroup()
        self._lens.load(surfaces, materials)
        self._lens.d_sensor = places[-1]

    def sensor_points(self, rays: Rays, gradients: bool) -> tuple[Tensor, list[Tensor]]:
        """As `Peer`."""
        leaves = []
        for surface in self._lens.surfaces:
            surface.c = surface.c.detach().requires_grad_(gradients)
            leaves.append(surface.c)
        ray = self._ray(rays.position, rays.direction, rays.wavelength)
        return self._lens.trace_to_sensor(ray)[:, :2], leaves


PEERS: tuple[type[Peer], ...] = (Optiland, SourceProgram)


def found() -> list[type[Peer]]:
    """Those whose module is installed."""
    return [peer for peer in PEERS if find_spec(peer.module) is not None]


def describe() -> str:
    """Which peers were found, and which were not."""
    here = found()
    lines = [f"{p.name}: {'found' if p in here else 'not installed'}" for p in PEERS]
    deeplens = "found, but there is no adapter" if find_spec("deeplens") else "not installed"
    return "; ".join([*lines, f"DeepLens: {deeplens}"])


def measure(results: Results, plan: Plan) -> None:
    """Rows of all peers and of our reference, by turns."""
    for part in (FORWARD, GRADIENT):
        for name in (lens for lens in plan.lenses if lens in SPHERES):
            for dtype in plan.dtypes:
                for threads in plan.threads:
                    torch.set_num_threads(threads)
                    _compare(results, plan, part, name, dtype, threads)


def _compare(
    results: Results, plan: Plan, part: str, name: str, dtype: torch.dtype, threads: int
) -> None:
    cpu = torch.device("cpu")
    count = min(max(plan.rays), 1_000_000)
    rays = make_rays(name, count, dtype, cpu)
    ours = {b: Case(name, load(name, dtype, b, cpu), rays) for b in plan.backends}
    models: dict[str, Peer] = {}
    for peer in found():
        row = {"part": f"peers: {part}", "lens": name, "backend": peer.name, "threads": threads}
        row |= {"dtype": str(dtype)[6:], "rays": count, "failed": True}
        if dtype not in peer.precisions:
            results.add(Row(**row, note=f"not measured: it has no {str(dtype)[6:]}"))
            continue
        try:
            models[peer.name] = peer(ours["reference"].lens)
        except Exception as error:  # of another program: the table says what happened
            results.add(Row(**row, note=f"failed: {type(error).__name__}: {error}"))
    runs = {backend: _ours(part, case) for backend, case in ours.items()}
    runs |= {key: _theirs(part, model, rays) for key, model in models.items()}
    timings = by_turns([Contender(k, run, count) for k, run in runs.items()], plan.seconds, cpu)
    case = ours["reference"]
    exact = reference_case(case)
    for key, timing in timings.items():
        row = row_of_timing(
            f"peers: {part}", case, key, dtype, threads, count, timing, "ns/ray/surface"
        )
        if not timing.failure:
            row |= ratio_to(timing, timings["reference"])
            if key in models:
                row |= _error(part, models[key], case, exact)
        results.add(Row(**row))


def _ours(part: str, case: Case):  # noqa: ANN202 - a function of nothing
    chunk = CHUNK if case.lens.backend == "reference" else case.count
    if part == FORWARD:
        return lambda: forward_trace(case, chunk)
    return lambda: gradient_trace(case, chunk, of_rays=False)


def _theirs(part: str, model: Peer, rays: Rays):  # noqa: ANN202 - a function of nothing
    def forward() -> None:
        with torch.no_grad():
            for piece in chunks(rays, CHUNK):
                model.sensor_points(piece, gradients=False)

    def gradient() -> None:
        for piece in chunks(rays, CHUNK):
            points, _ = model.sensor_points(piece, gradients=True)
            points.square().sum().backward()

    return forward if part == FORWARD else gradient


def _error(part: str, model: Peer, case: Case, exact: Case) -> dict[str, Any]:
    """Of sensor points; of gradients in the curvatures, where all rays of the loss are valid."""
    rays = compared_rays(case)
    with torch.no_grad():
        expected = exact.lens.trace(exact.rays)
    valid = expected.valid
    passing = Rays(rays.position[valid], rays.direction[valid], rays.wavelength)
    against = {
        "error_against": "float64 reference, same rays",
        "valid": float(valid.double().mean()),
    }
    points, leaves = model.sensor_points(passing, gradients=part == GRADIENT)
    difference = points.detach().double() - expected.position[valid, :2]
    point = float(difference.norm(dim=-1).max())
    note = "indices are constants; curvatures only" if part == GRADIENT else "indices are constants"
    if part == FORWARD:
        return against | {"error": point, "error_unit": "mm", "note": note}
    points.square().sum().backward()
    exact.lens.zero_grad(set_to_none=True)
    through = Rays(exact.rays.position[valid], exact.rays.direction[valid], exact.rays.wavelength)
    exact.lens.trace(through).position[:, :2].square().sum().backward()
    worst = 0.0
    for surface, leaf in zip(exact.lens.surfaces.values(), leaves, strict=True):
        curvature, slope = surface.curvature.detach(), surface.curvature.grad
        theirs = leaf.grad.double()
        # A radius R = 1/c: dL/dR = -c² dL/dc.
        ours = slope if model.name != "Optiland" else -(curvature**2) * slope
        worst = max(worst, float(abs(theirs - ours) / abs(ours)))
    return against | {"error": worst, "error_unit": "relative", "note": note}
