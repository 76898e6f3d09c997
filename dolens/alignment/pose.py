"""A lens, its sources, and what of them is to be found."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from dolens.errors import InputError, check_keys
from dolens.optics.elements import TILTS
from dolens.optics.lens import Lens
from dolens.rendering.spot_image import SpotImage, SpotImager

_COORDINATES = ("x", "y", "z")
_KEYS = ("scale", "initial")


class Pose(nn.Module):
    """Chosen numbers of a lens and its sources, θ, held as u = θ/scale.

    Names are those of the lens's parameters (`elements.lens.tilt_x`, `elements.lens.decenter_x`,
    `sensor_distance`), `sources.<n>.x`, `.y`, `.z`, and `sources.*.x`, `.y`, `.z`, by which all
    sources are shifted from where they are given, as one target.  Settings, and what is found, are
    in degrees for tilts and in mm; θ is in the lens's own units, radians and mm.

    Args:
        lens: `put` and `store` change it, nothing else does.
        sources: (S, 3), mm, in the lens's axes.
        variables: name → settings: `scale` (default 1) and `initial` (default: as it is).
        planes: where the sensor stands for each of a source's images, mm from `sensor_distance`,
            as on a stage whose travel is known.
        shift: (3,), mm, of all sources from there.

    Attributes:
        names: of θ, P of them.
        scaled: u (P,).
        scale: (P,), in θ's units.
        units: (P,), θ's units in those of the settings: radians of a degree, or 1.

    Raises:
        InputError: an unknown name or setting, or a scale that is not positive.
    """

    def __init__(
        self,
        lens: Lens,
        sources: Sequence[Sequence[float]],
        variables: Mapping[str, Mapping[str, Any] | None],
        planes: Sequence[float] = (0.0,),
        shift: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        super().__init__()
        self._of = (lens,)
        options = {"dtype": torch.float64, "device": lens.device}
        self.register_buffer("sources", torch.tensor(sources, **options).reshape(-1, 3))
        self.register_buffer("shift", torch.tensor(shift, **options), persistent=False)
        self.names, self.planes = tuple(variables), tuple(float(z) for z in planes)
        if not self.planes:
            raise InputError("planes: none is given; allowed: one or more places of the sensor, mm")
        scales, starts, units = [], [], []
        for name, settings in variables.items():
            settings = dict(settings or {})
            check_keys(settings, _KEYS, f"variable '{name}'")
            scale = float(settings.get("scale", 1.0))
            if not scale > 0.0:
                raise InputError(f"variable '{name}': scale must be positive, not {scale:g}")
            units.append(_unit(name))
            scales.append(scale)
            starts.append(float(settings.get("initial", self.value(name) / units[-1])) / scale)
        self.register_buffer("units", torch.tensor(units, **options))
        self.register_buffer("scale", self.units * torch.tensor(scales, **options))
        self.scaled = nn.Parameter(torch.tensor(starts, **options))

    @property
    def lens(self) -> Lens:
        """The lens as it was given."""
        return self._of[0]

    @property
    def unit_names(self) -> list[str]:
        """Of the settings, `deg` or `mm`."""
        return ["mm" if unit == 1.0 else "deg" for unit in self.units.tolist()]

    @property
    def settings(self) -> dict[str, dict[str, float]]:
        """Of its variables, starting where they are."""
        scales = dict(zip(self.names, self.scale_in_units.tolist(), strict=True))
        return {n: {"scale": scales[n], "initial": at} for n, at in self.found().items()}

    @property
    def places(self) -> Tensor:
        """(S, 3), mm, the sources where they stand, but for θ."""
        return self.sources + self.shift

    def varying(self, variables: Mapping[str, Mapping[str, Any] | None]) -> "Pose":
        """The same lens, sources and planes, with other variables."""
        sources, shift = self.sources.tolist(), self.shift.tolist()
        return Pose(self.lens, sources, variables, self.planes, shift)

    @property
    def scale_in_units(self) -> Tensor:
        """(P,), the scales as the settings have them."""
        return self.scale / self.units

    def found(self) -> dict[str, float]:
        """θ by name, in degrees and mm."""
        values = (self.scale_in_units * self.scaled.detach()).tolist()
        return dict(zip(self.names, values, strict=True))

    def value(self, name: str) -> float:
        """A number as the lens, or the sources, have it, in θ's units.

        Raises:
            InputError: there is none of this name.
        """
        place = self._source(name)
        if place is not None:
            return float(self._at(place))
        found = self.lens.variables([name])
        if list(found) != [name] or found[name].numel() != 1:
            raise InputError(f"variable '{name}' is not one number of the lens")
        return float(found[name])

    def values(self, scaled: Tensor | None = None) -> dict[str, Tensor]:
        """θ by name."""
        theta = self.scale * (self.scaled if scaled is None else scaled)
        return dict(zip(self.names, theta.unbind(), strict=True))

    def images(self, imager: SpotImager, scaled: Tensor | None = None) -> list[SpotImage]:
        """Of every source on every plane of the sensor, a source's images together.

        Args:
            imager: how.
            scaled: u, in place of the stored one.
        """
        values = self.values(scaled)
        own = {n: v for n, v in values.items() if self._source(n) is None}
        distance = own.get("sensor_distance", self.lens.sensor_distance)
        systems = [
            self.lens.system({**own, "sensor_distance": distance + plane}) for plane in self.planes
        ]
        return [imager.image(s, source) for source in self._placed(values) for s in systems]

    def _placed(self, values: Mapping[str, Tensor]) -> list[Tensor]:
        """The sources, (3,) each."""

        def along(place: tuple[int | None, int]) -> Tensor:
            number, axis = place
            name = f"sources.{'*' if number is None else number + 1}.{_COORDINATES[axis]}"
            return values.get(name, self._at(place))

        return [
            torch.stack([along((number, axis)) + along((None, axis)) for axis in range(3)])
            for number in range(len(self.sources))
        ]

    def _at(self, place: tuple[int | None, int]) -> Tensor:
        """A stored number of a source, or of their shift."""
        number, axis = place
        return self.shift[axis] if number is None else self.sources[number, axis]

    def _source(self, name: str) -> tuple[int | None, int] | None:
        """Number of the source, from 0, or None for all, and of the coordinate; None for the lens's
        parameters.
        """
        parts = name.split(".")
        if parts[0] != "sources":
            return None
        known = len(parts) == 3 and parts[2] in _COORDINATES
        if known and parts[1] == "*":
            return None, _COORDINATES.index(parts[2])
        if not (known and parts[1].isdigit() and 1 <= int(parts[1]) <= len(self.sources)):
            raise InputError(
                f"variable '{name}': allowed are sources.<1 to {len(self.sources)}>.x, .y and .z, "
                "and sources.*.x, .y and .z"
            )
        return int(parts[1]) - 1, _COORDINATES.index(parts[2])

    @torch.no_grad()
    def put(self, values: Mapping[str, float]) -> None:
        """Put numbers, in degrees and mm, into the lens and the sources; θ stays as it is."""
        for name, value in values.items():
            place = self._source(name)
            if place is not None:
                self._at(place).fill_(value * _unit(name))
            else:
                self.lens.variables([name])[name].fill_(value * _unit(name))

    def store(self) -> None:
        """Put θ into the lens and the sources."""
        self.put(self.found())


def _unit(name: str) -> float:
    """Of the settings, in the lens's: radians of a degree for tilts."""
    return math.pi / 180.0 if name.rpartition(".")[2] in TILTS else 1.0
