"""A lens: surfaces, gaps, media, elements and a sensor, as a PyTorch module."""

import copy
import difflib
import fnmatch
from collections.abc import Callable, ItemsView, Iterator, Mapping, Sequence, ValuesView
from pkgutil import resolve_name
from types import MethodType
from typing import TYPE_CHECKING, Any, Generic, Self, TypeVar

import torch
from torch import Tensor, nn

from dolens.errors import InputError, check_choice
from dolens.optics import LENS_METHODS
from dolens.optics.crystals import Uniaxial
from dolens.optics.dispersion import require_wavelengths
from dolens.optics.elements import Element, ElementState, check_elements
from dolens.optics.fabrication_errors import astigmatism_of, index_offsets, irregular
from dolens.optics.gradients import Gradient, hold_terms, with_terms
from dolens.optics.image_surface import image_surface, register_image_surface
from dolens.optics.lens_data import LensData
from dolens.optics.lens_rays import LensRays
from dolens.optics.lens_states import InStates, LensStates, at_temperature
from dolens.optics.materials import MIRROR, Medium, media_of
from dolens.optics.metasurface import Metasurface
from dolens.optics.paraxial import vergence
from dolens.optics.paraxial_rays import ideal_lenses, reversals, with_vergences
from dolens.optics.polarisation import PolarisedRays, trace_polarised
from dolens.optics.prescription_table import PrescriptionTable, prescription_table
from dolens.optics.ray_tracing import BACKENDS, is_few, trace_rays
from dolens.optics.rays import Rays, TracedRays
from dolens.optics.surfaces.base import Surface
from dolens.optics.surfaces.coordinate_break import GlobalAxes
from dolens.optics.surfaces.state import LawState, SurfaceState
from dolens.optics.system import KeptSystem, OpticalSystem


def check_lens(
    surfaces: Sequence[Surface],
    thicknesses: Sequence[float],
    materials: Sequence[Medium],
    stop: int,
    elements: Mapping[str, Element],
) -> None:
    """Raise `InputError` where the parts of a lens do not go together; see `Lens`.

    The numbers of gaps and media must be those of the surfaces, the stop one of them that light
    meets, mirrors without a law of their own, and a coordinate break within one medium.
    """
    count = len(surfaces)
    if count == 0 or len(thicknesses) != count - 1 or len(materials) != count + 1:
        raise InputError(
            f"{count} surfaces need {count - 1} thicknesses and {count + 1} "
            f"materials, not {len(thicknesses)} and {len(materials)}"
        )
    if not 1 <= stop <= count:
        raise InputError(f"stop must be a surface from 1 to {count}, not {stop}")
    media = media_of(tuple(materials)).materials
    for medium, where in ((media[0], "before the first"), (media[-1], "behind the last")):
        if isinstance(medium, Gradient):
            raise InputError(
                f"the medium {where} surface cannot be a gradient; end it with a surface, which "
                "may be a plane"
            )
    for number, (surface, medium) in enumerate(zip(surfaces, materials[1:], strict=True), 1):
        if surface.law is not None and medium is MIRROR:
            raise InputError(f"surface {number}: a {surface.law.kind} cannot be a mirror")
    check_crystals(surfaces, media)
    check_metasurfaces(surfaces)
    check_elements(elements, count)
    if all(surface.changes_axes for surface in surfaces):
        raise InputError("there is no surface but coordinate breaks")
    for number, surface in enumerate(surfaces, 1):
        if not surface.changes_axes:
            continue
        place = f"surface {number} is a coordinate break"
        if number == stop:
            raise InputError(f"{place}, and cannot be the stop")
        if media[number] != media[number - 1]:
            raise InputError(f"{place}; the medium behind it is the one in front of it")


def check_crystals(surfaces: Sequence[Surface], media: Sequence[Medium]) -> None:
    """Raise `InputError` where a crystal holds the object or the sensor, or has a face with a law
    or a coating: crystals are plates, prisms and lenses with ideal faces.

    Args:
        surfaces: of the lens.
        media: before surface 1 and behind each surface.
    """
    for name, medium in (("object", media[0]), ("sensor", media[-1])):
        if isinstance(medium, Uniaxial):
            raise InputError(f"the {name} cannot be in a crystal ({medium.name})")
    for number, surface in enumerate(surfaces, 1):
        if not any(isinstance(medium, Uniaxial) for medium in media[number - 1 : number + 1]):
            continue
        held = "coating" if surface.coating is not None else None
        if surface.law is not None or surface.phase is not None:
            held = "phase or law of its own"
        if held is not None:
            raise InputError(
                f"surface {number}: the face of a crystal is ideal, and cannot have a {held}"
            )


