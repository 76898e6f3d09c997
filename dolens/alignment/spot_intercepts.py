"""Ray intercepts of many lenses are functions of the few parameters in which the lenses differ."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from torch.func import jacfwd, vmap

from dolens.optics.backend import choose_backend
from dolens.optics.family_parts import intercept_parts, jacobian_parts
from dolens.optics.lens import Lens
from dolens.optics.lens_family import FamilyRays, LensFamily, shared_rays
from dolens.optics.rays import Components, Rays
from dolens.optics.trace import trace_surfaces, trace_to_sensor
from dolens.optimize.image_quality import without_edges

# Numbers that the kernels find at a time stay in the cache, 4 MB, where moments are made of them.
_BY_KERNELS = 1 << 19
# Numbers of a traced ray: position, direction, path length and status.
_OF_A_RAY = 8
# Rays that the reference traces at a time, a derivative counting like a ray: its operations are
# long beside what calling them takes, and intermediate results take 0.4 GB.
_BY_REFERENCE = 1 << 18


class SpotIntercepts(Protocol):
    """Traces N fixed rays through lenses of which F parameters differ; no aperture clips them.

    A ray that misses a surface or is reflected totally has an intercept that is finite, and means
    nothing.
    """

    def points(self, values: Tensor) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """Yield ray intercepts of lenses with parameters (K, F), some lenses at a time.

        Yields:
            Which lenses; points (k, 2, N), mm; and which lenses lose a ray (k,).
        """
        ...

    def derivatives(self, values: Tensor) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """Yield ray intercepts with their derivatives, some lenses at a time.

        Yields:
            Which lenses; points (k, 2, N), mm; and derivatives (k, 2, F, N).
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
    """

    family: LensFamily
    rays: FamilyRays

    def points(self, values: Tensor) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """Yield what `SpotIntercepts.points` does."""
        size = self._lenses_at_a_time(_OF_A_RAY)
        for rows, points, arrives in intercept_parts(self.family, values, self.rays, size):
            yield rows, points.mT, ~arrives.all(-1)

    def derivatives(self, values: Tensor) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """Yield what `SpotIntercepts.derivatives` does; both are zero of a ray that is lost."""
        size = self._lenses_at_a_time(2 * (1 + self.family.count))
        for rows, found in jacobian_parts(self.family, values, self.rays, size):
            yield rows, found.values, found.derivatives

    def _lenses_at_a_time(self, numbers: int) -> int:
        """Return how many lenses have no more than `_BY_KERNELS`, with so many of each ray."""
        return max(1, _BY_KERNELS // (numbers * self.rays.position.shape[1]))


@dataclass(frozen=True)
class ReferenceIntercepts:
    """Traces lenses by the reference tracer under `torch.func.vmap` and forward derivatives.

    Attributes:
        lens: whose apertures clip nothing.
        names: of F parameters.
        ray: N of them.
        wavelength: nm, theirs.
    """

    lens: Lens
    names: tuple[str, ...]
    ray: Components
    wavelength: float | Tensor

    def points(self, values: Tensor) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """Yield what `SpotIntercepts.points` does."""
        for rows, (points, margin) in self._batches(self._land, values, 1):
            yield rows, points, ~(margin > 0.0)

    def derivatives(self, values: Tensor) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """Yield what `SpotIntercepts.derivatives` does."""

        def points_twice(row: Tensor) -> tuple[Tensor, Tensor]:
            points, _ = self._land(row)
            return points, points.detach()

        differentiated = jacfwd(points_twice, has_aux=True)
        for rows, found in self._batches(differentiated, values, 1 + len(self.names)):
            derivatives, points = found
            yield rows, points, derivatives.mT

    @torch.no_grad()
    def _batches(
        self, function: Callable[..., tuple[Tensor, Tensor]], values: Tensor, copies: int
    ) -> Iterator[tuple[slice, tuple[Tensor, Tensor]]]:
        """Yield which lenses, and a function of each of them, on one thread.

        Batches cannot have threads of their own: PyTorch counts the levels of forward derivatives
        for the whole process.
        """
        size = max(1, _BY_REFERENCE // (copies * self.ray.x.numel()))
        first = 0
        for part in values.split(size):
            with one_thread():
                found = vmap(function)(part)
            yield slice(first, first + len(part)), found
            first += len(part)

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
