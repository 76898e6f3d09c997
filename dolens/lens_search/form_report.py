"""A form is reported: its powers, colour errors, checks, sensitivity to tolerances, and files.

The tolerances are those of `dolens.tolerancing.tolerances`, whose lengths are scaled to the lens.
The spots of lenses as they would be made come from the linear ray model: no lens is traced again.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import torch

from dolens.analysis.conditions import conditions, field_scans
from dolens.analysis.lateral_colour import lateral_colour
from dolens.errors import InputError
from dolens.files import written_whole
from dolens.lens_search.forms import FoundLens
from dolens.lens_search.real_beams import with_drawn_heights
from dolens.lens_search.verification import Requirements, Verification, verify
from dolens.optics.lens import Lens
from dolens.optics.materials import is_glass
from dolens.optics.paraxial import first_order
from dolens.optics.paraxial_rays import ParaxialNumbers
from dolens.optics.system import require_one_index
from dolens.plotting.small_sections import SmallSection, form_section
from dolens.plotting.tolerances import parameter_label
from dolens.prescriptions.build import prescription_of
from dolens.prescriptions.conversion import converted
from dolens.prescriptions.lens_formats import FORMATS
from dolens.tolerancing import (
    Yield,
    contributions,
    linear_spots_over_field,
    quantiles,
    tolerances_from,
    usual_tolerances,
    usual_tolerances_text,
    with_glass_elements,
)

# Elements of less power than this, over the lens's, are neither positive nor negative.
_WEAK = 0.02
_MINUS, _STOP = "−", "|"


class ElementPower(NamedTuple):
    """An `ElementPower` is the power of one element, as if it stood alone in air.

    Attributes:
        first: number of its front surface.
        power: over that of the whole lens.
        glass: its name in a prescription.
    """

    first: int
    power: float
    glass: str


@torch.no_grad()
def element_powers(lens: Lens) -> tuple[ElementPower, ...]:
    """Return the powers of the elements of a centred lens, from the front.

    Raises:
        InputError: a medium is a crystal or a gradient.
    """
    system = lens.system().double()
    require_one_index(system, "powers of elements")
    wave = lens.primary_wavelength
    numbers = ParaxialNumbers.of(system)
    efl = float(lens.first_order(wave).efl)
    found = []
    for k, medium in enumerate(lens.materials[1:-1]):
        if not is_glass(medium):
            continue
        n, thickness = float(medium.index(wave)), numbers.thicknesses[k]
        front, back = numbers.curvatures[k], numbers.curvatures[k + 1]
        power = (n - 1.0) * (front - back + (n - 1.0) / n * thickness * front * back)
        found.append(ElementPower(k + 1, power * efl, medium.name))
    return tuple(found)


def powers_text(lens: Lens) -> str:
    """Return the signs of the powers and the place of the stop: `+ − | (− +) +`.

    Cemented elements stand in parentheses; 0 is an element that hardly has any power.
    """
    words: list[str] = []
    group: list[str] = []
    stopped = False
    for element in element_powers(lens):
        begins = not is_glass(lens.materials[element.first - 1])
        if begins and not stopped and lens.stop <= element.first:
            words.append(_STOP)
            stopped = True
        sign = "0" if abs(element.power) < _WEAK else "+" if element.power > 0.0 else _MINUS
        group.append(sign)
        if not is_glass(lens.materials[element.first + 1]):
            words.append(group[0] if len(group) == 1 else f"({' '.join(group)})")
            group = []
    return " ".join(words if stopped else [*words, _STOP])


def glasses_text(lens: Lens) -> str:
    """Return the glasses from the front: `N-SK16, N-F2, N-SK16`, or `4 × 1.5168`."""
    names = [element.glass for element in element_powers(lens)]
    runs = [(name, len(list(same))) for name, same in groupby(names)]
    return ", ".join(name if count == 1 else f"{count} × {name}" for name, count in runs)


@dataclass(frozen=True)
class LensColour:
    """Holds the colour errors of a lens over its wavelengths.

    Attributes:
        axial_um: µm, how far the paraxial focus of the longest wavelength lies behind that of the
            shortest: primary colour.
        secondary_um: µm, how far the middle of these two foci lies behind that of the reference
            wavelength: the secondary spectrum.
        lateral_um: µm, the greatest distance between chief rays of the shortest and the longest
            wavelength on the sensor, over the field.
    """

    axial_um: float
    secondary_um: float
    lateral_um: float


@torch.no_grad()
def lens_colour(lens: Lens) -> LensColour | None:
    """Return the colour errors of a lens; None for one of a single wavelength.

    Raises:
        InputError: the lens has no fields.
    """
    where = conditions(lens)
    waves = [float(w) for w in where.wavelengths]
    if min(waves) == max(waves):
        return None
    system = lens.system().double()
    lines = (min(waves), where.reference_wavelength, max(waves))
    blue, middle, red = (
        1e3 * float(first_order(system, w, where.object_distance).image) for w in lines
    )
    (scan,) = field_scans(lens, where.object_distance)
    shift = lateral_colour(lens, scan, (lines[0], lines[2])).shift_um
    lateral = (shift[:, 1] - shift[:, 0]).abs().nan_to_num().amax()
    return LensColour(red - blue, 0.5 * (red + blue) - middle, float(lateral))


# Lenses that are drawn, by a generator with this seed.
_LENSES, _SEED = 500, 24
_SHARE = 0.9


@dataclass(frozen=True)
class LensSensitivity:
    """Says what usual tolerances do to a lens, refocused after it is made.

    Attributes:
        nominal_um: µm, RMS spot radius over all fields and wavelengths, as designed.
        expected_um: µm, the root of the mean square over lenses with all tolerances together.
        ninety_percent_um: µm, what 90 % of 500 lenses stay within, all drawn by the same numbers.
        worst: the parameter whose tolerance adds most: `element 3–4 tilt`, `1 curvature`.
        worst_share: its share of what all tolerances add to the mean square.
        tolerances: a sentence that says what they are.
    """

    nominal_um: float
    expected_um: float
    ninety_percent_um: float
    worst: str
    worst_share: float
    tolerances: str


def lens_sensitivity(lens: Lens) -> LensSensitivity:
    """Return what usual tolerances do to a lens, at its own fields and wavelengths.

    Fields are taken on all four sides of the axis, since a lens with tilted elements has no
    symmetry, and the two directions of a tilt or decenter are one offender.

    Args:
        lens: as designed, in double precision; it stays as it is.  Apertures clip the beams where
            they do so as designed.

    Raises:
        InputError: no light of a field passes.
    """
    where = conditions(lens)
    made = with_glass_elements(lens)
    tolerances = tolerances_from(made, usual_tolerances(made))
    model, weights = linear_spots_over_field(made, where, tolerances.names)
    adding = contributions(model, tolerances, weights)
    errors = tolerances.draw(_LENSES, torch.Generator().manual_seed(_SEED))
    curves = model.focus_curves(errors)
    drawn = Yield.of(curves.at(curves.best_focus(weights)), weights)
    shares: dict[str, float] = {}
    for name, share in zip(tolerances.names, adding.share.tolist(), strict=True):
        label = parameter_label(name).removesuffix(" x").removesuffix(" y")
        shares[label] = shares.get(label, 0.0) + share
    worst = max(shares, key=lambda label: shares[label])
    return LensSensitivity(
        1e3 * adding.nominal**0.5,
        1e3 * adding.expected_rms,
        1e3 * quantiles(drawn.rms, [_SHARE])[0],
        worst,
        shares[worst],
        usual_tolerances_text(made),
    )


# One suffix of each format that is written.
SUFFIXES = tuple(each.suffixes[0] for each in FORMATS if each.write is not None)


@dataclass(frozen=True)
class WrittenFile:
    """Says what became of a lens in one format.

    Attributes:
        path: of the file, whether it was written or not.
        written: whether there is such a file.
        exact: whether a lens read from it has the same numbers and media, to the last bit.
        changes: what the file says otherwise than the lens, a sentence each; or why there is none.
    """

    path: Path
    written: bool
    exact: bool
    changes: tuple[str, ...]


def form_name(number: int) -> str:
    """Return the name of the files of a form: `form_01` of the first."""
    return f"form_{number:02d}"


def write_form(
    lens: Lens, folder: str | Path, number: int, suffixes: Sequence[str] = SUFFIXES
) -> tuple[WrittenFile, ...]:
    """Write a lens in every format; one that cannot hold it is named, and the others go on.

    Each file is read again and compared with the lens key by key.

    Args:
        lens: any.
        folder: that the files go to; it is made.
        number: of the form, from 1.
        suffixes: of the formats.

    Raises:
        InputError: a file cannot be written.
    """
    folder = Path(folder)
    prescription = prescription_of(lens)
    found = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for suffix in suffixes:
            path = folder / f"{form_name(number)}{suffix}"
            try:
                made = converted(prescription, lens.name or form_name(number), path.name)
            except InputError as error:
                found.append(WrittenFile(path, False, False, (str(error),)))
                continue
            with written_whole(path) as aside:
                aside.write_bytes(made.data)
            found.append(WrittenFile(path, True, made.same_numbers, tuple(made.changes)))
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from None
    return tuple(found)


@dataclass(frozen=True, eq=False)
class FormReport:
    """Holds what is known about one form.

    Attributes:
        number: its rank, from 1.
        found: its best lens.
        lens: the same, its surfaces drawn as far as its beams go.
        powers: signs of its elements' powers: `+ − | +`.
        glasses: of its elements.
        verification: real rays beside what is required; None where they could not be traced.
        sensitivity: to the usual tolerances; None where it could not be found.
        section: drawn; None where it could not be.
        files: one a format.
        starts: how many starts led to it; None where nobody counted.
        designs: how many designs are of this form; None where nobody counted.
        colour: its colour errors; None for a single wavelength, or where they could not be found.
        problems: what could not be computed, and why, a sentence each.
    """

    number: int
    found: FoundLens
    lens: Lens
    powers: str
    glasses: str
    verification: Verification | None
    sensitivity: LensSensitivity | None
    section: SmallSection | None
    files: tuple[WrittenFile, ...]
    starts: int | None = None
    designs: int | None = None
    problems: tuple[str, ...] = ()
    colour: LensColour | None = None

    @property
    def name(self) -> str:
        """Return the name of its files: `form_01`."""
        return form_name(self.number)

    @property
    def holds(self) -> bool:
        """Return whether the lens was checked and keeps all that is required."""
        return self.verification is not None and self.verification.holds

    @property
    def broken(self) -> str:
        """Return what is not kept, in words; nothing where all is."""
        if self.verification is None:
            return "not checked"
        return ", ".join(check.name for check in self.verification.broken)


def report_form(
    found: FoundLens,
    number: int,
    required: Requirements,
    folder: str | Path | None,
    starts: int | None = None,
    designs: int | None = None,
    suffixes: Sequence[str] = SUFFIXES,
) -> FormReport:
    """Check the best lens of a form, find what tolerances do to it, and write its files.

    What cannot be computed of a lens is a problem of its report, and the rest goes on.

    Args:
        found: the best lens of the form.
        number: its rank, from 1.
        required: what it must keep.
        folder: for its files; it is made.  None: none are written.
        starts: how many starts led to it.
        designs: how many designs are of this form.
        suffixes: of the formats.

    Raises:
        InputError: a file cannot be written.
    """
    lens, problems = found.lens, []
    verification = sensitivity = section = colour = None
    try:
        verification = verify(lens, required)
        lens = with_drawn_heights(lens, verification.beams.heights)
    except InputError as error:
        problems.append(f"checks: {error}")
    try:
        sensitivity = lens_sensitivity(lens)
    except InputError as error:
        problems.append(f"tolerances: {error}")
    try:
        section = form_section(lens)
    except InputError as error:
        problems.append(f"section: {error}")
    try:
        colour = lens_colour(lens)
    except InputError as error:
        problems.append(f"colour: {error}")
    return FormReport(
        number,
        found,
        lens,
        powers_text(lens),
        glasses_text(lens),
        verification,
        sensitivity,
        section,
        () if folder is None else write_form(lens, folder, number, suffixes),
        starts,
        designs,
        tuple(problems),
        colour,
    )
