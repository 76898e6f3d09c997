"""The sections of a page about a lens: what each shows, and how it is computed.

Every section is computed alone, so that one that fails leaves the others.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.analysis.conditions import FieldScan, field_scans, spectral_lines, wavelength_interval
from dolens.analysis.encircled_energy import encircled_energy
from dolens.analysis.field_curves import DISTORTION_REFERENCES, field_curves, image_displacement
from dolens.analysis.footprint import footprint
from dolens.analysis.ghost_map import ghost_map
from dolens.analysis.lateral_colour import chromatic_focal_shift, lateral_colour
from dolens.analysis.modulation_transfer import frequency_range, modulation
from dolens.analysis.ray_intercepts import aimed_at_stop, ray_fans
from dolens.analysis.spot_diagram import rms_against_field, rms_against_wavelength
from dolens.diffraction.field_wavefronts import PreparedPupils, prepare_pupils
from dolens.diffraction.illumination import relative_illumination
from dolens.diffraction.modulation_transfer import diffraction_modulation
from dolens.diffraction.point_spread import (
    PointSpread,
    diffraction_encircled_energy,
    marechal,
    point_spread,
)
from dolens.diffraction.wavefront_map import (
    WavefrontErrors,
    WavefrontMaps,
    wavefront_errors,
    wavefront_maps,
)
from dolens.errors import InputError
from dolens.lens_page.in_space import HANDS
from dolens.lens_page.markup import View, view
from dolens.lens_page.offenders import bright_fields, offenders
from dolens.lens_page.overview import Overview
from dolens.lens_page.solid import solid
from dolens.lens_page.tables import Table, ghost_tables, ghosts_of_fields, number
from dolens.optics.fields import field_label
from dolens.optics.lens import Lens
from dolens.plotting.field_curves import (
    field_curves_figure,
    illumination_figure,
    lateral_colour_figure,
    rms_curves_figure,
)
from dolens.plotting.footprint import footprint_figure
from dolens.plotting.ghosts import ghost_map_figure
from dolens.plotting.lens_section import lens_section_figure, states_layout_figure
from dolens.plotting.modulation import modulation_comparison_figure
from dolens.plotting.point_spread import encircled_energy_figure, point_spread_figure
from dolens.plotting.spots_and_ray_fans import ray_fans_figure, spots_figure
from dolens.plotting.wavefront_maps import wavefront_maps_figure


@dataclass(frozen=True)
class Content:
    """What a section shows.

    Attributes:
        figures: file name without suffix → figure.
        tables: below the figures.
        note: a sentence above them.
        space: the lens in space, above them.
        problems: what could not be computed, and why, a sentence each.
    """

    figures: dict[str, Figure] = field(default_factory=dict)
    tables: list[Table] = field(default_factory=list)
    note: str = ""
    space: View | None = None
    problems: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Section:
    """A section of a page.

    Attributes:
        name: in addresses within the page.
        title: its heading.
        make: computes what it shows.
    """

    name: str
    title: str
    make: Callable[[], Content]


# Of each field and wavelength.
_MTF_RAYS, _RMS_RAYS, _FOOTPRINT_RAYS = 6000, 2000, 400


class PageSections:
    """Computes the sections of a page; what several of them need is computed once.

    Args:
        lens: prepared (see `prepared_lens`).
        overview: its tables and conditions.
        tolerances: `default` or a file, for the worst offenders; None leaves them out.
        ghosts: whether there is a section of ghosts.
    """

    def __init__(
        self,
        lens: Lens,
        overview: Overview,
        tolerances: str | Path | None = None,
        ghosts: bool = False,
    ) -> None:
        self.tolerances, self.with_ghosts = tolerances, ghosts
        self.lens, self.overview, self.where = lens, overview, overview.conditions
        self.distance = overview.conditions.object_distance

    def sections(self) -> list[Section]:
        """Return all sections in the order of the page."""
        last = [Section("ghosts", "Ghosts", self.ghosts)] if self.with_ghosts else []
        if self.tolerances is not None:
            last.append(Section("offenders", "Tolerances", self.offenders))
        return [
            Section("layout", "Section", self.layout),
            *([Section("states", "States", self.states)] if self.lens.states else []),
            Section("space", "In space", self.space),
            Section("spots", "Spot diagram", self.spots),
            Section("fans", "Ray fans", self.fans),
            Section("mtf", "MTF", self.mtf),
            Section("psf", "Point spread functions", self.psf),
            Section("rms", "RMS against field and wavelength", self.rms),
            Section("energy", "Encircled energy", self.energy),
            Section("field", "Field curvature and distortion", self.field_curves),
            Section("colour", "Lateral colour and focal shift", self.colour),
            Section("light", "Relative illumination", self.light),
            Section("wavefront", "Wavefront error", self.wavefront),
            Section("footprint", "Footprints", self.footprint),
            *last,
        ]

    @cached_property
    def scans(self) -> list[FieldScan]:
        """Return fields along lines through the axis."""
        return field_scans(self.lens, self.distance)

    def layout(self) -> Content:
        """Draw the lens in section."""
        where = self.where
        beside = int((where.fields[:, 0] != 0.0).sum())
        drawn = where if beside < len(where.fields) else where.at(0.0)
        figure = lens_section_figure(self.lens, drawn, title="")
        note = f"Rays at {where.reference_wavelength:g} nm."
        if beside:
            note += " Fields beside the y-z plane are drawn in space only."
        return Content({"section": figure}, note=note)

    def states(self) -> Content:
        """Draw the section of the lens in every state."""
        found = {name: self.lens.in_state(name) for name in self.lens.state_names}
        return Content({"states": states_layout_figure(found)})

    def space(self) -> Content:
        """Describe the lens in space."""
        spots = self.overview.spots
        lit = None if spots is None else spots.rms.isfinite().any(1).tolist()
        found = solid(self.lens, self.where, lit)
        return Content(
            space=view(found, self.where),
            note=f"{HANDS} Rays at {self.where.reference_wavelength:g} nm.",
        )

    def spots(self) -> Content:
        """Plot spots."""
        spots = self.overview.spots
        if spots is None:
            raise InputError("the spots could not be traced")
        return Content({"spots": spots_figure(spots, overlaid=True, title="")})

    def fans(self) -> Content:
        """Plot ray fans."""
        fans = ray_fans(self.lens, self.where)
        return Content({"ray_fans": ray_fans_figure(fans, title="")})

    def mtf(self) -> Content:
        """Plot the MTF with diffraction, and that of rays alone."""
        aimed = aimed_at_stop(self.lens, self.where.that_count())
        frequencies = frequency_range(self.lens, self.where, aimed=aimed)
        wave = diffraction_modulation(self.lens, self.where, frequencies, self._pupils)
        rays = modulation(self.lens, self.where, frequencies, _MTF_RAYS, aimed)
        figure = modulation_comparison_figure(wave, rays, title="")
        return Content(
            {"mtf": figure},
            note=sampling_note("MTF with diffraction", wave.sampling_error),
            problems=self._by_rays(wave.diffraction, wave.reasons),
        )

    def psf(self) -> Content:
        """Show point spread functions."""
        found = self._spread
        return Content(
            {"psf": point_spread_figure(found, title="")},
            note=sampling_note("irradiance, over its peak", found.sampling_error),
            problems=self._by_rays(found.diffraction, found.reasons),
        )

    @cached_property
    def _spread(self) -> PointSpread:
        return point_spread(self.lens, self.where, prepared=self._pupils)

    @cached_property
    def _pupils(self) -> PreparedPupils:
        return prepare_pupils(self.lens, self.where)

    def _by_rays(self, diffraction: Sequence[bool], reasons: Sequence[str]) -> list[str]:
        """Say of which fields rays alone make the image, and why."""
        found: dict[str, list[str]] = {}
        for point, waves, reason in zip(self.where.fields, diffraction, reasons, strict=True):
            if not waves:
                text = field_label(point, self.where.field_unit)
                found.setdefault(reason.removeprefix("rays alone: "), []).append(text)
        return [
            f"diffraction at {', '.join(fields)} ({reason})" for reason, fields in found.items()
        ]

    def energy(self) -> Content:
        """Plot encircled energy with diffraction, and that of rays."""
        wave = diffraction_encircled_energy(self.lens, self.where, prepared=self._pupils)
        rays = encircled_energy(self.lens, self.where, wave.radii_um)
        return Content({"encircled_energy": encircled_energy_figure(wave, rays, title="")})

    def field_curves(self) -> Content:
        """Plot field curvature and distortion."""
        waves = self.where.wavelengths
        curves = [field_curves(self.lens, scan, waves) for scan in self.scans]
        tables = [] if self.distance is not None else [distortion_table(self.lens, self.scans)]
        return Content({"field_curves": field_curves_figure(curves, title="")}, tables)

    def colour(self) -> Content:
        """Plot lateral colour, and the focus against the wavelength."""
        waves = spectral_lines(self.lens)
        curves = [lateral_colour(self.lens, scan, waves) for scan in self.scans]
        shift = chromatic_focal_shift(self.lens, object_distance=self.distance)
        return Content({"lateral_colour": lateral_colour_figure(curves, shift, title="")})

    def light(self) -> Content:
        """Plot relative illumination."""
        found = [relative_illumination(self.lens, scan) for scan in self.scans]
        return Content({"relative_illumination": illumination_figure(found, title="")})

    def wavefront(self) -> Content:
        """Show wavefront maps, and list errors, Strehl ratios and Zernike coefficients."""
        found = wavefront_errors(self.lens, self.where)
        wave = self.where.reference_wavelength
        maps = wavefront_maps(self.lens, self.where.at(wavelengths=wave))
        note = (
            f"At {wave:g} nm, about the chief ray's point of the sensor; positive where the "
            "wavefront is ahead of the reference sphere."
        )
        figure = wavefront_maps_figure(maps, title="")
        return Content({"wavefront": figure}, [errors_table(found), zernike_table(maps)], note)

    def footprint(self) -> Content:
        """Show where the beams meet the surfaces."""
        found = footprint(self.lens, self.where, rays=_FOOTPRINT_RAYS)
        note = f"Rays at {found.wavelength:g} nm, spread evenly over the stop."
        return Content({"footprints": footprint_figure(found, title="")}, note=note)

    def rms(self) -> Content:
        """Plot RMS radii."""
        where = self.where
        against_field = None
        if bool(where.fields.any()):
            against_field = rms_against_field(self.lens, where, rays=_RMS_RAYS)
        against_wavelength = rms_against_wavelength(
            self.lens, where, wavelength_interval(self.lens), count=11, rays=_RMS_RAYS
        )
        figure = rms_curves_figure(against_field, against_wavelength, title="")
        return Content({"rms": figure})

    def ghosts(self) -> Content:
        """Show the ghosts of a source at each field over the sensor, and the brightest of all."""
        found = ghosts_of_fields(self.lens, self.where)
        maps = [ghost_map(self.lens, one.found.where) for one in found]
        brightest = max(found, key=lambda one: float(one.found.measures.irradiance[0]))
        return Content(
            {
                "ghosts": ghost_map_figure(maps, None),
                "brightest_ghost": brightest.draw(),
            },
            ghost_tables(found),
        )

    def offenders(self) -> Content:
        """Find the worst offenders among tolerances."""
        where, problems = bright_fields(self.where, self.overview.spots)
        assert self.tolerances is not None  # there is no such section without
        found = offenders(self.lens, where, self.tolerances)
        return Content(
            {"worst_offenders": found.figure()},
            [found.table()],
            " ".join([*found.notes, found.summary()]),
            problems=problems,
        )


# Fringe terms up to secondary spherical, without piston.
_TERMS = 16
# Every so manieth field of a scan.
_SOME = 8


def errors_table(errors: WavefrontErrors) -> Table:
    """Return RMS, peak to valley and Strehl ratio of every field and wavelength."""
    columns = (
        *(errors.rms, errors.peak_to_valley, errors.strehl_ratio),
        marechal(errors.rms),
    )
    rows = [
        (
            field_label(point, errors.field_unit),
            f"{wave:g}",
            *(number(values[row, column], 3) for values in columns),
        )
        for row, point in enumerate(errors.fields)
        for column, wave in enumerate(errors.wavelengths.tolist())
    ]
    return Table(
        (
            *("field", "wavelength (nm)", "RMS (waves)", "peak to valley (waves)"),
            *("Strehl ratio", "by Maréchal"),
        ),
        rows,
        "On the sensor as it stands, tilt removed; Maréchal's ratio is exp(−(2π·RMS)²). – : no "
        "light passes.",
    )


def zernike_table(maps: WavefrontMaps) -> Table:
    """Return fringe coefficients of the maps' first wavelength, a column a field."""
    fit = maps.zernike("fringe")
    fields = [field_label(field, maps.field_unit) for field in maps.fields]
    rows = [
        (f"Z{n + 1}", fit.names[n], *(number(c, 3) for c in fit.coefficients[:, 0, n]))
        for n in range(1, _TERMS)
    ]
    rows.append(("", "RMS beyond 37 terms", *(number(r, 2) for r in fit.residual_rms[:, 0])))
    return Table(
        ("fringe", "term", *fields),
        rows,
        "Zernike coefficients in waves, over the disc of the stop; over a vignetted or obscured "
        "pupil they are a fit, whose terms are not orthogonal.",
        frozenset({0, 1}),
    )


def distortion_table(lens: Lens, scans: Sequence[FieldScan]) -> Table:
    """Return distortion from f·tan θ and from f·θ at some fields of the first scan."""
    scan = scans[0]
    some = torch.arange(len(scan.fields) - 1, 0, -_SOME).flip(0)
    some = some[scan.coordinate[some] != 0.0]
    columns = [
        image_displacement(lens, scan, [lens.primary_wavelength], name).distortion[some, 0]
        for name in DISTORTION_REFERENCES
    ]
    rows = [
        (field_label(scan.fields[at], scan.field_unit), *(number(c[row], 3) for c in columns))
        for row, at in enumerate(some.tolist())
    ]
    heads = [f"from {text} (%)" for text in DISTORTION_REFERENCES.values()]
    return Table(("field", *heads), rows, "Distortion of the reference wavelength's chief ray.")


def sampling_note(what: str, errors: Tensor) -> str:
    """Return a sentence about the largest sampling error; nothing where none is known."""
    known = errors[errors.isfinite()]
    if not len(known):
        return ""
    return f"Sampling error of the {what}: {number(known.max(), 2)} or less, by a second sampling."
