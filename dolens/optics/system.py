"""A lens as pure functions see it: an `OpticalSystem` of tensors and names, without state.

Analyses that hold only for refracting surfaces along one axis refuse other systems here.  A lens
keeps the last system made of it while it is made of the same things.

A system holds the lens's own tensors, so that it stays the lens's whatever their values become; it
is made anew as soon as anything stands in the place of a tensor, a surface, an aperture or a medium
that it was made of.
"""

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain
from operator import attrgetter, is_, itemgetter
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from dolens.errors import InputError
from dolens.optics.bent_motion import plain, steps_through
from dolens.optics.bent_paraxial import BentGap, gap_of_gradient, paraxial_gaps
from dolens.optics.bent_rays import Space
from dolens.optics.crystals import Crystal, turned_axis
from dolens.optics.elements import Axes, ElementState, surface_axes
from dolens.optics.gradients import Gradient, Profile
from dolens.optics.materials import Medium, absorption, is_anisotropic
from dolens.optics.metasurface import Cells
from dolens.optics.surfaces.base import Surface
from dolens.optics.surfaces.coordinate_break import GlobalAxes, broken_axes
from dolens.optics.surfaces.deflection import Law
from dolens.optics.surfaces.state import SurfaceState

Number = Any  # of Python's, or a tensor

# A gradient's profile holds so many times as far as light is wanted.
_REACH = 10.0


def per_radian(wavelength: float | Tensor, like: Tensor) -> float | Tensor:
    """Return λ/2π in mm, the path in vacuum of one radian, of a wavelength in nm.

    A tensor of wavelengths gives one in the precision of `like`, and on its device.
    """
    length = wavelength * (1e-6 / (2.0 * math.pi))
    return length.to(like) if isinstance(length, Tensor) else length


