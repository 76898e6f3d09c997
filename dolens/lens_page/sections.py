"""The sections of a page: what each shows, and how it is computed.

Every section is computed alone, so that one that fails leaves the others.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import torch
from matplotlib.figure import Figure

from dolens.analysis.conditions import (
    FieldScan,
    field_scans,
    wavelength_interval,
)
from dolens.analysis.ray_fans import ray_fans
from dolens.analysis.rms_curves import rms_against_field, rms_against_wavelength
from dolens.errors import InputError
from dolens.lens_page.offenders import offenders
from dolens.lens_page.overview import Overview
from dolens.lens_page.solid import solid
from dolens.lens_page.tables import Table
from dolens.lens_page.viewer import viewer_html
from dolens.optics.lens import Lens
from dolens.plotting.layout import layout_figure
from dolens.plotting.ray_fans import ray_fans_figure
from dolens.plotting.rms_curves import rms_curves_figure
from dolens.plotting.spots import spots_figure


@dataclass(frozen=True)
class Content:
    """What a section shows.

    Attributes:
        figures: file name without suffix → figure.
        tables: below the figures.
        note: a sentence above them.
        html: elements above them, already escaped.
        problems: what could not be computed, and why, a sentence each.
    """

    figures: dict[str, Figure] = field(default_factory=dict)
    tables: list[Table] = field(default_factory=list)
    note: str = ""
    html: str = ""
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


class PageSections:
    """Computes the sections of a page; what several of them need is computed once.

    Args:
        lens: prepared (see `prepared_lens`).
        overview: its tables and conditions.
        tolerances: `default` or a file, for the worst offenders; None leaves them out.
    """

    def __init__(
        self, lens: Lens, overview: Overview, tolerances: str | Path | None = None
    ) -> None:
        self.tolerances = tolerances
        self.lens, self.overview, self.where = lens, overview, overview.conditions
        self.distance = overview.conditions.object_distance

    def sections(self) -> list[Section]:
        """Return all sections in the order of the page."""
        last = [] if self.tolerances is None else [Section("offenders", "Tolerances", self.offenders)]
        return [
            Section("layout", "Section", self.layout),
            Section("space", "In space", self.space),
            Section("spots", "Spot diagram", self.spots),
            Section("fans", "Ray fans", self.fans),
            Section("mtf", "MTF", self.mtf),
            Section("rms", "RMS against field and wavelength", self.rms),
            *last,
        ]

    @cached_property
    def scans(self) -> list[FieldScan]:
        """Return fields along lines through the axis."""
        return field_scans(self.lens, self.distance)

    def layout(self) -> Content:
        """Draw the lens in section."""
        where = self.where
        meridional = [float(y) for x, y in where.fields.tolist() if x == 0.0]
        if where.object_distance is not None:
            slopes = torch.tensor(meridional) / -where.object_distance
            meridional = torch.rad2deg(slopes.atan()).tolist()
        left = len(where.fields) - len(meridional)
        note = f"{left} field(s) beside the y-z plane are drawn in space only." if left else ""
        figure = layout_figure(
            self.lens,
            where.reference_wavelength,
            meridional or [0.0],
            object_distance=where.object_distance,
            title="",
        )
        return Content({"layout": figure}, note=note)

    def space(self) -> Content:
        """Describe the lens in space."""
        found = solid(self.lens, self.where)
        return Content(
            html=viewer_html(found, self.where),
            note="Drag to turn, pinch or scroll (after a click) to zoom, shift and drag to move. "
            f"Rays at {self.where.reference_wavelength:g} nm.",
        )

    def spots(self) -> Content:
        """Plot spots."""
        spots = self.overview.spots
        if spots is None:
            raise InputError("the spots could not be traced")
        return Content({"spots": spots_figure(spots, overlaid=True, title="")})

    def fans(self) -> Content:
        """Plot ray fans."""
        where = self.where
        fans = ray_fans(self.lens, where.fields, where.wavelengths, object_distance=self.distance)
        return Content({"ray_fans": ray_fans_figure(fans, title="")})

    def mtf(self) -> Content:
        """Plot the MTF of rays, and that of waves."""
        raise InputError("later")

    def rms(self) -> Content:
        """Plot RMS radii."""
        where = self.where
        reach = where.fields[int(where.fields.norm(dim=-1).argmax())].tolist()
        against_field = None
        if any(reach):
            against_field = rms_against_field(
                self.lens, where.wavelengths, reach, object_distance=self.distance
            )
        against_wavelength = rms_against_wavelength(
            self.lens,
            where.fields,
            wavelength_interval(self.lens),
            object_distance=self.distance,
        )
        figure = rms_curves_figure(against_field, against_wavelength, title="")
        return Content({"rms": figure})

    def offenders(self) -> Content:
        """Find the worst offenders among tolerances."""
        found = offenders(self.lens, self.where, self.tolerances)
        return Content(
            {"worst_offenders": found.figure()},
            [found.table()],
            " ".join([*found.notes, found.summary()]),
        )
