"""Cells of a metasurface in prescriptions and files, and widths for a wanted phase.

A table of cells has a row for each width at each wavelength; its first row names the columns, in
any order::

    width_nm, wavelength_nm, phase_rad, power
    80, 500, 0.31, 0.94
    80, 532, 0.25, 0.95
    ...

`phase_cycles` may take the place of `phase_rad`, and `amplitude`, the root of the share of power
that passes, that of `power`.  `phase_y_rad` and `power_y` besides are of light polarised along a
cell's own y; the others are then of light along its x.  As a file it is such text (.csv, .txt;
commas, semicolons, tabs or blanks between numbers; `#` begins a remark), or a list of rows in YAML,
as in a prescription.  A lens file may name such a file, which is looked for beside it; a
prescription names none, so that one from a stranger reads nothing.
"""

import copy
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dolens.errors import InputError, check_keys
from dolens.files import decode_text, read_file
from dolens.optics.metasurface import Cells, CellTable, Metasurface
from dolens.optics.surfaces.base import Surface, tensor_of
from dolens.optics.surfaces.phase import Phase
from dolens.prescriptions.numbers import as_number, as_numbers, as_positive, number_in_text
from dolens.prescriptions.plain_values import plain_values
from dolens.prescriptions.row_data import phase_from

TABLE_KEY = "cells"
_BESIDE = ("front", "behind")
CELL_KEYS = (TABLE_KEY, "pitch", "widths", "design_wavelength", "angles", *_BESIDE)
_COLUMNS = (
    ("width_nm",),
    ("wavelength_nm",),
    ("phase_rad", "phase_cycles"),
    ("power", "amplitude"),
)
# Of light polarised along the cell's own y, where the others are of light along its x.
_ALONG_Y = (("phase_y_rad", "phase_y_cycles"), ("power_y", "amplitude_y"))
_ALLOWED = "; ".join(" or ".join(names) for names in _COLUMNS)
_ALLOWED += f"; and by choice {' and '.join(' or '.join(names) for names in _ALONG_Y)}"
_YAML, _TEXT = (".yaml", ".yml"), (".csv", ".txt")
_MOST_BYTES, _MOST_ROWS = 64 * 2**20, 200_000
# A solver's share of power may exceed one by so much.
_ABOVE_ONE = 1e-3
# Cells from the vertex to the side; waves pass no more.
_MOST_CELLS = 2048
# Widths that are tried, and phases within a turn that they are found for.
_TRIED, _PHASES = 2048, 2048


def read_cells(path: str | Path) -> CellTable:
    """Read a table of cells from a file.

    Raises:
        InputError: the file cannot be read, or holds no table; one line that names it.
    """
    place, suffix = str(path), Path(path).suffix.lower()
    if suffix not in (*_YAML, *_TEXT):
        allowed = ", ".join((*_TEXT, *_YAML))
        raise InputError(f"{place}: a table of cells ends in one of {allowed}")
    text = decode_text(read_file(path, _MOST_BYTES, "table of cells"), place)
    return cell_table(plain_values(text, place) if suffix in _YAML else _rows_of(text), place)


def _rows_of(text: str) -> list[list[str]]:
    """Return the words of the lines of a text, without remarks."""
    lines = [line.partition("#")[0].strip() for line in text.removeprefix("\ufeff").splitlines()]
    lines = [line for line in lines if line]
    mark = next((mark for mark in ";,\t" if lines and mark in lines[0]), None)
    return [[word.strip() for word in line.split(mark)] for line in lines]