@dataclass(frozen=True)
class OpticalSystem:
    """A sequence of surfaces and a sensor, centred but for coordinate breaks and the poses of
    elements.

    Attributes:
        surfaces: in the order that light meets them.
        thicknesses: gaps between neighbouring vertices, mm, one fewer than surfaces.
        sensor_distance: from the last vertex to the sensor plane, mm.
        materials: before surface 1 and after each surface.
        stop: number of the stop surface, from 1.
        elements: groups of surfaces with a pose of their own.
        mirrors: numbers of the surfaces that reflect; the medium behind one is the one in front.
        reversals: numbers of the coordinate breaks that turn the axes so far that light travels the
            other way along z behind them.
        image: the curved surface that rays end on, its vertex at the sensor; None: a plane.
        from_the_side: whether light comes at 90° to the axis and more; its rays meet spheres and
            conics along their vertex plane and from behind it, and are traced by the reference.
        backend: the implementation that traces rays through it: `reference`, `cpu`, `cuda`, or
            `auto`; see `dolens.optics.ray_tracing.choose_backend`.
        index_offsets: added to the indices of these media, the same at all wavelengths; () where
            none is.
        meridian: the section of the lens that first-order optics is of, `x` (the x-z plane) or `y`;
            None: the mean over azimuth.  See `section`.
        profiles: number of the surface that a gradient begins behind → its profile with the lens's
            own coefficients; of others it is the medium's.
    """

    surfaces: Sequence[SurfaceState]
    thicknesses: Sequence[Tensor]
    sensor_distance: Tensor
    materials: Sequence[Medium]
    stop: int
    elements: Sequence[ElementState] = ()
    backend: str = "auto"
    mirrors: tuple[int, ...] = ()
    reversals: tuple[int, ...] = ()
    image: SurfaceState | None = None
    from_the_side: bool = False
    index_offsets: tuple[Tensor | None, ...] = ()
    meridian: str | None = None
    profiles: Mapping[int, Profile] = field(default_factory=dict)

    @cached_property
    def senses(self) -> tuple[float, ...]:
        """Return +1 where light travels towards +z and -1 where towards -z, in forward mode: before
        surface 1 and behind each surface.
        """
        found = [1.0]
        for number in range(1, len(self.surfaces) + 1):
            turned = number in self.mirrors or number in self.reversals
            found.append(-found[-1] if turned else found[-1])
        return tuple(found)

    @cached_property
    def breaks(self) -> tuple[int, ...]:
        """Return the numbers of the coordinate breaks."""
        return tuple(n for n, s in enumerate(self.surfaces, 1) if s.shape.changes_axes)

    @cached_property
    def kinds(self) -> frozenset[tuple[type[Surface], type[Law] | None]]:
        """Return the shapes of the surfaces, each with the law that deflects light there."""
        deflections = [(surface.shape, surface.deflection) for surface in self.surfaces]
        return frozenset((shape, None if d is None else d.law) for shape, d in deflections)

    @cached_property
    def met(self) -> tuple[int, ...]:
        """Return the numbers of the surfaces that light meets: all but coordinate breaks."""
        return tuple(n for n in range(1, len(self.surfaces) + 1) if n not in self.breaks)

    @cached_property
    def coated(self) -> bool:
        """Return whether a surface has a coating, so that light which passes has lost some."""
        return any(surface.coating is not None for surface in self.surfaces)

    @cached_property
    def diffractive(self) -> tuple[int, ...]:
        """Return the numbers of the surfaces with a relief or cells, which waves see and rays do
        not.
        """
        return tuple(n for n, s in enumerate(self.surfaces, 1) if s.relief is not None)

    @cached_property
    def metasurfaces(self) -> tuple[int, ...]:
        """Return the numbers of the surfaces with cells."""
        return tuple(n for n, s in enumerate(self.surfaces, 1) if isinstance(s.relief, Cells))

    def uncoated(self) -> "OpticalSystem":
        """Return the same lens, whose surfaces are ideal."""
        if not self.coated:
            return self
        return replace(self, surfaces=[replace(s, coating=None) for s in self.surfaces])

    @cached_property
    def neighbours(self) -> tuple[tuple[int, int], ...]:
        """Return the numbers of surfaces that light meets one after the other."""
        return tuple(zip(self.met, self.met[1:], strict=False))

    @cached_property
    def derived(self) -> dict[Hashable, Any]:
        """Hold what functions derive from the structure of this system, by keys of their own."""
        return {}

    @cached_property
    def gradients(self) -> dict[int, int]:
        """Return the places of gradient-index media, from 0 before surface 1, and the numbers of
        the surfaces that their profiles count from.
        """
        media = enumerate(self.materials)
        return {k: self.beginning(k) for k, medium in media if isinstance(medium, Gradient)}

    def beginning(self, place: int) -> int:
        """Return the number of the surface behind which the medium `place` (from 0) begins, in
        whose axes it is given: mirrors and coordinate breaks lie within a medium.
        """
        while place in self.mirrors or place in self.breaks:
            place -= 1
        return place

    def profile(self, place: int, wavelength: float | Tensor | None = None) -> Profile:
        """Return the profile of the gradient at a place (from 0), at a wavelength (nm) or with the
        parts of its coefficients that are the same at all.
        """
        medium, begins = self.materials[place], self.beginning(place)
        assert isinstance(medium, Gradient)  # as its place says
        found = self.profiles[begins] if begins in self.profiles else medium.profile()
        return found if wavelength is None else medium.profile_at(found, wavelength)

    def spaces(self, wavelength: float | Tensor) -> dict[int, Space]:
        """Return the gaps in which rays bend, by the place of their medium; wavelengths in nm."""
        if not self.gradients:
            return {}
        indices, axes, found = self.indices(wavelength), self.axes, {}
        wavelength = self._finer(wavelength)
        kernels = self.backend == "auto" and self.device.type == "cpu"
        kernels = kernels and self.dtype in (torch.float32, torch.float64)
        for place, origin in self.gradients.items():
            profile, n = self.profile(place, wavelength).to(self.dtype), indices[place]
            served = kernels and profile.has_kernel
            radius = max(s.semi_diameter for s in self.surfaces[place - 1 : place + 1])
            start, length = map(plain, gap_of_gradient(self.thicknesses, origin, place))
            steps = steps_through(profile, plain(n), start, length, radius, self.dtype)
            reach = _REACH * (radius + abs(start) + abs(length))
            colours = wavelength if isinstance(wavelength, Tensor) else None
            found[place] = Space(profile, n, axes[origin - 1], steps, reach, served, colours)
        return found

    def paraxial_gaps(self, wavelength: float | Tensor) -> list[Tensor | BentGap]:
        """Return the gaps as paraxial rays take them: lengths (mm), and those of gradients."""
        if not self.gradients:
            return list(self.thicknesses)
        signed = self.signed_indices(wavelength)
        indices = [signed[place] for place in self.gradients]
        wavelength = self._finer(wavelength)
        profiles = {
            k: (origin, self.profile(k, wavelength)) for k, origin in self.gradients.items()
        }
        return paraxial_gaps(self.thicknesses, profiles, indices, self.senses, self.meridian)

    def refracts(self, number: int) -> bool:
        """Return whether a surface changes the direction of light, by refraction or reflection."""
        before, behind = self.materials[number - 1], self.materials[number]
        # The axes of one crystal and another may be turned, although they are written alike, and a
        # gradient begins anew.
        own = is_anisotropic(behind) or isinstance(behind, Gradient)
        return number in self.mirrors or before != behind or own

    @cached_property
    def anisotropic(self) -> tuple[int, ...]:
        """Return the numbers of the media, from 0, in which light goes as extraordinary rays."""
        return tuple(k for k, medium in enumerate(self.materials) if is_anisotropic(medium))

    def crystals(self, wavelength: float | Tensor) -> dict[int, Crystal]:
        """Return, by the number of the medium, the crystals that extraordinary rays go through at
        a wavelength in nm, their optic axes in the lens's axes.
        """
        found: dict[int, Crystal] = {}
        for place in self.anisotropic:
            medium: Any = self.materials[place]
            n_o, n_e = (
                self._as_traced(self._shifted(m.index(self._finer(wavelength)), place))
                for m in (medium.ordinary, medium.extraordinary)
            )
            found[place] = Crystal(n_o, n_e, self.optic_axis(place))
        return found

    def optic_axis(self, place: int) -> tuple[Any, Any, Any]:
        """Return the optic axis of the crystal that medium `place` (from 0) is, in the lens's axes.

        It is given in the axes of the surface in front of the crystal.
        """
        medium: Any = self.materials[place]
        return turned_axis(medium.axis, self.axes[self.beginning(place) - 1], self.dtype)

    def _finer(self, wavelength: float | Tensor) -> float | Tensor:
        """Return wavelengths on the lens's device, no less precise than the lens."""
        if not isinstance(wavelength, Tensor):
            return wavelength
        finer = torch.promote_types(wavelength.dtype, self.dtype)
        return wavelength.to(device=self.device, dtype=finer)

    def _shifted(self, index: Any, place: int) -> Any:
        """Return the index of a medium with the offset that is added to it."""
        offset = self.index_offsets[place] if self.index_offsets else None
        return index if offset is None else index + offset.double()

    def _as_traced(self, number: Any) -> Any:
        """Return a number, or a tensor in the precision that rays are traced in."""
        return number.to(self.dtype) if isinstance(number, Tensor) else number

    def indices(self, wavelength: float | Tensor) -> list[float | Tensor]:
        """Indices before surface 1 and after each surface, at a wavelength in nm.

        A tensor of wavelengths gives tensors in the lens's precision, so that the wavelengths'
        own does not decide in which precision rays are traced.  Of an extraordinary ray it is the
        index that first-order optics takes, along the lens's meridian; see `crystals`.
        """
        wavelength = self._finer(wavelength)
        # Each medium once: air comes between all the others.
        indices = {medium: medium.index(wavelength) for medium in dict.fromkeys(self.materials)}
        if self.anisotropic and self.meridian is not None:
            way = (1.0, 0.0) if self.meridian == "x" else (0.0, 1.0)
            for place in self.anisotropic:
                crystal: Any = self.materials[place]
                indices[crystal] = crystal.section_index(wavelength, *way)
        ordered = [indices[medium] for medium in self.materials]
        return [self._as_traced(self._shifted(n, place)) for place, n in enumerate(ordered)]

    def absorptions(self, wavelength: float | Tensor) -> list[float | Tensor]:
        """Return how fast light is absorbed before surface 1 and behind each surface, 1/mm: of the
        glasses whose catalogues give internal transmittances there; of others zero.
        """
        found = {m: absorption(m, wavelength) for m in dict.fromkeys(self.materials)}
        ordered = [found[medium] for medium in self.materials]
        return [a.to(self.device, self.dtype) if isinstance(a, Tensor) else a for a in ordered]

    def signed_indices(self, wavelength: float | Tensor) -> list[float | Tensor]:
        """Indices as paraxial optics takes them: negative where light travels towards -z."""
        found = zip(self.indices(wavelength), self.senses, strict=True)
        return [n if sense > 0.0 else -n for n, sense in found]

    @property
    def vertices(self) -> list[Tensor]:
        """z of every vertex as designed, then of the sensor, in mm; the first is at 0.

        Along the axis as if no coordinate break turned it: thicknesses with their signs.
        """
        positions = [torch.zeros_like(self.sensor_distance)]
        for gap in (*self.thicknesses, self.sensor_distance):
            positions.append(positions[-1] + gap)
        return positions

    @property
    def axes(self) -> list[Axes]:
        """The axes of every surface, with the poses of the elements that carry it, behind the
        coordinate breaks in front of it.
        """
        return self.all_axes[:-1]

    @property
    def all_axes(self) -> list[Axes]:
        """The axes of every surface, and of the sensor last."""
        vertices = self.vertices
        if self.breaks:
            gaps = [*self.thicknesses, self.sensor_distance]
            return broken_axes(self.surfaces, gaps, self.elements, vertices)
        placed = surface_axes(self.elements, vertices, len(self.surfaces))
        return [*placed, Axes((), vertices[-1])]

    def global_axes(self) -> GlobalAxes:
        """Return vertex and rotation of every surface, and of the sensor, in the lens's axes."""
        places = (axes.place(self.device) for axes in self.all_axes)
        rotations, origins = (torch.stack(part) for part in zip(*places, strict=True))
        return GlobalAxes(origins, rotations)

    def place(self, number: int) -> tuple[Tensor, Tensor]:
        """Return rotation (3, 3) and origin (3,), mm, of a surface's axes in the lens's: a point p
        there lies at origin + rotation·p.  They are without gradients, on the CPU.
        """
        rotation, origin = self.axes[number - 1].place(self.device)
        return rotation.detach().cpu(), origin.detach().cpu()

    @property
    def dtype(self) -> torch.dtype:
        """The precision that rays are traced in."""
        return self.sensor_distance.dtype

    @property
    def device(self) -> torch.device:
        """The device that the lens lives on."""
        return self.sensor_distance.device

    @cached_property
    def rotationally_symmetric(self) -> bool:
        """Return whether nothing in the lens singles out a direction across the axis."""
        surfaces = all(s.shape.rotational and s.aperture.rotational for s in self.surfaces)
        laws = all(s.deflection is None or s.deflection.law.rotational for s in self.surfaces)
        media: list[Any] = [self.materials[k] for k in self.anisotropic]
        along = all(medium.axis[:2] == (0.0, 0.0) for medium in media)
        round_ = all(self.profile(place).rotational for place in self.gradients)
        return surfaces and laws and along and round_ and not self.elements

    def section(self, meridian: str | None) -> "OpticalSystem":
        """Return the same lens, whose first-order optics is that of one section; see `meridian`.

        Raises:
            InputError: another name than `x` and `y`.
        """
        if meridian not in (None, "x", "y"):
            raise InputError(f"meridian: 'x', 'y' or None for the mean of both, not {meridian!r}")
        return replace(self, meridian=meridian)

    def traced_by(self, backend: str) -> "OpticalSystem":
        """The same lens, traced by another implementation."""
        return replace(self, backend=backend)

    def double(self) -> "OpticalSystem":
        """The same lens in double precision; gradients flow back to its own tensors."""
        return replace(
            self,
            surfaces=[s.double() for s in self.surfaces],
            thicknesses=[gap.double() for gap in self.thicknesses],
            sensor_distance=self.sensor_distance.double(),
            image=None if self.image is None else self.image.double(),
            elements=[
                replace(e, parameters={n: p.double() for n, p in e.parameters.items()})
                for e in self.elements
            ],
            profiles={n: profile.double() for n, profile in self.profiles.items()},
        )

    def opened(self) -> "OpticalSystem":
        """The same lens with apertures that clip nothing."""
        return replace(
            self, surfaces=[replace(s, aperture=s.aperture.opened()) for s in self.surfaces]
        )


