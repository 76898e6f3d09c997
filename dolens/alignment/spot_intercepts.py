"""Ray intercepts of many lenses are functions of the few parameters in which the lenses differ."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from torch.func import jacfwd, vmap

from dolens.optics.backend import choose_backend
from dolens.optics.lens import Lens
from dolens.optics.lens_family import FamilyRays, LensFamily, shared_rays
from dolens.optics.rays import Components, Rays, Status
from dolens.optics.trace import trace_surfaces, trace_to_sensor
from dolens.optimize.image_quality import without_edges

# Rays traced at a time, a derivative counting like a ray: bounds intermediate results to 0.1 GB by
# the kernels, which are called seldom enough; to 0.4 GB by the reference, whose operations are then
# long beside what calling them takes.
_BY_KERNELS, _BY_REFERENCE = 1 << 20, 1 << 18


class SpotIntercepts(Protocol):
    """Traces N fixed rays through lenses of which F parameters differ; no aperture clips them.

    A ray that misses a surface or is reflected totally has an intercept that is finite, and means
    nothing.

    Attributes:
        rays_at_a_time: what a call should not exceed by much, a derivative counting like a ray.
    """

    rays_at_a_time: int

    def points(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return ray intercepts (K, 2, N), mm, of lenses with parameters (K, F), and which lenses
        lose a ray (K,).
        """
        ...

    def derivatives(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return ray intercepts (K, 2, N), mm, and their derivatives (K, 2, F, N) with respect to
        the parameters.
        """
        ...


def spot_intercepts(lens: Lens, rays: Rays, names: Sequence[str]) -> SpotIntercepts:
    """Return the ray intercepts of a lens as functions of its parameters.

    The lenses are a `LensFamily`, which the kernels trace by one call; where they do not serve, a
    batch of `torch.func.vmap` over the reference tracer, and the log says so.

    Args:
        lens: in double precision; its `backend` says what traces.
        rays: N of them.
        names: of F parameters, each a single number.

    Raises:
        InputError: no such parameter, or a backend that cannot serve.
    """
    opened = without_edges(lens)
    ray = Components(*(c.double() for c in rays.components()))
    if choose_backend(opened.system(), rays) == "reference":
        return ReferenceIntercepts(opened, tuple(names), ray, rays.wavelength)
    wavelengths, shared = shared_rays(Rays.from_components(ray, rays.wavelength))
    return KernelIntercepts(LensFamily(opened, names, wavelengths), shared)


@dataclass(frozen=True)
class KernelIntercepts:
    """Traces a family of lenses by the kernels, which give derivatives of every ray.

    Attributes:
        family: of lenses whose apertures clip nothing.
        rays: of a single lens.
        rays_at_a_time: see `SpotIntercepts`.
    """

    family: LensFamily
    rays: FamilyRays
    rays_at_a_time: int = _BY_KERNELS

    def points(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return what `SpotIntercepts.points` does."""
        hit = self.family.trace(values, self.rays.of_each(len(values)))
        lost = (hit.status != int(Status.OK)).any(-1)
        return hit.position[..., :2].mT, lost

    def derivatives(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return what `SpotIntercepts.derivatives` does; both are zero of a ray that is lost."""
        found = self.family.jacobians(values, self.rays.of_each(len(values)))
        return found.values, found.derivatives


@dataclass(frozen=True)
class ReferenceIntercepts:
    """Traces lenses by the reference tracer under `torch.func.vmap` and forward derivatives.

    Attributes:
        lens: whose apertures clip nothing.
        names: of F parameters.
        ray: N of them.
        wavelength: nm, theirs.
        rays_at_a_time: see `SpotIntercepts`.
    """

    lens: Lens
    names: tuple[str, ...]
    ray: Components
    wavelength: float | Tensor
    rays_at_a_time: int = _BY_REFERENCE

    def points(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return what `SpotIntercepts.points` does."""
        with one_thread():
            points, margin = vmap(self._land)(values)
        return points, ~(margin > 0.0)

    def derivatives(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return what `SpotIntercepts.derivatives` does."""

        def twice(row: Tensor) -> tuple[Tensor, Tensor]:
            points, _ = self._land(row)
            return points, points.detach()

        differentiated: Callable[[Tensor], tuple[Tensor, Tensor]] = jacfwd(twice, has_aux=True)
        # Lenses cannot have threads of their own: PyTorch counts the levels of forward derivatives
        # for the whole process.
        with one_thread():
            derivatives, points = vmap(differentiated)(values)
        return points, derivatives.mT

    def _land(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return points (2, N), mm, and the least of what ends a ray, positive where all arrive."""
        system = self.lens.system(dict(zip(self.names, values.unbind(), strict=True)))
        last = trace_surfaces(system, self.ray, self.wavelength)
        traced = trace_to_sensor(system, last, self.wavelength)
        ends = [m for row in traced.margins for m in (row.met, row.transmitted) if m is not None]
        margin = torch.stack([end.detach().amin() for end in ends]).amin()
        return torch.stack([traced.ray.x, traced.ray.y]), margin


@contextmanager
def one_thread() -> Iterator[None]:
    """Run many short operations on one thread.

    Split among PyTorch's threads they wait for one another, which takes up to thirty times as long.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
