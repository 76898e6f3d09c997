"""The lens of a plain task in Optiland, and the numbers that share one call of its tracer."""

from collections.abc import Callable
from typing import Any

import numpy as np

from scripts.lens_search.plain_task import STOP, Array, Beams, Lens, PlainTask

# A spot of rays that fail, over the focal length: of any, and of all more.
_ANY_FAIL, _ALL_FAIL = 0.1, 1.0
# How exactly rays meet aspheres, mm, since differences need it, and steps to it at most.
_NEWTON = {"tol": 1e-11, "max_iter": 30}


def built(task: PlainTask, values: Array) -> Any:
    """Return an Optiland lens of values (P,): its surfaces are those of the sequence, from 1."""
    import optiland.backend as be
    from optiland.materials.base import BaseMaterial
    from optiland.optic import Optic

    be.set_backend("numpy")
    order = np.argsort(task.wavelengths)
    waves = 1e-3 * np.array(task.wavelengths)[order]

    class Tabulated(BaseMaterial):
        """This material has an index for each wavelength of the task."""

        def __init__(self, indices: list[float]) -> None:
            super().__init__()
            self.indices = np.array(indices)[order]

        def _cache_state(self) -> tuple:
            return ()

        def _calculate_n(self, wavelength: Any, **_: Any) -> Any:
            return np.interp(wavelength, waves, self.indices)

        def _calculate_k(self, wavelength: Any, **_: Any) -> Any:
            return np.zeros_like(wavelength)

    lens = task.lens(values)
    optic = Optic()
    optic.add_surface(index=0, thickness=np.inf)
    thicknesses = [*lens.gaps, lens.image]
    for place, number in enumerate(task.sequence):
        row: dict[str, Any] = {"thickness": float(thicknesses[place]), "is_stop": number == STOP}
        if place < len(task.indices):
            row["material"] = Tabulated(task.indices[place])
        if number != STOP:
            c = float(lens.curvatures[number])
            if task.terms[number]:
                # Its tracer looks for the crossing from that with the base, here the plane.
                row |= {"surface_type": "even_asphere", "radius": np.inf, **_NEWTON}
                row["coefficients"] = [0.5 * c, *map(float, lens.coefficients[number])]
            else:
                row["radius"] = 1.0 / c if c else np.inf
        optic.add_surface(index=place + 1, **row)
    optic.add_surface(index=len(task.sequence) + 1)
    optic.set_aperture("EPD", task.focal_length / task.f_number)
    optic.set_field_type("angle")
    for tangent in task.field_tangents:
        optic.add_field(y=float(np.degrees(np.arctan(tangent))))
    for place, wave in enumerate(task.wavelengths):
        optic.add_wavelength(1e-3 * wave, is_primary=place == task.reference)
    return optic


def deferred_places(optic: Any) -> Callable[[], None]:
    """Return a function that places the surfaces by their thicknesses.

    Optiland places all of them, and checks their axes, for each thickness that it sets, which takes
    longer than its rays; here it only notes the thickness.
    """

    def note(value: Any, surface_number: int) -> None:
        optic.surfaces.surfaces[surface_number].thickness = value

    def place() -> None:
        surfaces = optic.surfaces.surfaces
        z = np.cumsum([float(surface.thickness) for surface in surfaces[1:-1]])
        for surface, own in zip(surfaces[2:], z, strict=True):
            surface.geometry.cs.z = np.array(own)

    optic.updater.set_thickness = note
    return place


def values_of(task: PlainTask, optic: Any) -> Array:
    """Return the values (P,) of an Optiland lens."""
    surfaces = optic.surfaces.surfaces[1:]
    z = np.array([float(s.geometry.cs.z) for s in surfaces])
    own = sorted((n, place) for place, n in enumerate(task.sequence) if n != STOP)
    shapes = [surfaces[place].geometry for _, place in own]
    curvatures = [
        2.0 * float(shape.coefficients[0]) if terms else 1.0 / float(shape.radius)
        for shape, terms in zip(shapes, task.terms, strict=True)
    ]
    coefficients = [
        float(a)
        for shape, terms in zip(shapes, task.terms, strict=True)
        for a in (shape.coefficients[1:] if terms else ())
    ]
    return np.array([*curvatures, *np.diff(z), *coefficients])


class Rays:
    """The rays of a task trace a lens by one call: all fields and wavelengths.

    They go through the paraxial entrance pupil, as those of the search do.
    """

    def __init__(self, task: PlainTask) -> None:
        self.task = task
        self.pupil = np.array(task.pupil).T * 0.5 * task.focal_length / task.f_number
        tangent = np.array(task.tangent)
        cosine = 1.0 / np.sqrt(1.0 + tangent * tangent)
        self.slope = tangent
        self.direction = np.stack([np.zeros(tangent.size), tangent * cosine, cosine])
        self.wavelength = 1e-3 * np.array(task.wavelengths)[np.array(task.wavelength)]
        self.weight, self.group = np.array(task.weight), np.array(task.group)
        self.own = [task.sequence.index(n) + 1 for n in range(task.surfaces)]

    def traced(self, optic: Any, lens: Lens) -> tuple[Array, Beams]:
        """Return RMS spots over the focal length (F,), and the beams of the limits.

        Args:
            optic: Optiland's lens.
            lens: the same in plain numbers.
        """
        from optiland.rays import RealRays

        f, fields = self.task.focal_length, len(self.task.field_tangents)
        focal_length, pupil = self.task.paraxial(lens)
        before = -f * np.ones(self.slope.size)
        y = self.pupil[1] + (before - pupil) * self.slope
        rays = RealRays(self.pupil[0], y, before, *self.direction, np.ones(y.size), self.wavelength)
        optic.surfaces.trace(rays)
        found = optic.surfaces
        x, y = np.asarray(found.x[-1]), np.asarray(found.y[-1])
        failed = ~np.isfinite(x + y)
        x, y = np.where(failed, 0.0, x), np.where(failed, 0.0, y)
        weight = np.where(failed, 0.0, self.weight)
        spots = np.empty(fields)
        for field in range(fields):
            mine = self.group == field
            w = weight[mine]
            middle = (w * y[mine]).sum() / max(w.sum(), 1e-12)
            square = (w * (x[mine] ** 2 + (y[mine] - middle) ** 2)).sum()
            lost = _ANY_FAIL + _ALL_FAIL * (1.0 - w.sum()) if failed[mine].any() else 0.0
            spots[field] = np.sqrt(square) / f + lost
        radii = np.nan_to_num(np.hypot(found.x, found.y))
        chief = self.group >= fields
        beams = Beams(
            focal_length,
            radii[self.own].max(axis=1),
            float(radii[self.task.sequence.index(STOP) + 1, self.group == 0].max()),
            y[chief],
            np.nan_to_num(np.asarray(found.M[-1])[chief], nan=1.0),
        )
        return spots, beams