class KeptSystem:
    """Holds one system, and what it was made of.  A copy of a lens keeps its own."""

    def __init__(self) -> None:
        self._kept: tuple[_Places, _Parts, OpticalSystem] | None = None

    def __deepcopy__(self, memo: object) -> "KeptSystem":
        """Return an empty one."""
        return KeptSystem()

    def __reduce__(self) -> tuple[type, tuple[()]]:
        """Pickle nothing."""
        return KeptSystem, ()

    def of(
        self, lens: nn.Module, make: Callable[[dict[str, Tensor]], OpticalSystem]
    ) -> OpticalSystem:
        """Return the system of a lens as it is now.

        Args:
            lens: a `Lens`.
            make: makes its system, with values in the place of stored ones; here there are none.
        """
        if torch.compiler.is_compiling():
            return make({})
        kept = self._kept  # at once: other threads may trace the same lens
        if kept is not None:
            places, known, system = kept
            if places.are_of(lens) and known.are_the_same(places.parts(lens)):
                return system
        places = _places(lens)
        parts = places.parts(lens)
        system = make({})
        if _may_stay(parts.things, system):
            self._kept = (places, parts, system)
        return system


# Of a lens; its materials may be a list, whose entries are looked at.
_ATTRIBUTES = itemgetter("stop", "backend", "reversals", "fields")
_OF_SURFACE = attrgetter("aperture")
_OF_ELEMENT = attrgetter("first", "last", "pivot")


