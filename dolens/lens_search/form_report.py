"""A form is reported: its checks, what tolerances do to it, its section and its files."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dolens.errors import InputError
from dolens.lens_search.files import SUFFIXES, WrittenFile, form_name, write_form
from dolens.lens_search.form_words import glasses_text, powers_text
from dolens.lens_search.found import FoundLens
from dolens.lens_search.lens_colour import LensColour, lens_colour
from dolens.lens_search.real_beams import with_drawn_heights
from dolens.lens_search.requirements import Requirements
from dolens.lens_search.sensitivity import LensSensitivity, lens_sensitivity
from dolens.lens_search.verification import Verification, verify
from dolens.optics.lens import Lens
from dolens.plotting.forms import form_section
from dolens.plotting.small_section import SmallSection


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
    folder: str | Path,
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
        folder: for its files; it is made.
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
        write_form(lens, folder, number, suffixes),
        starts,
        designs,
        tuple(problems),
        colour,
    )