def check_metasurfaces(surfaces: Sequence[Surface]) -> None:
    """Raise `InputError` where a surface has cells of a metasurface and a coating."""
    for number, surface in enumerate(surfaces, 1):
        if isinstance(surface.diffractive, Metasurface) and surface.coating is not None:
            raise InputError(
                f"surface {number}: cannot have a 'coating'; the table of its cells says what "
                "passes"
            )


class Lens(LensRays, InStates, nn.Module):
    """Surfaces, gaps, media and a sensor, plane or curved.

    Parameters are named as users write them: `surfaces.1.curvature`, `surfaces.5.x2y`,
    `thicknesses.3`, `sensor_distance`, and `states.wide.thicknesses.3` of a state (`in_state`).

    Fields are angles in degrees, (x, y) for a ray along (tan x, tan y, 1), when the object is at
    infinity (`object_distance` None or `inf`); with a finite `object_distance`, mm in front of the
    first vertex, they are points of the object in mm.

    Args:
        surfaces: in the order that light meets them; the first vertex is at z = 0.
        thicknesses: gaps between neighbouring vertices, mm, one fewer than surfaces.
        sensor_distance: last vertex to sensor, mm.
        materials: before surface 1 and after each surface; `MIRROR` after one that reflects.
        stop: number of the stop surface, from 1.
        elements: name → group of surfaces with a pose of its own.
        dtype: precision of the parameters, and of the rays.
        backend: what traces: `auto`, `reference`, `cpu` or `cuda`; see `choose_backend`.
        **data: what `LensData` holds, by its names; those that are not given have its defaults.
    """

    sensor_curvature: nn.Parameter | None
    sensor_conic: nn.Parameter | None

    def __init__(
        self,
        surfaces: Sequence[Surface],
        thicknesses: Sequence[float],
        sensor_distance: float,
        materials: Sequence[Medium],
        stop: int,
        elements: Mapping[str, Element] | None = None,
        dtype: torch.dtype = torch.float64,
        backend: str = "auto",
        **data: Any,
    ) -> None:
        super().__init__()
        given = LensData(**data)
        self.name = given.name
        try:
            check_lens(surfaces, thicknesses, materials, stop, elements or {})
        except InputError as error:
            raise InputError(f"lens '{self.name}': {error}") from None
        self.source, self.published = given.source, given.published
        self.stop, self.index_model = stop, given.index_model
        self.sensor_diameter = given.sensor_diameter
        wavelengths, weights = given.wavelengths, given.wavelength_weights
        require_wavelengths(wavelengths or (), f"lens '{self.name}'")
        self.wavelengths = None if wavelengths is None else tuple(wavelengths)
        self.reference_wavelength = given.reference_wavelength
        if self.reference_wavelength is None and self.wavelengths:
            self.reference_wavelength = self.wavelengths[0]
        self.wavelength_weights = None if weights is None else tuple(weights)
        self.fields, self.object_distance = given.fields, given.object_distance
        self.thermal_expansions = tuple(given.thermal_expansions or (None,) * len(surfaces))
        self.temperature, self.pressure = given.temperature, given.pressure
        self.telecentric_object = given.telecentric_object
        # A sentence where the stop is smaller than the aperture that its prescription asks for.
        self.stop_note = ""
        # What `optimize` did to make this lens; None of any other.
        self.optimization: Any = None
        check_choice(backend, BACKENDS, "backend")
        self.backend = backend
        self.surfaces = ModuleTable[Surface](
            {str(number): surface for number, surface in enumerate(surfaces, 1)}
        )
        # Assigned one by one: given a dict, ParameterDict sorts its keys as text (1, 10, 2, ...).
        self.thicknesses = nn.ParameterDict()
        for number, gap in enumerate(thicknesses, 1):
            self.thicknesses[str(number)] = nn.Parameter(torch.tensor(float(gap), dtype=dtype))
        self.elements = ModuleTable[Element](dict(elements or {}))
        self.sensor_distance = nn.Parameter(torch.tensor(float(sensor_distance), dtype=dtype))
        self.materials = materials
        self.states, self.state_name = LensStates(), None
        self.given: Mapping[str, Tensor] = {}
        register_image_surface(self, given.sensor_curvature, given.sensor_conic, dtype)
        self.to(dtype)
        self._kept_system = KeptSystem()
        self.reversals: tuple[int, ...] = ()
        self.reversals = reversals(self.system(), self.primary_wavelength)

    @property
    def materials(self) -> tuple[Medium, ...]:
        """Return the media before surface 1 and behind each surface, `MIRROR` behind one that
        reflects; gradients have the coefficients that the lens stores now.
        """
        return with_terms(self._materials, self.surfaces.values())

    @materials.setter
    def materials(self, media: Sequence[Medium]) -> None:
        if tuple(media) != getattr(self, "_materials", None):
            hold_terms(media, self.surfaces.values(), self.sensor_distance)
        self._materials = tuple(media)

    @property
    def dtype(self) -> torch.dtype:  # type: ignore[override]
        """The precision of the parameters and of traced rays."""
        return self.sensor_distance.dtype

    @property
    def device(self) -> torch.device:  # type: ignore[override]
        """The device that the parameters live on."""
        return self.sensor_distance.device

    def __repr__(self) -> str:
        """Return the prescription as a table."""
        return self.prescription().text()

    def _repr_html_(self) -> str:
        """Return the prescription as a table for a notebook; all text is escaped."""
        return self.prescription().html()

    def prescription(self) -> PrescriptionTable:
        """Return the prescription in the lens's present state as plain values."""
        return prescription_table(self)

    @property
    def primary_wavelength(self) -> float:
        """nm: the reference wavelength, or the d line of helium where the prescription has none."""
        return self.reference_wavelength or 587.5618

    def variables(self, patterns: Sequence[str]) -> dict[str, nn.Parameter]:
        """Parameters by name or shell pattern, in the order of the lens.

        Args:
            patterns: for example `["surfaces.*.curvature", "sensor_distance"]`.

        Raises:
            InputError: a pattern matches nothing; the message names near ones.
        """
        parameters = dict(_named_parameters(self))
        chosen: set[str] = set()
        for pattern in patterns:
            found = [pattern] if pattern in parameters else fnmatch.filter(parameters, pattern)
            if not found:
                near = difflib.get_close_matches(pattern, parameters, n=3, cutoff=0.4)
                hint = f"; near: {', '.join(near)}" if near else ""
                raise InputError(f"lens '{self.name}' has no parameter '{pattern}'{hint}")
            chosen.update(found)
        return {name: value for name, value in parameters.items() if name in chosen}

    def system(self, values: Mapping[str, Tensor] | None = None) -> OpticalSystem:
        """The lens as pure functions see it, with the stored values or others in their place.

        Args:
            values: parameter name → tensor used instead of the stored one, and of one that
                `with_values` gave; besides them `surfaces.<n>.semi_diameter` of a circular
                aperture, mm, and what `dolens.optics.fabrication_errors` names, which no lens
                stores as parameters.
        """
        if not values and not self.given:
            return self._kept_system.of(self, self._system)
        return self._system({**self.given, **(values or {})})

    def with_values(self, values: Mapping[str, Tensor | float]) -> Self:
        """Return this lens as it is with other values, for all that is computed from it.

        It shares everything with this lens; `parameters` and `state_dict` are still the stored
        ones.  Gradients flow to the values.

        Args:
            values: as `system` takes them, or numbers, as `{"sensor_distance": 95.9}`: mm, 1/mm and
                radians; kept as `given`.
        """
        if not values:
            return self
        found = copy.copy(self)
        options: dict[str, Any] = {"dtype": self.dtype, "device": self.device}
        tensors = {
            name: value if isinstance(value, Tensor) else torch.tensor(value, **options)
            for name, value in values.items()
        }
        found.given = {**self.given, **tensors}
        return found

    def as_stored(self) -> Self:
        """Return this lens without the values that `with_values` gave it."""
        if not self.given:
            return self
        found = copy.copy(self)
        found.given = {}
        return found

    @torch.no_grad()
    def storing_its_values(self) -> Self:
        """Return a copy of this lens that stores the values that `with_values` gave it.

        It shares nothing with this lens, and no gradient flows to the values.  What no lens stores,
        as an index offset, the copy is still given.

        Raises:
            InputError: a semi-diameter of an aperture that is no circle.
        """
        found, given = copy.deepcopy(self.as_stored()), dict(self.given)
        for name, stored in (*found.named_parameters(), *found.named_buffers()):
            if name in given:
                stored.copy_(given.pop(name))
        for number, surface in found.surfaces.items():
            edge = given.pop(f"surfaces.{number}.semi_diameter", None)
            if edge is not None:
                surface.aperture = surface.aperture.resized(float(edge))
        return found.with_values({name: value.detach().clone() for name, value in given.items()})

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Convert or move the given values with the parameters: `to`, `double`, `cpu`."""
        self.given = {name: fn(value) for name, value in self.given.items()}
        return super()._apply(fn, recurse)

    def _system(self, values: dict[str, Tensor]) -> OpticalSystem:
        """Return the lens as pure functions see it; what is used of `values` is taken out."""
        surfaces, profiles = [], {}
        for number, surface in self.surfaces.items():
            parameters = _stored_or_given(surface, values, f"surfaces.{number}.")
            edge = values.pop(f"surfaces.{number}.semi_diameter", None) if values else None
            aperture = surface.aperture
            if edge is not None:
                aperture = aperture.resized(float(edge.detach()))
            law = None if surface.law is None else LawState(surface.law, parameters)
            if surface.phase is not None:
                own = _stored_or_given(surface.phase, values, f"surfaces.{number}.phase.")
                law = LawState(type(surface.phase), own)
            coating = None
            if surface.coating is not None:
                own = _stored_or_given(surface.coating, values, f"surfaces.{number}.coating.")
                coating = surface.coating.state(own)
            relief = None
            if surface.diffractive is not None:
                own = _stored_or_given(
                    surface.diffractive, values, f"surfaces.{number}.diffractive."
                )
                relief = surface.diffractive.state(own)
            medium = self._materials[int(number)]
            if surface.gradient is not None and isinstance(medium, Gradient):
                own = _stored_or_given(surface.gradient, values, f"surfaces.{number}.gradient.")
                profiles[int(number)] = medium.profile(own)
            state = SurfaceState(type(surface), parameters, aperture, edge, law, coating, relief)
            astigmatism = astigmatism_of(self, number, values) if values else None
            surfaces.append(irregular(state, astigmatism) if astigmatism else state)
        thicknesses = [
            values.pop(f"thicknesses.{number}", gap) for number, gap in self.thicknesses.items()
        ]
        elements = [
            ElementState(
                element.first,
                element.last,
                {n: values.pop(f"elements.{name}.{n}", v) for n, v in element.named_parameters()},
                element.pivot,
            )
            for name, element in self.elements.items()
        ]
        sensor_distance = values.pop("sensor_distance", self.sensor_distance)
        image = image_surface(self, values)
        offsets = index_offsets(self, values) if values else ()
        if values:
            raise InputError(f"lens '{self.name}' has no parameter '{next(iter(values))}'")
        materials, mirrors = media_of(self._materials)
        system = OpticalSystem(
            surfaces,
            thicknesses,
            sensor_distance,
            materials,
            self.stop,
            elements,
            self.backend,
            mirrors,
            self.reversals,
            image,
            self.fields is not None and self.fields.from_the_side,
            offsets,
            profiles=profiles,
        )
        if not ideal_lenses(system):
            return system
        return with_vergences(system, self.primary_wavelength, vergence(self.object_distance))

    def at(self, temperature: float, pressure: float | None = None) -> "Lens":
        """Return this lens at another temperature (°C) and pressure (atm); see `lens_at`."""
        return at_temperature(self, temperature, pressure)

    def forward(self, rays: Rays) -> TracedRays:
        """The same as `trace`."""
        return self.trace(rays)

    def trace(
        self,
        rays: Rays,
        record: bool = False,
        first: int = 1,
        last: int | None = None,
        transmission: bool = False,
    ) -> TracedRays:
        """Trace rays from the object through every surface to the sensor, plane or curved.

        With backend `auto`, fast kernels trace many rays, and PyTorch a few, so that these wait for
        no compiler; see `dolens.optics.ray_tracing.is_few`.  Results agree to rounding.  A loop
        over few rays is faster with the kernels: set `backend` to `cpu`.

        Args:
            rays: travelling with the light in the medium before surface `first`: towards +z, or
                towards -z behind an odd number of mirrors; they may start anywhere, and are first
                moved along their own line to that surface.  Rays in double precision are moved in
                double precision, whatever the lens's.
            record: whether to keep the intersection with every surface.
            first: number of the first surface that they meet.
            last: number of the last; given, the trace ends there, in the medium behind it.
            transmission: whether to find which share of the light arrives; see `TracedRays`.
        """
        self._check_range(first, last)
        return trace_rays(self._system_for(rays), rays, 1.0, record, first, last, transmission)

    def trace_polarised(self, rays: Rays) -> PolarisedRays:
        """Trace rays to the sensor, and the electric field along them.

        Surfaces without a coating are ideal, and change no polarisation.  The scalar `transmission`
        of `trace` multiplies means over s and p; this one follows each.

        Args:
            rays: as `trace` takes them.

        Raises:
            InputError: a coating that is a table of shares, which has no phases.
        """
        return trace_polarised(self.system(), rays)

    def sensor_to_scene(
        self, rays: Rays, record: bool = False, first: int = 1, last: int | None = None
    ) -> TracedRays:
        """Trace rays backwards, from the sensor's side through every surface into object space.

        Args:
            rays: travelling against the light in the medium behind surface `last`: towards -z, or
                towards +z behind an odd number of mirrors.
            record: whether to keep the intersection with every surface, last surface first.
            first: number of the surface where the trace ends.
            last: number of the surface that they meet first; None: the lens's last.

        Returns:
            The rays on surface `first`, in the medium before it, travelling against the light.
        """
        self._check_range(first, last)
        return trace_rays(self._system_for(rays), rays, -1.0, record, first, last)

    def _system_for(self, rays: Rays) -> OpticalSystem:
        """The lens, traced by the reference if these rays are few."""
        system = self.system()
        return system.traced_by("reference") if is_few(system, rays) else system

    def global_axes(self) -> GlobalAxes:
        """Return vertex and rotation of every surface, and of the sensor, in the lens's axes.

        These are the axes of the first row, in front of any coordinate break.  All are double, and
        differentiable.
        """
        return self.system().global_axes()

    def _check_range(self, first: int, last: int | None) -> None:
        if first == 1 and last is None:
            return
        count = len(self.surfaces)
        if not 1 <= first <= (count if last is None else last) <= count:
            raise InputError(
                f"lens '{self.name}': surfaces {first} to {last} are no range of 1 to {count}"
            )


class _LoadedMethod:
    """A method of `Lens` stands in a higher part of the library, and is loaded when it is used.

    Args:
        home: the class that has it, as `dolens.views.LensViews`.
        name: of the method.
    """

    def __init__(self, home: str, name: str) -> None:
        self.home, self.name = home, name

    def __get__(self, lens: Lens | None, owner: type[Lens]) -> Any:
        """Return the method, bound to a lens."""
        function = getattr(resolve_name(self.home), self.name)
        return function if lens is None else MethodType(function, lens)


for _name, _home in LENS_METHODS.items():
    setattr(Lens, _name, _LoadedMethod(_home, _name))


def _stored_or_given(
    module: nn.Module, values: dict[str, Tensor], prefix: str
) -> dict[str, Tensor]:
    """Return what a module itself holds, or what `values` has instead, which is taken out there."""
    # Its own tables: `named_parameters` searches submodules, and takes ten times as long.
    tables = (module._parameters, module._buffers)
    stored = {n: value for table in tables for n, value in table.items() if value is not None}
    if not values:
        return stored
    return {name: values.pop(prefix + name, value) for name, value in stored.items()}


def _named_parameters(module: nn.Module, prefix: str = "") -> Iterator[tuple[str, nn.Parameter]]:
    """Yield what `Module.named_parameters` does, in a fifth of the time over a hundred names."""
    for name, parameter in module._parameters.items():
        if parameter is not None:
            yield prefix + name, parameter
    for name, child in module._modules.items():
        if child is not None:
            yield from _named_parameters(child, f"{prefix}{name}.")


Kind = TypeVar("Kind", bound=nn.Module)


class ModuleTable(nn.ModuleDict, Generic[Kind]):
    """Torch's table of modules, which tells a type checker what kind of module it holds."""

    if TYPE_CHECKING:

        def __getitem__(self, key: str) -> Kind: ...

        def values(self) -> ValuesView[Kind]:
            """Return the modules."""

        def items(self) -> ItemsView[str, Kind]:
            """Return names and modules."""
