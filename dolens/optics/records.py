"""The layout of a table's records follows from a lens's structure alone.

Structure is what stays while a lens is optimised: kinds of surfaces, apertures, media, which
elements carry what.  So records are laid out once, and packing is then one gather and one sum.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dolens.cached_tensors import cached_tensors
from dolens.kernels.table import Code, Kind, Outline, Slot
from dolens.optics.elements import carriers
from dolens.optics.image_surface import WITHOUT_EDGE
from dolens.optics.materials import Medium
from dolens.optics.surfaces.clear_aperture import ClearAperture
from dolens.optics.surfaces.refraction import FAR, tolerance_scale

# Stands in a `Form` for the code of a kernel.
BREAK = -1


class Form(NamedTuple):
    """A shape without its numbers; see `PackedShape`.

    Attributes:
        kind: the code of its kernel, or `BREAK` of a coordinate break, which is no step.
        count: as in `PackedShape`, and the three that follow.
        columns: of a spline or a grid, or numbers of a second series.
        degree: rows of a grid.
        extras: further integers.
        sizes: the shape of each number's tensor; None: the number is zero.
        data: as in `PackedShape`.
    """

    kind: int
    count: int  # type: ignore[assignment]  # a tuple has a method of that name
    columns: int
    degree: int
    extras: tuple[int, ...]
    sizes: tuple[torch.Size | None, ...]
    data: int = 0


class LawForm(NamedTuple):
    """A law of deflection without its numbers.

    Attributes:
        code: of its kernel.
        count: as in `PackedShape`, and `extras`.
        extras: further integers.
        sizes: the shape of each number's tensor; None: the number is zero.
    """

    code: int
    count: int  # type: ignore[assignment]  # a tuple has a method of that name
    extras: tuple[int, ...]
    sizes: tuple[torch.Size | None, ...]


class Structure(NamedTuple):
    """The structure of a lens, which the layout of the records depends on.

    Attributes:
        forms: of all the lens's surfaces.
        apertures: of all of them.
        materials: before surface 1 and after each surface.
        elements: first and last surface of each element.
        mirrors: numbers of the surfaces that reflect.
        senses: of the light in each medium, +1 towards +z and -1 towards -z, in forward mode.
        sense: +1 from the object towards the sensor, -1 backwards.
        first: number of the first surface that is packed, as the prescription counts.
        last: number of the last.
        to_sensor: go on to the sensor plane (forward only).
        laws: what deflects light at each surface in the place of Snell's law, or None.
        image: of the curved surface that rays end on; None of a plane, and short of the sensor.
    """

    forms: tuple[Form, ...]
    apertures: tuple[ClearAperture, ...]
    materials: tuple[Medium, ...]
    elements: tuple[tuple[int, int], ...]
    mirrors: tuple[int, ...]
    senses: tuple[float, ...]
    sense: float
    first: int
    last: int
    to_sensor: bool
    laws: tuple[LawForm | None, ...]
    image: Form | None = None


@dataclass(frozen=True, eq=False)
class Records:
    """Records as constants plus signed numbers of the lens: values[places] += signs·x[sources].

    The lens's numbers x come in this order: the scalars of all surfaces, those of all laws, the
    gaps, the sensor's distance and the image surface's; the arrays of all surfaces; then step (3)
    and turn (9) of each change of axes.

    Attributes:
        constants: (V,), float64.
        places: (E,), int64.
        sources: (E,), int64.
        signs: (E,), float64, each 1 or -1.
        count: of the lens's numbers.
        codes: (steps, Code.ROW), int64; shared, not to be written to.
        extras: int64; likewise.
        media: places in `materials`, in the order of travel.
        waves: whether a row of λ/2π follows those of the media.
        turns: surfaces whose axes rays leave and enter, the sensor's being last of all; 0 stands
            for the lens's own axes, and a last pair (number, 0) for rays that end in them.
    """

    constants: Tensor
    places: Tensor
    sources: Tensor
    signs: Tensor
    count: int
    codes: Tensor
    extras: Tensor
    media: tuple[int, ...]
    waves: bool
    turns: tuple[tuple[int, int], ...]


def tensor(numbers: Sequence | np.ndarray, dtype: type) -> Tensor:
    """A tensor on the CPU; by way of NumPy, which reads lists several times faster."""
    return torch.from_numpy(np.array(numbers, dtype=dtype))


@cached_tensors(maxsize=256)
def records(structure: Structure) -> Records:
    """Lay out the steps of a lens in the order that light of this sense meets them."""
    return _Writer(structure).write()


class _Writer:
    """Collects the records of one structure."""

    def __init__(self, structure: Structure) -> None:
        self.structure = structure
        self.constants: list[float] = []
        self.codes: list[list[int]] = []
        self.extras: list[int] = []
        self.entries: list[tuple[int, int, float]] = []  # place, source, sign
        self.turns: list[tuple[int, int]] = []
        self.media: list[int] = []  # places in `materials`, in the order of travel
        # Where the numbers of each surface, the gaps, and those of the turns begin in x.
        sizes = [[size for size in form.sizes if size is not None] for form in structure.forms]
        self.scalar, self.array, place = [], [], 0
        for of_surface in sizes:
            self.scalar.append(place)
            place += sum(size == () for size in of_surface)
        self.of_law, self.waves = [], False
        for law in structure.laws:
            self.of_law.append(place)
            place += 0 if law is None else sum(size is not None for size in law.sizes)
        self.gaps = place
        place += len(structure.forms)
        self.of_image = place
        place += 0 if structure.image is None else len(structure.image.sizes)
        for of_surface in sizes:
            self.array.append(place)
            place += sum(size.numel() for size in of_surface if size != ())
        self.of_turns = place

    def write(self) -> Records:
        """All records, and the last number, which is added to z of the rays that leave."""
        s = self.structure
        numbers = [n for n in range(s.first, s.last + 1) if s.forms[n - 1].kind != BREAK]
        if s.sense < 0.0:
            numbers.reverse()
        line = self.line(0)  # that the rays' axes lie along
        now, at = 0, 1  # the surface that rays left last, and the vertex that z counts from
        for medium, number in enumerate(numbers):
            before, behind = (number - 1, number) if s.sense > 0.0 else (number, number - 1)
            self.media.append(before)
            then = self.line(number)
            if then != line:
                row = self.step(Kind.CHANGE_AXES, medium, medium, number)
                self.turn(row, now, number)
            row = self.step(s.forms[number - 1].kind, medium, medium + 1, number)
            if then == line:
                self.shift(row, at, number)
            sense_behind = s.sense * s.senses[behind]
            self.constants[row[Code.OFFSET] + Slot.SENSE_BEHIND] = sense_behind
            law = s.laws[number - 1]
            bends = s.materials[before] != s.materials[behind] or number in s.mirrors
            row[Code.REFRACTS] = int(bends and law is None)
            self.aperture(row, s.apertures[number - 1])
            self.shape(row, number)
            self.figures(row, s.apertures[number - 1])
            if law is not None:
                row = self.step(Kind.DEFLECT, medium, medium + 1, number)
                self.constants[row[Code.OFFSET] + Slot.SENSE_BEHIND] = sense_behind
                self.deflection(row, number, law)
            line, now, at = then, number, number
        if s.to_sensor:
            self.media.append(len(s.forms))
        elif numbers:
            self.media.append(numbers[-1] if s.sense > 0.0 else numbers[-1] - 1)
        else:
            self.media.append(s.first - 1)
        self.leave(line, now, at, len(numbers))
        for row in self.codes:
            if row[Code.KIND] == Kind.DEFLECT:
                row[Code.WAVE] = len(self.media)
        places, sources, signs = zip(*self.entries, strict=True) if self.entries else ((), (), ())
        return Records(
            constants=tensor(self.constants, np.float64),
            places=tensor(places, np.int64),
            sources=tensor(sources, np.int64),
            signs=tensor(signs, np.float64),
            count=self.of_turns + 12 * len(self.turns),
            codes=tensor(self.codes, np.int64).reshape(-1, Code.ROW),
            extras=tensor([*self.extras, 0], np.int64),
            media=tuple(self.media),
            waves=self.waves,
            turns=tuple(self.turns),
        )

    def line(self, number: int) -> tuple[int, tuple[int, ...]]:
        """Return what a surface's axes share with others that differ from them in z alone: how many
        breaks stand in front, and which elements carry them; of number 0 the lens's own axes.
        """
        s = self.structure
        breaks = sum(form.kind == BREAK for form in s.forms[: max(number - 1, 0)])
        return breaks, carriers(s.elements, number) if 0 < number <= len(s.forms) else ()

    def step(self, kind: int, before: int, after: int, number: int) -> list[int]:
        """Begin a record; its row of codes, to be filled in further."""
        row = [0] * Code.ROW
        row[Code.KIND], row[Code.OFFSET] = int(kind), len(self.constants)
        row[Code.LENGTH] = Slot.HEADER
        row[Code.BEFORE], row[Code.AFTER] = before, after
        header = [0.0] * Slot.HEADER
        sense = self.structure.sense * self.structure.senses[self.media[before]]
        header[Slot.SENSE], header[Slot.TAG] = sense, 4.0 * number
        self.constants += header
        self.codes.append(row)
        return row

    def shape(self, row: list[int], number: int) -> None:
        """The numbers of a surface's shape, after its header."""
        form = self.structure.forms[number - 1]
        row[Code.COUNT], row[Code.COLUMNS] = form.count, form.columns
        row[Code.DEGREE], row[Code.EXTRAS] = form.degree, len(self.extras)
        self.extras += form.extras
        scalar, array = self.scalar[number - 1], self.array[number - 1]
        for size in form.sizes:
            count = 1 if size is None else size.numel()
            if size is not None:
                source = scalar if size == () else array
                self.add(len(self.constants), source, count)
                scalar, array = (scalar + 1, array) if size == () else (scalar, array + count)
            self.constants += [0.0] * count
        row[Code.LENGTH] = len(self.constants) - row[Code.OFFSET] - form.data

    def deflection(self, row: list[int], number: int, law: LawForm) -> None:
        """The numbers of a surface's shape, and those of its law."""
        self.waves = True
        form = self.structure.forms[number - 1]
        self.shape(row, number)
        # Planes, spheres and conics are there as aspheres: c, k, a2.
        self.constants += [0.0] * (3 - len(form.sizes))
        row[Code.LAW], row[Code.BASE] = law.code, form.kind
        row[Code.LAW_COUNT], row[Code.LAW_EXTRAS] = law.count, len(self.extras)
        self.extras += law.extras
        row[Code.NUMBERS] = len(self.constants) - row[Code.OFFSET]
        source = self.of_law[number - 1]
        for size in law.sizes:
            if size is not None:
                self.add(len(self.constants), source)
                source += 1
            self.constants.append(0.0)
        row[Code.LENGTH] = len(self.constants) - row[Code.OFFSET]

    def add(self, place: int, source: int, count: int = 1, sign: float = 1.0) -> None:
        """Neighbouring numbers of the lens are added to neighbouring places."""
        self.entries += [(place + i, source + i, sign) for i in range(count)]

    def shift(self, row: list[int], at: int, number: int) -> None:
        """z counts from the vertex of another surface (or of the sensor) from here on.

        Gap by gap: the difference of two positions would have the rounding of both.
        """
        low, high = sorted((at, number))
        for gap in range(low - 1, high - 1):
            sign = -1.0 if number > at else 1.0
            self.add(row[Code.OFFSET] + Slot.SHIFT, self.gaps + gap, sign=sign)

    def turn(self, row: list[int], now: int, then: int) -> None:
        """Rays go from the axes of a surface to those of another."""
        source = self.of_turns + 12 * len(self.turns)
        self.add(row[Code.OFFSET] + Slot.STEP, source, 3)
        self.add(row[Code.OFFSET] + Slot.TURN, source + 3, 9)
        self.turns.append((now, then))

    def aperture(self, row: list[int], aperture: ClearAperture) -> None:
        """Write a surface's clear aperture."""
        values, record = self.constants, row[Code.OFFSET]
        edge, hole, size = aperture.edge, aperture.obscuration, aperture.semi_diameter
        values[record + Slot.LIMIT] = FAR * size
        values[record + Slot.SCALE] = tolerance_scale(size)
        # A full circle is tested on the way; where there is none it is out of reach.
        values[record + Slot.EDGE] = (2.0 * FAR * size) ** 2
        for outline in (edge, aperture.window):
            if outline is None:
                continue
            row[Code.EDGE], first, second = outline.packed()
            if row[Code.EDGE] == Outline.CIRCLE:
                values[record + Slot.EDGE] = first
            else:
                values[record + Slot.HALF_X], values[record + Slot.HALF_Y] = first, second
        values[record + Slot.CENTER_X], values[record + Slot.CENTER_Y] = aperture.center
        if hole is not None:
            row[Code.HOLE], *numbers = hole.packed()
            values[record + Slot.HOLE_X], values[record + Slot.HOLE_Y] = numbers

    def image(self, line: tuple[int, tuple[int, ...]], now: int, at: int, medium: int) -> None:
        """From the last surface to a curved sensor, which refracts nothing."""
        s = self.structure
        form = s.image
        assert form is not None
        sensor = len(s.forms) + 1
        turned = line != self.line(sensor)
        if turned:
            self.turn(self.step(Kind.CHANGE_AXES, medium, medium, sensor), now, sensor)
        row = self.step(form.kind, medium, medium, sensor)
        if not turned:
            self.shift(row, at, sensor)
        begin = row[Code.OFFSET]
        self.constants[begin + Slot.SENSE_BEHIND] = self.constants[begin + Slot.SENSE]
        self.aperture(row, WITHOUT_EDGE)
        self.add(len(self.constants), self.of_image, len(form.sizes))
        self.constants += [0.0] * len(form.sizes)
        row[Code.LENGTH] = len(self.constants) - begin

    def figures(self, row: list[int], aperture: ClearAperture) -> None:
        """Write the figures of a clear aperture, which have no cotangents, behind its shape."""
        numbers: list[float] = []
        count = 0
        for blocks, figures in aperture.figures():
            count += len(figures)
            for kind, center, own in figures:
                numbers += [float(kind), float(blocks), *center, float(len(own)), *own]
        if count:
            row[Code.FIGURES] = len(self.constants) - row[Code.OFFSET]
            self.constants += [float(count), *numbers]

    def leave(self, line: tuple[int, tuple[int, ...]], now: int, at: int, medium: int) -> None:
        """From the last surface, which an element may carry, to the lens's axes or the sensor.

        A sensor behind coordinate breaks has axes of its own.
        """
        sensor = len(self.structure.forms) + 1
        own = self.structure.to_sensor and self.line(sensor) != self.line(0)
        if self.structure.image is not None:
            self.image(line, now, at, medium)
            at = sensor
        elif own and line != self.line(sensor):
            self.turn(self.step(Kind.CHANGE_AXES, medium, medium, sensor), now, sensor)
            self.step(Kind.SENSOR, medium, medium, sensor)
            at = sensor
        elif not own and line != self.line(0):
            self.turn(self.step(Kind.LENS_AXES, medium, medium, at), now, 0)
            at = 1
        if self.structure.to_sensor and at != sensor:
            self.shift(self.step(Kind.SENSOR, medium, medium, sensor), at, sensor)
            at = sensor
        exit_z = len(self.constants)
        self.constants.append(0.0)
        for gap in range(at - 1):
            self.add(exit_z, self.gaps + gap)