def cell_table(rows: object, place: str = "cells") -> CellTable:
    """Return the table of rows, of which the first names the columns; see the module.

    Args:
        rows: of names, and of numbers.
        place: begins messages.

    Raises:
        InputError: one line that says which row is wrong, and what is allowed.
    """
    if not isinstance(rows, list | tuple) or not all(isinstance(r, list | tuple) for r in rows):
        raise InputError(f"{place}: must be rows, of which the first names the columns: {_ALLOWED}")
    if not 1 < len(rows) <= _MOST_ROWS:
        raise InputError(f"{place}: has {len(rows)} rows; allowed: 2 to {_MOST_ROWS}")
    names = [str(name) for name in rows[0]]
    columns = _COLUMNS if len(names) <= len(_COLUMNS) else (*_COLUMNS, *_ALONG_Y)
    chosen = [[name for name in names if name in either] for either in columns]
    if len(names) != len(columns) or any(len(found) != 1 for found in chosen):
        raise InputError(f"{place}: has the columns {', '.join(names)}; allowed: {_ALLOWED}")
    order = [names.index(found[0]) for found in chosen]
    phases, powers = ([found[0] for found in chosen[k::2]] for k in (2, 3))
    table: dict[tuple[float, float], list[tuple[float, float]]] = {}
    for number, row in enumerate(rows[1:], 1):
        where = f"{place}: row {number}"
        if len(row) != len(names):
            raise InputError(f"{where}: has {len(row)} numbers, not {len(names)}")
        width, wave, *numbers = (_number(row[k], f"{where}: {names[k]}") for k in order)
        if not width > 0.0 or not wave > 0.0:
            raise InputError(f"{where}: {width:g} nm at {wave:g} nm; allowed: above 0")
        for name, passed in zip(powers, numbers[1::2], strict=True):
            if not 0.0 <= passed <= 1.0 + _ABOVE_ONE:
                raise InputError(f"{where}: {name} is {passed:g}; allowed: 0 to 1")
        if (wave, width) in table:
            raise InputError(f"{where}: the width {width:g} nm at {wave:g} nm is given twice")
        table[wave, width] = [
            (
                phase * (2.0 * math.pi if of_phase.endswith("cycles") else 1.0),
                passed if of_power.startswith("amplitude") else passed**0.5,
            )
            for of_phase, of_power, phase, passed in zip(
                phases, powers, numbers[::2], numbers[1::2], strict=True
            )
        ]
    waves, widths = (sorted({key[k] for key in table}) for k in (0, 1))
    for wave in waves:
        for width in widths:
            if (wave, width) not in table:
                raise InputError(f"{place}: the width {width:g} nm at {wave:g} nm is missing")
    held = np.array([[table[wave, width] for width in widths] for wave in waves])
    nodes = np.array(widths), np.array(waves)
    try:
        # Of light along x first, and along y where the table has it.
        tables = [CellTable(*nodes, *held[:, :, k].transpose(2, 0, 1)) for k in range(len(phases))]
        return replace(tables[0], along_y=tables[1]) if len(tables) > 1 else tables[0]
    except InputError as error:
        raise InputError(f"{place}: {error}") from None


def _number(value: object, place: str) -> float:
    return number_in_text(value, place) if isinstance(value, str) else as_number(value, place)


def metasurface_from(
    row: Mapping[str, Any], surface: Surface, where: str, dtype: torch.dtype
) -> Metasurface:
    """Build the cells of a surface from the `diffractive` key of a prescription.

    Raises:
        InputError: one line that says what is wrong, and what is allowed.
    """
    check_keys(row, CELL_KEYS, where)
    if not surface.flat:
        raise InputError(f"a surface of type '{surface.kind}' cannot have 'cells'; allowed: plane")
    for key in (TABLE_KEY, "pitch"):
        if row.get(key) is None:
            raise InputError(f"'{key}' is missing; cells need it")
    if isinstance(row[TABLE_KEY], str):
        raise InputError(
            f"'{TABLE_KEY}': '{row[TABLE_KEY]}' is a file's name, which lens files and experiments "
            "may give; prescriptions as data have its rows (cell_rows(read_cells(file)))"
        )
    table = cell_table(row[TABLE_KEY], f"'{TABLE_KEY}'")
    given, wave, pitch = row.get("widths"), row.get("design_wavelength"), row["pitch"]
    if (given is None) == (wave is None):
        raise InputError("give 'widths', or the 'design_wavelength' of a 'phase' that makes them")
    if given is not None:
        widths = tensor_of(as_numbers(given, "'widths'"), "widths", dtype)
    elif surface.phase is None:
        raise InputError("'design_wavelength' makes widths of a 'phase', and there is none")
    elif not surface.aperture.clips:
        raise InputError("'design_wavelength' needs a 'semi_diameter', mm, which ends the cells")
    else:
        law, nm = copy.deepcopy(surface.phase).double(), as_number(wave, "'design_wavelength'")
        sizes = as_positive(pitch, "'pitch'"), surface.semi_diameter
        widths = _widths_of(law, table, nm, *sizes).to(dtype)
    angles = row.get("angles")
    if angles is not None:
        angles = tensor_of(as_numbers(angles, "'angles'"), "angles", dtype)
    beside: dict[str, Any] = {key: row.get(key) or () for key in _BESIDE}
    cells = Cells(table, widths, as_number(pitch, "'pitch'"), angles, **beside)
    found = Metasurface(cells, dtype)
    cells.check([], where)
    return found


def metasurface_row(element: Metasurface) -> dict[str, Any]:
    """Return what `metasurface_from` reads back as the same cells, to the last bit."""
    cells = element.cells
    row = {
        TABLE_KEY: cell_rows(cells.table),
        "pitch": cells.pitch,
        "widths": cells.widths.detach().tolist(),
    }
    if cells.angles is not None:
        row["angles"] = cells.angles.detach().tolist()
    beside = {key: [dict(one) for one in getattr(cells, key)] for key in _BESIDE}
    return row | {key: elements for key, elements in beside.items() if elements}