class _Parts(NamedTuple):
    """All that a system is made of, and the names of these in their tables."""

    things: list[Any]
    names: list[str]

    def are_the_same(self, others: "_Parts") -> bool:
        """Return whether the same objects have the same names: they make the same system."""
        things = others.things
        if len(self.things) != len(things) or self.names != others.names:
            return False
        return all(map(is_, self.things, things))


class _Places(NamedTuple):
    """All that a system is made of stands here.

    Attributes:
        tables: of PyTorch's, with parameters, buffers and modules; those of the lens itself first.
        empty: such tables without an entry.
        surfaces: the modules themselves.
        elements: likewise.
    """

    tables: tuple[dict[str, Any], ...]
    empty: tuple[dict[str, Any], ...]
    surfaces: tuple[nn.Module, ...]
    elements: tuple[nn.Module, ...]

    def are_of(self, lens: nn.Module) -> bool:
        """Return whether they are all of a lens's places: tables in other modules are found from
        its own.
        """
        if lens._parameters is not self.tables[0] or lens._modules is not self.tables[1]:
            return False
        return not any(self.empty)

    def parts(self, lens: nn.Module) -> _Parts:
        """Return what stands there now."""
        own = lens.__dict__
        things = [*_ATTRIBUTES(own), *own["_materials"]]
        things += chain.from_iterable(map(dict.values, self.tables))
        things += map(_OF_SURFACE, self.surfaces)
        things += chain.from_iterable(map(_OF_ELEMENT, self.elements))
        return _Parts(things, [*chain.from_iterable(self.tables)])


