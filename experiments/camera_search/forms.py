"""The forms that a search left are read from its run folder."""

import math
import os
from dataclasses import dataclass
from pathlib import Path

import torch

from dolens.analysis.conditions import conditions
from dolens.analysis.spot_diagram import spot_diagram
from dolens.errors import InputError
from dolens.experiments.tables import read_table
from dolens.prescriptions import load_lens

_MM = 1e3  # µm
_TABLE = "forms.csv"
# The middles of five zones of equal area of a square, as shares of half its diagonal.
_ZONES = (0.25, 0.44, 0.56, 0.67, 0.79)


@dataclass(frozen=True)
class SearchedForm:
    """A form of a search.

    Attributes:
        name: as `form_03`.
        file: the prescription.
        text: what the file holds.
        rms_spot_um: µm, the mean of the RMS spot radii over the lens's own fields, all its
            wavelengths together.
        rms_spot_um_by_area: µm, the same over a square sensor whose corners are the largest field:
            each part of it counts as its area does.
    """

    name: str
    file: Path
    text: str
    rms_spot_um: float
    rms_spot_um_by_area: float


def forms_of_run(folder: str | Path, most: int) -> tuple[SearchedForm, ...]:
    """Return the forms of a search that keep every check, the least spots first.

    Args:
        folder: the run folder of a search.
        most: forms that are returned.

    Raises:
        InputError: the folder holds no forms, or none that keeps every check.
    """
    folder = Path(folder)
    files = sorted((folder / "forms").glob("form_*.yaml"))
    if not files:
        raise InputError(
            f"{folder}: has no forms/form_*.yaml; name the run folder of a search that found lenses"
        )
    kept = _that_hold(folder / _TABLE)
    forms = [_form(file) for file in files if kept is None or file.stem in kept]
    if not forms:
        raise InputError(f"{folder}: no form keeps every check of the search (see {_TABLE})")
    return tuple(sorted(forms, key=lambda form: form.rms_spot_um)[:most])


def _that_hold(table: Path) -> set[str] | None:
    """Return the names of the forms that keep every check; None where no table says so."""
    if not os.path.lexists(table):
        return None
    rows = read_table(table, ("form", "holds"))
    return {row["form"] for row in rows if row["holds"] == "True"}


@torch.no_grad()
def _form(file: Path) -> SearchedForm:
    lens = load_lens(file, dtype=torch.float64)
    own = conditions(lens)
    largest = math.tan(math.radians(float(own.fields.norm(dim=1).max())))
    zones = [(0.0, math.degrees(math.atan(share * largest))) for share in _ZONES]
    spots, by_area = (
        _MM * float(shares @ spot_diagram(lens, fields, own.wavelengths).polychromatic_rms)
        for fields, shares in (
            (own.fields, own.field_weights),
            (zones, own.field_weights.new_full((len(zones),), 1.0 / len(zones))),
        )
    )
    return SearchedForm(file.stem, file, file.read_text(encoding="utf-8"), spots, by_area)