def with_tables(prescription: Any, folder: str | Path = "") -> Any:
    """Return a prescription that has the rows of the tables of cells that it names as files.

    Args:
        prescription: plain values, of a lens or not.
        folder: that the files' names start from; the one that the program runs in unless given.

    Raises:
        InputError: a file cannot be read, or holds no table; one line that names it.
    """
    rows = prescription.get("surfaces") if isinstance(prescription, Mapping) else None
    if not isinstance(rows, Mapping):
        return prescription
    found = {}
    for number, row in rows.items():
        element = row.get("diffractive") if isinstance(row, Mapping) else None
        if isinstance(element, Mapping) and isinstance(file := element.get(TABLE_KEY), str):
            table = cell_rows(read_cells(Path(folder) / file))
            found[number] = {**row, "diffractive": {**element, TABLE_KEY: table}}
    return {**prescription, "surfaces": {**rows, **found}} if found else prescription


def cell_rows(table: CellTable) -> list[list[Any]]:
    """Return the rows that `cell_table` reads back as the same table, to the last bit."""
    names = ["width_nm", "wavelength_nm", "phase_rad", "amplitude"]
    held = [table.phase, table.amplitude]
    if table.along_y is not None:
        names += ["phase_y_rad", "amplitude_y"]
        held += [table.along_y.phase, table.along_y.amplitude]
    rows: list[list[Any]] = [names]
    for wave, *numbers in zip(table.wavelengths.tolist(), *(n.tolist() for n in held), strict=True):
        each = zip(table.widths.tolist(), *numbers, strict=True)
        rows += [[width, wave, *passed] for width, *passed in each]
    return rows


def cell_widths(
    table: CellTable,
    phase: Mapping[str, Any],
    wavelength: float,
    pitch: float,
    semi_diameter: float | None = None,
    rings: bool = False,
) -> Tensor:
    """Return the widths whose light is nearest to a wanted phase, in complex amplitude.

    Of each cell it is the width of the least |t - exp(iφ)|, φ being the phase at its centre; where
    a table tells polarisations apart, of the least mean square of both.

    Args:
        table: of the cells.
        phase: as a surface of a prescription has it, for example `lens_phase(0.1, 532, 0.02)`.
        wavelength: nm, that the phase is wanted at.
        pitch: mm, of cells or rings.
        semi_diameter: mm, to the side of the square of cells, or to the last ring; None: the
            phase's `norm_radius`.
        rings: whether to return rings, of a phase that is the same at every azimuth.

    Returns:
        nm, (N, N) as `widths` of a prescription has them, or (K,) of rings.

    Raises:
        InputError: a wavelength outside of the table, or no phase or extent.
    """
    law = phase_from(phase, "phase", torch.float64)
    reach = phase.get("norm_radius") if semi_diameter is None else semi_diameter
    reach, pitch = as_positive(reach, "'semi_diameter'"), as_positive(pitch, "'pitch'")
    return _widths_of(law, table, wavelength, pitch, reach, rings)


def _widths_of(
    law: Phase,
    table: CellTable,
    wavelength: float,
    pitch: float,
    reach: float,
    rings: bool = False,
) -> Tensor:
    """Return widths for a phase; arguments as of `cell_widths`."""
    low, high = float(table.widths[0]), float(table.widths[-1])
    tried = torch.linspace(low, high, _TRIED, dtype=torch.float64)
    Cells(table, tried, pitch).check([wavelength], "widths of cells")
    parameters = {**dict(law.named_parameters()), **dict(law.named_buffers())}
    half = math.ceil(reach / pitch - 1e-9)
    if half > _MOST_CELLS:
        raise InputError(f"{2 * half} cells a side are too many; allowed: {2 * _MOST_CELLS}")
    at = (torch.arange(half, dtype=torch.float64) + 0.5) * pitch
    across, down = at, torch.zeros(1, dtype=torch.float64)
    if not rings:
        across = down = torch.cat((-at.flip(0), at))
    columns, rows = across[None].expand(len(down), -1), down[:, None].expand(-1, len(across))
    with torch.no_grad():
        wanted = law.phase_and_gradient(parameters, columns, rows)[0]
        both = [t.transmission(tried, wavelength) for t in (table, table.along_y) if t is not None]
        passed = torch.stack(both).mean(0)
        power = torch.stack(both).abs().square().mean(0)
        turns = torch.arange(_PHASES, dtype=torch.float64) * (2.0 * math.pi / _PHASES)
        # |t - e^{iφ}|² = |t|² + 1 - 2·Re(t·e^{-iφ}), of so few phases at once as a cache holds.
        ways, twice = torch.stack((turns.cos(), turns.sin()), -1), 2.0 * torch.view_as_real(passed)
        nearest = [torch.addmm(power, some, -twice.mT).argmin(1) for some in ways.split(64)]
        best = tried[torch.cat(nearest)]
        found = best[(wanted * (_PHASES / (2.0 * math.pi))).round().long() % _PHASES]
    return found[0] if rings else found