def _places(lens: nn.Module) -> _Places:
    """Return where the parts of a lens stand."""
    modules: Any = lens._modules
    surfaces = tuple(modules["surfaces"]._modules.values())
    elements = tuple(modules["elements"]._modules.values())
    parts = (
        part
        for s in surfaces
        for part in (s.phase, s.coating, s.diffractive, s.gradient)
        if part is not None
    )
    tables = [modules[name]._modules for name in ("surfaces", "elements")]
    for module in (modules["thicknesses"], *surfaces, *parts, *elements):
        tables += (module._parameters, module._buffers, module._modules)
    return _Places(
        (lens._parameters, lens._modules, *filter(None, tables)),
        tuple(table for table in tables if not table),
        surfaces,
        elements,
    )


def _may_stay(parts: list[Any], system: OpticalSystem) -> bool:
    """Return whether a system holds nothing that a call leaves behind: values that
    `functional_call` puts in the place of parameters, or numbers computed from parameters.
    """
    stored = {id(part) for part in parts if isinstance(part, Tensor) and _is_plain(part)}
    tensors = [*system.thicknesses, system.sensor_distance]
    for surface in (*system.surfaces, system.image):
        if surface is not None:
            tensors += surface.parameters.values()
            if surface.deflection is not None:
                tensors += surface.deflection.parameters.values()
            if surface.coating is not None:
                tensors += surface.coating.tensors
            if surface.relief is not None:
                tensors += surface.relief.values
    for element in system.elements:
        tensors += element.parameters.values()
    for profile in system.profiles.values():
        tensors += profile.values
    return all(id(tensor) in stored for tensor in tensors)


