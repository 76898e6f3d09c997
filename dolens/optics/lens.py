"""A lens: the state that everything else is a function of."""

import difflib
import fnmatch
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from dolens.errors import InputError
from dolens.optics.fields import Fields
from dolens.optics.materials import Material
from dolens.optics.paraxial import FirstOrder, first_order
from dolens.optics.rays import Components, Rays, TracedRays
from dolens.optics.surfaces.base import Surface, SurfaceState
from dolens.optics.system import OpticalSystem
from dolens.optics.trace import (
    Trace,
    first_failure,
    stop_gradient_where_invalid,
    trace_surfaces,
    trace_to_plane,
)


class Lens(nn.Module):
    """Surfaces, gaps, media and a sensor plane.

    Parameters are named as users write them: `surfaces.1.curvature`, `surfaces.5.x2y`,
    `thicknesses.3`, `sensor_distance`.

    Args:
        surfaces: in the order that light meets them; the first vertex is at z = 0.
        thicknesses: gaps between neighbouring vertices, mm, one fewer than surfaces.
        sensor_distance: last vertex to sensor, mm.
        materials: before surface 1 and after each surface.
        stop: number of the stop surface, from 1.
        index_model: the model that the materials were made with.
        name: for titles and messages.
        sensor_diameter: mm, the image circle the prescription gives; not tested by a trace.
        dtype: precision of the parameters, and of the rays.
        wavelengths: nm, that the prescription is meant for; a trace takes its rays' own.
        reference_wavelength: nm, one of them; the first unless it is given.
        fields: field points that the prescription is meant for.
        object_distance: mm from the object to the first vertex; None is infinity.
    """

    def __init__(
        self,
        surfaces: Sequence[Surface],
        thicknesses: Sequence[float],
        sensor_distance: float,
        materials: Sequence[Material],
        stop: int,
        index_model: str = "dfc",
        name: str = "",
        sensor_diameter: float | None = None,
        dtype: torch.dtype = torch.float64,
        wavelengths: Sequence[float] | None = None,
        reference_wavelength: float | None = None,
        fields: Fields | None = None,
        object_distance: float | None = None,
    ) -> None:
        super().__init__()
        count = len(surfaces)
        if count == 0 or len(thicknesses) != count - 1 or len(materials) != count + 1:
            raise InputError(
                f"lens '{name}': {count} surfaces need {count - 1} thicknesses and {count + 1} "
                f"materials, not {len(thicknesses)} and {len(materials)}"
            )
        if not 1 <= stop <= count:
            raise InputError(f"lens '{name}': stop must be a surface from 1 to {count}, not {stop}")
        self.name = name
        self.stop = stop
        self.index_model = index_model
        self.sensor_diameter = sensor_diameter
        self.wavelengths = None if wavelengths is None else tuple(wavelengths)
        if reference_wavelength is None and self.wavelengths:
            reference_wavelength = self.wavelengths[0]
        self.reference_wavelength = reference_wavelength
        self.fields = fields
        self.object_distance = object_distance
        self.materials = tuple(materials)
        self.surfaces = nn.ModuleDict(
            {str(number): surface for number, surface in enumerate(surfaces, 1)}
        )
        # Assigned one by one: given a dict, ParameterDict sorts its keys as text (1, 10, 2, ...).
        self.thicknesses = nn.ParameterDict()
        for number, gap in enumerate(thicknesses, 1):
            self.thicknesses[str(number)] = nn.Parameter(torch.tensor(float(gap), dtype=dtype))
        self.sensor_distance = nn.Parameter(torch.tensor(float(sensor_distance), dtype=dtype))
        self.to(dtype)

    @property
    def dtype(self) -> torch.dtype:
        """The precision of the parameters and of traced rays."""
        return self.sensor_distance.dtype

    @property
    def device(self) -> torch.device:
        """Where the parameters live."""
        return self.sensor_distance.device

    def variables(self, patterns: Sequence[str]) -> dict[str, nn.Parameter]:
        """Parameters by name or shell pattern, in the order of the lens.

        Args:
            patterns: for example `["surfaces.*.curvature", "sensor_distance"]`.

        Raises:
            InputError: a pattern matches nothing; the message names near ones.
        """
        parameters = dict(self.named_parameters())
        chosen: set[str] = set()
        for pattern in patterns:
            found = fnmatch.filter(parameters, pattern)
            if not found:
                near = difflib.get_close_matches(pattern, parameters, n=3, cutoff=0.4)
                hint = f"; near: {', '.join(near)}" if near else ""
                raise InputError(f"lens '{self.name}' has no parameter '{pattern}'{hint}")
            chosen.update(found)
        return {name: value for name, value in parameters.items() if name in chosen}

    def system(self, values: Mapping[str, Tensor] | None = None) -> OpticalSystem:
        """The lens as pure functions see it, with the stored values or others in their place.

        Args:
            values: parameter name → tensor used instead of the stored one.
        """
        values = dict(values or {})
        surfaces = []
        for number, surface in self.surfaces.items():
            parameters = {
                name: values.pop(f"surfaces.{number}.{name}", value)
                for name, value in (*surface.named_parameters(), *surface.named_buffers())
            }
            surfaces.append(SurfaceState(type(surface), parameters, surface.semi_diameter))
        thicknesses = [
            values.pop(f"thicknesses.{number}", gap) for number, gap in self.thicknesses.items()
        ]
        sensor_distance = values.pop("sensor_distance", self.sensor_distance)
        if values:
            raise InputError(f"lens '{self.name}' has no parameter '{next(iter(values))}'")
        return OpticalSystem(surfaces, thicknesses, sensor_distance, self.materials, self.stop)

    def forward(self, rays: Rays) -> TracedRays:
        """The same as `trace`."""
        return self.trace(rays)

    def trace(self, rays: Rays, record: bool = False) -> TracedRays:
        """Trace rays from the object through every surface to the sensor plane.

        Args:
            rays: travelling towards +z; they may start anywhere, and are first moved along their
                own line to the vertex plane of surface 1.
            record: whether to keep the intersection with every surface.
        """
        system = self.system()
        ray = self._components(rays)
        traced = trace_surfaces(system, ray, rays.wavelength, 1.0, path_length=True, record=record)
        traced = trace_to_plane(system, traced, system.vertices[-1], rays.wavelength, 1.0)
        return _result(traced)

    def sensor_to_scene(self, rays: Rays, record: bool = False) -> TracedRays:
        """Trace rays backwards, from the sensor's side through every surface into object space.

        Args:
            rays: travelling towards -z.
            record: whether to keep the intersection with every surface, last surface first.

        Returns:
            The rays on surface 1, travelling towards -z in the medium before it.
        """
        system = self.system()
        ray = self._components(rays)
        return _result(
            trace_surfaces(system, ray, rays.wavelength, -1.0, path_length=True, record=record)
        )

    def first_order(self, wavelength: float | Tensor = 587.5618) -> FirstOrder:
        """EFL, BFD, pupils and F-number at a wavelength in nm."""
        return first_order(self.system(), wavelength)

    def _components(self, rays: Rays) -> Components:
        return Components(*(c.to(device=self.device, dtype=self.dtype) for c in rays.components()))


def _result(traced: Trace) -> TracedRays:
    status, surface = first_failure(traced)
    kept = [stop_gradient_where_invalid(c, traced.valid) for c in traced.ray]
    points = None
    if traced.points:
        points = torch.stack(
            [
                torch.stack([stop_gradient_where_invalid(c, traced.valid) for c in point], -1)
                for point in traced.points
            ]
        )
    return TracedRays(
        position=torch.stack(kept[:3], -1),
        direction=torch.stack(kept[3:], -1),
        valid=traced.valid,
        status=status,
        surface=surface,
        path_length=stop_gradient_where_invalid(traced.path_length, traced.valid),
        points=points,
    )
