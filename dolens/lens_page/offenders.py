"""The worst offenders among a lens's tolerances, for its page.

A file of tolerances is YAML::

    elements:                     # optional, as in a lens file: groups that tilt and move
      front: {surfaces: [1, 2]}
    tolerances:                   # as experiment=cooke_sensitivity has them
      elements.*.tilt_[xy]: 0.05                              # half-ranges: degrees,
      elements.*.decenter_[xy]: {half_range: 0.02}            # mm,
      surfaces.*.curvature: {half_range: 0.001, relative: true}    # or shares of the value
    tolerance_factor: 1           # optional; multiplies all of them

An experiment's file does as well: its `lens.elements` and `tolerances` are read.  Without a file,
they are the usual ones of `dolens.tolerancing.tolerances`.
"""

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from dolens.analysis.conditions import Conditions
from dolens.errors import InputError, check_keys
from dolens.lens_page.tables import Table, number
from dolens.optics.lens import Lens
from dolens.plotting.tolerances import offenders_figure, parameter_label, tolerance_label
from dolens.prescriptions.files import read_yaml_file
from dolens.prescriptions.numbers import require_mapping
from dolens.prescriptions.row_data import elements_from
from dolens.tolerancing import (
    Contributions,
    Sensitivities,
    Tolerances,
    contributions,
    linear_spots_over_field,
    sensitivities,
    tolerances_from,
    usual_tolerances,
    usual_tolerances_text,
    with_glass_elements,
)

DEFAULT = "default"
_MOST = 12
# `drawing` is what `dolens export` writes on drawings besides.
_OWN_KEYS = ("tolerances", "tolerance_factor", "elements", "drawing")


@dataclass(frozen=True)
class Offenders:
    """What tolerances do to a lens, by the linear ray model.

    Attributes:
        tolerances: P of them.
        sensitivities: of each alone.
        contributions: of each to the mean square radius of refocused lenses.
        notes: what was assumed or not read, a sentence each.
    """

    tolerances: Tolerances
    sensitivities: Sensitivities
    contributions: Contributions
    notes: list[str]

    def figure(self) -> Figure:
        """Draw the worst offenders as bars."""
        t, c, s = self.tolerances, self.contributions, self.sensitivities
        first = c.order[:_MOST]
        return offenders_figure(
            [tolerance_label(t.names[p], t.label(p)) for p in first],
            c.share[first].tolist(),
            {
                "refocused": s.increase()[first].tolist(),
                "not refocused": s.increase(refocused=False)[first].tolist(),
            },
        )

    def table(self) -> Table:
        """Return the worst offenders, one a row."""
        t, c, s = self.tolerances, self.contributions, self.sensitivities
        growth, unfocused = s.increase(), s.increase(refocused=False)
        rows = [
            (
                parameter_label(t.names[p]),
                t.label(p).replace("-", "−"),
                f"{100.0 * float(c.share[p]):.1f} %",
                number(1e3 * growth[p], 3, zeros=True),
                number(1e3 * unfocused[p], 3, zeros=True),
                number(1e3 * s.largest_centroid_shift[p], 3, zeros=True),
            )
            for p in c.order[:_MOST]
        ]
        heads = ("parameter", "tolerance", "share", "RMS grows", "not refocused", "spot moves")
        return Table(
            heads,
            rows,
            f"The worst {len(rows)} of {len(t.names)} tolerances. RMS radius over all spots, and "
            "motion of the farthest spot, in µm, at the end of each tolerance alone; share: of the "
            "average rise of the mean square radius, refocused.",
            frozenset({0, 1}),
        )

    def summary(self) -> str:
        """Return the radius as designed, and that expected under all tolerances."""
        design = 1e3 * self.contributions.nominal**0.5
        expected = 1e3 * self.contributions.expected_rms
        return (
            f"RMS radius over all spots, refocused: {number(design, 4)} µm as designed, "
            f"{number(expected, 4)} µm expected under all tolerances together (linear ray model)."
        )


def offenders(lens: Lens, where: Conditions, source: str | Path) -> Offenders:
    """Find the worst offenders of a lens.

    Args:
        lens: as designed, in double precision; it stays as it is.
        where: fields, which are taken on both sides of the axis in x and in y, and wavelengths,
            with their weights.
        source: `default`, or a YAML file; see the module.

    Raises:
        InputError: the file cannot be read or names what the lens does not have, or no light of
            a field passes.
    """
    notes: list[str] = []
    given: Mapping[str, Any]
    if str(source) == DEFAULT:
        lens = with_glass_elements(lens)
        given, factor = usual_tolerances(lens), 1.0
        notes.append(usual_tolerances_text(lens))
    else:
        lens = copy.deepcopy(lens).requires_grad_(True)
        given, factor = _read(lens, Path(source), notes)
    tolerances = tolerances_from(lens, given, factor)
    model, weights = linear_spots_over_field(lens, where, tolerances.names)
    return Offenders(
        tolerances,
        sensitivities(model, tolerances.steps, weights),
        contributions(model, tolerances, weights),
        notes,
    )


def _read(lens: Lens, path: Path, notes: list[str]) -> tuple[Mapping[str, Any], Any]:
    """Return the tolerances of a file and their factor; the lens gets the file's elements."""
    content = read_yaml_file(path, "file of tolerances", "--tolerances")
    require_mapping(content, str(path))
    elements = content.get("elements")
    if "defaults" in content:
        # An experiment's file: it also says how its own run is done.
        own = content.get("lens")
        if isinstance(own, Mapping):
            elements = own.get("elements")
        unread = [str(key) for key in content if key not in (*_OWN_KEYS, "defaults", "lens")]
        if unread:
            notes.append(f"Not read from {path.name}: {', '.join(unread)}.")
    else:
        check_keys(content, _OWN_KEYS, str(path))
    if "tolerances" not in content:
        raise InputError(f"{path}: 'tolerances' is missing")
    if elements is not None:
        for name, element in elements_from(elements, lens.dtype, str(path)).items():
            lens.elements[name] = element
    notes.append(f"Tolerances of {path.name}.")
    return content["tolerances"], content.get("tolerance_factor", 1.0)