def _is_plain(tensor: Tensor) -> bool:
    """Return whether a tensor is a parameter, or a buffer without a graph."""
    if isinstance(tensor, nn.Parameter):
        return True
    wrapped = torch._C._functorch.is_functorch_wrapped_tensor(tensor)
    return not tensor.requires_grad and not wrapped


def require_refracting(system: OpticalSystem, what: str) -> None:
    """Raise `InputError` where a lens has mirrors or coordinate breaks.

    Args:
        system: the lens.
        what: cannot be done with it; the message begins with it.
    """
    for numbers, kind in ((system.mirrors, "a mirror"), (system.breaks, "a coordinate break")):
        if numbers:
            raise InputError(
                f"{what}: surface {numbers[0]} is {kind}; only lenses of refracting surfaces along "
                "one axis are held there"
            )


def require_one_index(system: OpticalSystem, what: str) -> None:
    """Raise `InputError` where the index of a medium depends on direction or place; arguments as
    above.
    """
    for number in system.anisotropic:
        raise InputError(
            f"{what}: the medium behind surface {number} is a crystal of extraordinary rays "
            f"({system.materials[number].name}); only media with one index are held there"
        )
    require_homogeneous(system, what)


def require_homogeneous(system: OpticalSystem, what: str) -> None:
    """Raise `InputError` where a medium of a lens is a gradient; arguments as above."""
    for place in system.gradients:
        raise InputError(
            f"{what}: the medium behind surface {place} has a gradient of its index, which is not "
            "held there"
        )


def require_plane_sensor(system: OpticalSystem, what: str) -> None:
    """Raise `InputError` where the sensor of a lens is curved; arguments as above."""
    if system.image is not None:
        curvature = float(system.image.parameters["curvature"].detach())
        radius = math.copysign(math.inf, curvature) if curvature == 0.0 else 1.0 / curvature
        raise InputError(
            f"{what}: the sensor is curved (radius {radius:g} mm); only a plane one is held there"
        )


def require_seen_by_rays(system: OpticalSystem, what: str) -> None:
    """Raise `InputError` where an element of a lens has no phase; arguments as above.

    Rays follow an element's phase in one order; heights or cells alone bend none.
    """
    for number in system.diffractive:
        if system.surfaces[number - 1].deflection is None:
            name = "cells" if number in system.metasurfaces else "heights"
            raise InputError(
                f"{what}: surface {number} is diffractive by its {name} alone, which rays do not "
                "see; waves do (lens.psf, lens.mtf, renderer psf with diffraction: wave)"
            )


def require_no_metasurface(system: OpticalSystem, what: str) -> None:
    """Raise `InputError` where a lens has cells of a metasurface; arguments as above."""
    for number in system.metasurfaces:
        raise InputError(
            f"{what}: surface {number} has cells, whose light goes as waves; polarisers and "
            "retarders about them are their keys 'front' and 'behind'"
        )
