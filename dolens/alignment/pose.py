"""A pose holds a lens, point sources and the sensor's planes, and varies some of their numbers."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, cast

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.parameter_names import to_lens_units
from dolens.optics.system import require_plane_sensor
from dolens.optimize.variables import DesignVariables
from dolens.rendering.spot_image import SpotImage, SpotImager

_COORDINATES = ("x", "y", "z")


class Pose(DesignVariables):
    """Varies numbers of a lens and its sources, and gives the images that follow.

    Names are those of the lens's parameters (`elements.lens.tilt_x`, `elements.lens.decenter_x`,
    `sensor_distance`), `sources.<n>.x`, `.y`, `.z`, and `sources.*.x`, `.y`, `.z`, by which all
    sources are shifted from where they are given, as one target.  Settings and `file_values` are
    in degrees and mm; θ is in the lens's own units, radians and mm.

    Args:
        lens: `put` and `store` change it, nothing else does.
        sources: (S, 3), mm, in the lens's axes.
        variables: name → settings of `DesignVariables`.
        planes: where the sensor stands for each of a source's images, mm from `sensor_distance`,
            as on a stage whose travel is known.
        shift: (3,), mm, of all sources from there.

    Attributes:
        sources: (S, 3), mm, as given.
        shift: (3,), mm.
        planes: mm.

    Raises:
        InputError: an unknown name or setting, a variable that is an array, a solve for the best
            focus, or no plane.
    """

    sources: Tensor
    shift: Tensor

    def __init__(
        self,
        lens: Lens,
        sources: Sequence[Sequence[float]],
        variables: Mapping[str, Mapping[str, Any] | None],
        planes: Sequence[float] = (0.0,),
        shift: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        require_plane_sensor(lens.system(), "poses")
        options: dict[str, Any] = {"dtype": torch.float64, "device": lens.device}
        places = torch.tensor(_places(sources), **options).reshape(-1, 3)
        offset = torch.tensor(shift, **options)
        others = {f"sources.*.{c}": offset[axis] for axis, c in enumerate(_COORDINATES)}
        for number, place in enumerate(places, 1):
            others |= {f"sources.{number}.{c}": place[axis] for axis, c in enumerate(_COORDINATES)}
        for name in variables:
            _source(name, len(places))
        super().__init__(lens, variables, others)
        self.register_buffer("sources", places)
        self.register_buffer("shift", offset, persistent=False)
        if not planes:
            raise InputError("planes: none is given; allowed: one or more places of the sensor, mm")
        self.planes = _numbers(planes)
        if not self.planes:
            raise InputError(f"planes: {planes!r}; allowed: places of the sensor, mm")
        if self.best_focus:
            raise InputError("variable 'sensor_distance': solve 'best_focus' is of merit functions")
        for name, shape in zip(self.names, self._shapes, strict=True):
            if shape:
                raise InputError(f"variable '{name}' is not one number of the lens")
        self._dependent_settings = {p.name: dict(variables[p.name] or {}) for p in self.dependents}

    @property
    def lens(self) -> Lens:
        """Return the lens as it was given."""
        return self._of[0]

    @property
    def settings(self) -> dict[str, dict[str, Any]]:
        """Return settings of the variables, with their present values as initial ones."""
        columns = (self.file_scale, self.file_scale * self.lower, self.file_scale * self.upper)
        found: dict[str, dict[str, Any]] = {}
        for (name, value), scale, lower, upper in zip(
            self.file_values().items(), *(c.tolist() for c in columns), strict=True
        ):
            found[name] = {"scale": scale, "initial": value, "lower": lower, "upper": upper}
        return found | self._dependent_settings

    @property
    def places(self) -> Tensor:
        """Return the sources (S, 3), mm, where they stand, but for θ."""
        return self.sources + self.shift

    def varying(self, variables: Mapping[str, Mapping[str, Any] | None]) -> "Pose":
        """Return the same lens, sources and planes with other variables."""
        sources, shift = self.sources.tolist(), self.shift.tolist()
        return Pose(self.lens, sources, variables, self.planes, shift)

    def check_name(self, name: str) -> None:
        """Refuse a name that is not one number of the lens or of the sources.

        Raises:
            InputError: there is none of this name.
        """
        if _source(name, len(self.sources)) is None:
            found = self.lens.variables([name])
            if list(found) != [name] or found[name].numel() != 1:
                raise InputError(f"variable '{name}' is not one number of the lens")

    def images(self, imager: SpotImager, scaled: Tensor | None = None) -> list[SpotImage]:
        """Return the image of every source on every plane of the sensor, a source's together.

        Args:
            imager: makes the images, each with its own patches of light where it has some.
            scaled: u (P,), in place of the stored one.
        """
        values = self(scaled)
        own = {name: values[name] for name in self._of_lens(values)}
        distance = own.get("sensor_distance", self.lens.sensor_distance)
        systems = [
            self.lens.system({**own, "sensor_distance": distance + plane}) for plane in self.planes
        ]
        pairs = [(s, source) for source in self._placed(values) for s in systems]
        return [imager.for_image(n).image(*pair) for n, pair in enumerate(pairs)]

    def _placed(self, values: Mapping[str, Tensor]) -> list[Tensor]:
        """Return the sources, (3,) each, mm."""

        def along(place: tuple[int | None, int]) -> Tensor:
            number, axis = place
            name = f"sources.{'*' if number is None else number + 1}.{_COORDINATES[axis]}"
            return values.get(name, self._at(place))

        return [
            torch.stack([along((number, axis)) + along((None, axis)) for axis in range(3)])
            for number in range(len(self.sources))
        ]

    def _at(self, place: tuple[int | None, int]) -> Tensor:
        """Return a stored number of a source, or of their shift, as a view."""
        number, axis = place
        return self.shift[axis] if number is None else self.sources[number, axis]

    @torch.no_grad()
    def put(self, values: Mapping[str, float]) -> None:
        """Put numbers, in degrees and mm, into the lens and the sources; θ stays as it is."""
        for name, value in values.items():
            place = _source(name, len(self.sources))
            if place is not None:
                self._at(place).fill_(to_lens_units(name, value))
            else:
                self.lens.variables([name])[name].fill_(to_lens_units(name, value))

    @torch.no_grad()
    def store(self) -> None:
        """Put θ, and what follows from it, into the lens and the sources."""
        self.write_to(self.lens)
        self.put({name: v for name, v in self.file_values().items() if name in self._others})


def _source(name: str, count: int) -> tuple[int | None, int] | None:
    """Return which coordinate of which source a name means; None for the lens's parameters.

    Returns:
        Number of the source, from 0, or None for all; and of the coordinate.

    Raises:
        InputError: a name of a source that is none of `count` sources.
    """
    parts = name.split(".")
    if parts[0] != "sources":
        return None
    known = len(parts) == 3 and parts[2] in _COORDINATES
    if known and parts[1] == "*":
        return None, _COORDINATES.index(parts[2])
    if not (known and parts[1].isdigit() and 1 <= int(parts[1]) <= count):
        raise InputError(
            f"variable '{name}': allowed are sources.<1 to {count}>.x, .y and .z, and "
            "sources.*.x, .y and .z"
        )
    return int(parts[1]) - 1, _COORDINATES.index(parts[2])


def _places(sources: Sequence[Sequence[float]]) -> list[tuple[float, ...]]:
    """Return the places of sources, three finite numbers each."""
    places = [_numbers(source) for source in sources]
    for source, place in zip(sources, places, strict=True):
        if len(place) != 3:
            raise InputError(f"sources: {source!r}; allowed: (x, y, z) each, mm")
    return places


def _numbers(values: object) -> tuple[float, ...]:
    """Return numbers; none where something else is among them, or what is not finite."""
    try:
        numbers = tuple(float(value) for value in cast(Any, values))
    except (TypeError, ValueError):
        return ()
    return numbers if all(map(math.isfinite, numbers)) else ()
