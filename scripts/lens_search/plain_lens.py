"""A lens file of dolens, read as plain data: rows of spheres, conics and even aspheres on one axis.

It reads the YAML by itself.  Only the index of a glass that is given by a catalogue's name is asked
of dolens; air is 1, and nd/Vd is n = A + B/λ² on the C, d and F lines (index model `dfc`).
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

C_LINE, D_LINE, F_LINE = 656.2725, 587.5618, 486.1327
_SHAPES = ("sphere", "conic", "asphere", "even_asphere", "plane", "aperture")


@dataclass(frozen=True)
class Row:
    """A surface: curvature (1/mm), conic constant, power → coefficient, gap behind it (mm), medium,
    and semi-diameter (mm).
    """

    curvature: float
    conic: float
    terms: dict[int, float]
    gap: float
    material: str
    edge: float = math.inf


@dataclass(frozen=True)
class PlainLens:
    """What a lens file says.

    Attributes:
        path: of the file.
        rows: surfaces in order; the last gap is the sensor's distance.
        stop: the stop's place in `rows`; None where the file names none.
        stop_radius: the stop's own semi-diameter, mm, or None.
        angles: of the fields along y, degrees.
        wavelengths: nm.
        weights: of the wavelengths, 1 in all.
        reference: reference wavelength, nm.
        pupil: `entrance_pupil_diameter` or `f_number` → number; empty where the stop decides.
        index_model: of glasses by nd/Vd.
    """

    path: Path
    rows: tuple[Row, ...]
    stop: int | None
    stop_radius: float | None
    angles: tuple[float, ...]
    wavelengths: tuple[float, ...]
    weights: tuple[float, ...]
    reference: float
    pupil: dict[str, float]
    index_model: str

    def indices(self, wavelength: float) -> list[float]:
        """Return the index behind each surface at a wavelength, nm."""
        found = [self._index(row.material, wavelength) for row in self.rows]
        if None in found:
            from dolens import load_lens

            behind = [m.index(wavelength) for m in load_lens(self.path).materials[1:]]
            found = [float(n) if own is None else own for own, n in zip(found, behind, strict=True)]
        return found

    def _index(self, material: str, wavelength: float) -> float | None:
        if material == "air":
            return 1.0
        number = re.fullmatch(r"([\d.]+)(?:/([\d.]+))?", material)
        if number is None or (number[2] and self.index_model != "dfc"):
            return None
        if number[2] is None:
            return float(number[1])
        index, abbe = float(number[1]), float(number[2])
        b = (index - 1.0) / abbe / (F_LINE**-2 - C_LINE**-2)
        return index + b * (wavelength**-2 - D_LINE**-2)


def read(path: Path) -> PlainLens:
    """Read a lens file.

    Raises:
        SystemExit: one line, where the file holds what these rows cannot.
    """
    data = yaml.safe_load(path.read_text())
    for key in ("elements", "states", "object_distance"):
        if data.get(key):
            raise SystemExit(f"{path}: '{key}' is more than a plain lens has")
    entries = [data["surfaces"][key] for key in sorted(data["surfaces"], key=int)]
    sensor = data.get("sensor") or {}
    distances = [_number(e.get("thickness", 0.0), path) for e in entries[:-1]]
    distances.append(_number(sensor.get("distance", data.get("sensor_distance", 0.0)), path))
    rows = tuple(_row(e, d, path) for e, d in zip(entries, distances, strict=True))
    fields = (data.get("fields") or {}).get("angles") or [[0.0, 0.0]]
    if any(x != 0.0 for x, _ in fields):
        raise SystemExit(f"{path}: fields must lie along y")
    waves = tuple(float(w) for w in data.get("wavelengths") or [D_LINE])
    weights = np.array(data.get("wavelength_weights") or [1.0] * len(waves), dtype=float)
    stop = None if data.get("stop") is None else int(data["stop"]) - 1
    edge = None if stop is None else entries[stop].get("semi_diameter")
    return PlainLens(
        path,
        rows,
        stop,
        float(edge) if isinstance(edge, int | float) else None,
        tuple(float(y) for _, y in fields),
        waves,
        tuple(weights / weights.sum()),
        float(data.get("reference_wavelength") or waves[0]),
        {k: float(data[k]) for k in ("entrance_pupil_diameter", "f_number") if data.get(k)},
        str(data.get("index_model") or "dfc"),
    )


def _row(entry: dict[str, Any], gap: float, path: Path) -> Row:
    kind = entry.get("type", "sphere")
    if kind not in _SHAPES or entry.get("phase"):
        raise SystemExit(f"{path}: a {kind} is none of {', '.join(_SHAPES)}")
    radius = _number(entry.get("radius", np.inf), path)
    terms = {int(k[1:]): float(v) for k, v in entry.items() if re.fullmatch(r"a\d+", k)}
    # An infinite radius is a plane; so is a plane, which has none.
    return Row(
        0.0 if not np.isfinite(radius) else 1.0 / radius,
        float(entry.get("conic", 0.0)),
        terms,
        gap,
        str(entry.get("material", "air")),
        float(edge) if isinstance(edge := entry.get("semi_diameter"), int | float) else math.inf,
    )


def _number(value: Any, path: Path) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise SystemExit(f"{path}: '{value}' is no number") from None


def entrance_pupil(lens: PlainLens, number: Callable = float) -> tuple:
    """Return distance from the first vertex and diameter of the entrance pupil, mm.

    With them the EFL, the back focus, mm, and the stop's height over the pupil's.  `number` makes
    the arithmetic's numbers of floats: `float` itself, or mpmath's.
    """
    one, zero = number(1), number(0)
    indices = [number(n) for n in lens.indices(lens.reference)]
    # y and u of two rays: parallel to the axis at height 1; through the first vertex at slope 1.
    y, u, before = [one, zero], [zero, one], one
    at_stop = None
    for k, (row, index) in enumerate(zip(lens.rows, indices, strict=True)):
        if k == lens.stop:
            at_stop = (y[0], y[1])
        c = number(row.curvature) + 2 * number(row.terms.get(2, 0.0))
        u = [(before * b - a * c * (index - before)) / index for a, b in zip(y, u, strict=True)]
        before = index
        if k < len(lens.rows) - 1:
            y = [a + number(row.gap) * b for a, b in zip(y, u, strict=True)]
    focal, back = -one / u[0], -y[0] / u[0]
    if at_stop is None:
        raise SystemExit(f"{lens.path}: a pupil needs a stop")
    # A ray to the middle of the stop, height h at the first vertex, slope s: A·h + B·s = 0.
    distance = at_stop[1] / at_stop[0]
    scale = at_stop[0]
    if "entrance_pupil_diameter" in lens.pupil:
        diameter = number(lens.pupil["entrance_pupil_diameter"])
    elif "f_number" in lens.pupil:
        diameter = abs(focal) / number(lens.pupil["f_number"])
    elif lens.stop_radius is not None:
        diameter = abs(2 * number(lens.stop_radius) / scale)
    else:
        raise SystemExit(f"{lens.path}: neither f_number nor the stop's semi-diameter is a number")
    return distance, diameter, focal, back, scale
