"""Designs and specifications in the YAML files of Côté, Tseng and Heide's EISOPTX.

A folder has a folder for each specification, with `defaults.yml` and `designs/*.yml`; a design's
settings go before the defaults'.  A lens is a word: `s` is the stop, `R` an element, `a` in front
of one and behind it a surface with aspheric terms, `m` a metasurface, `-` an air space.  So is
`s-aRa-R-` a stop, an air space, an element of two aspheres, an air space, an element of two
spheres, and the back focus.  `c` are curvatures, `s` the spaces in the order of the word, `nd`,
`vd` and `dpgf` glasses, and each row of `a` is a conic constant and the coefficients of r⁴, r⁶, ...
Each row of `m` is a phase, (r/R)² times Bernstein's polynomials of it or its powers, and one that
goes with 1/λ.  Lengths are in mm.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from dolens.errors import InputError

_NOT_HELD = {"d": "a diffractive surface, of which this reader knows nothing"}
_METASURFACE = "DispersionEngineeredMetasurface"


@dataclass(frozen=True)
class Limits:
    """What a specification asks of a lens besides sharp spots; infinite where it asks nothing.

    Attributes:
        air: least path of any ray between elements, mm.
        glass: least and largest path in an element, mm.
        back: least path from the last surface to the image, mm.
        distortion: largest, share of the paraxial height.
        incidence: largest angle of a ray with a normal, on either side, degrees.
        slope: largest angle of a normal with the axis, degrees.
    """

    air: float = -math.inf
    glass: tuple[float, float] = (-math.inf, math.inf)
    back: float = -math.inf
    distortion: float = math.inf
    incidence: float = math.inf
    slope: float = math.inf


@dataclass(frozen=True)
class Surface:
    """A surface, or the stop, with what stands behind it.

    Attributes:
        curvature: 1/mm; None for the stop.
        terms: conic constant and coefficients of r⁴, r⁶, ...; empty for a sphere.
        space: mm, to the next surface.
        glass: number of the glass behind; None for air.
        refracting: number among the curvatures of the file.
        spaced: number of the space behind among those of the file; None for none.
        phase: of a plane metasurface, radians of (r/R)², (r/R)⁴, ..., and R, mm; None for none.
    """

    curvature: float | None
    terms: tuple[float, ...]
    space: float
    glass: int | None
    refracting: int | None
    spaced: int | None
    phase: tuple[tuple[float, ...], float] | None = None


@dataclass(frozen=True)
class Design:
    """A lens with what it is meant for.

    Attributes:
        name: specification and file.
        surfaces: from object to image; the last one's `space` is the distance to the image.
        glasses: nd, Vd and ΔPgF of each.
        wavelength: nm, of first-order numbers.
        focal_length: mm, which is asked for.
        track: mm, from the first surface to the image, which is held; None where it is free.
        pupil: diameter of the entrance pupil, mm; or None:
        f_number: with `focal_length`.
        half_field: degrees.
        fields: how many there are, evenly from the axis to the half field.
        field_stop: mm behind the first vertex, an aperture as wide as the pupil in object space.
        wavelengths: nm.
        weights: of these.
        limits: what is asked besides.
        held: curvatures (`c`) and spaces (`s`) that are no variables, by their numbers in the file.
        solved: number of the curvature that gives the focal length; None for none.
        damping: settings of Levenberg and Marquardt's method, by the names that they have there.
    """

    name: str
    surfaces: tuple[Surface, ...]
    glasses: tuple[tuple[float, float, float], ...]
    wavelength: float
    focal_length: float
    track: float | None
    pupil: float | None
    f_number: float | None
    half_field: float
    fields: int
    field_stop: float | None
    wavelengths: tuple[float, ...]
    weights: tuple[float, ...]
    limits: Limits
    held: Mapping[str, frozenset[int]] = field(default_factory=dict)
    solved: int | None = None
    damping: Mapping[str, float] = field(default_factory=dict)

    @property
    def angles(self) -> list[list[float]]:
        """Return (x, y) of every field, degrees."""
        last = max(self.fields - 1, 1)
        return [[0.0, self.half_field * n / last] for n in range(self.fields)]

    @property
    def is_spot_design(self) -> bool:
        """Return whether its file says that it was made for spots alone."""
        return not self.name.endswith(("_e2e", "_e2e_raw", "_e2e_restored"))


def design_files(folder: Path) -> list[Path]:
    """Return the files of designs below a folder, in order.

    Raises:
        InputError: there are none.
    """
    found = sorted(folder.glob("*/designs/*.yml"))
    if not found:
        raise InputError(f"--folder: {folder} has no */designs/*.yml")
    return found


def read_design(path: Path) -> Design:
    """Read a design, with the defaults of its specification.

    Raises:
        InputError: a file that is missing or is no such design, or an element that is not held.
    """
    defaults = path.parent.parent / "defaults.yml"
    name = f"{path.parent.parent.name}/{path.stem}"
    model = _merged(_model(defaults), _model(path))
    lens = _arguments(model.get("lens_parameterization"), f"{name}: lens_parameterization")
    light = _arguments(model.get("ray_initialization"), f"{name}: ray_initialization")
    surfaces, glasses = _surfaces(lens, name)
    kind = light.get("aperture_type", "f_number")
    if kind not in ("epd", "f_number"):
        raise InputError(f"{name}: aperture_type: {kind!r}; allowed: epd, f_number")
    aperture = _number(light, "aperture", name)
    waves = [float(w) for w in light.get("wavelengths") or ()]
    weights = [float(w) for w in light.get("wavelength_weights") or [1.0] * len(waves)]
    if not waves or len(weights) != len(waves):
        raise InputError(f"{name}: wavelengths: {len(waves)}, with {len(weights)} weights")
    freeze = lens.get("freeze") or {}
    spaces, curvatures = len(lens["s"]), len(lens["c"])
    held_curvatures, solved = _held(freeze.get("c"), curvatures), lens.get("solve_idx")
    steps = model.get("lens_optimizer")
    damping = _arguments(steps, f"{name}: lens_optimizer") if steps else {}
    return Design(
        name=name,
        surfaces=surfaces,
        glasses=glasses,
        wavelength=float(lens.get("nominal_wavelength", 550.0)),
        focal_length=_number(lens, "target_efl", name),
        track=lens.get("total_track_length_solve"),
        pupil=aperture if kind == "epd" else None,
        f_number=aperture if kind == "f_number" else None,
        half_field=_number(light, "hfov", name),
        fields=int(light.get("n_fields", 1)),
        field_stop=light.get("field_stop_position"),
        wavelengths=tuple(waves),
        weights=tuple(weights),
        limits=_limits(model.get("residuals") or []),
        held={
            "c": frozenset(held_curvatures),
            "s": frozenset(_held(freeze.get("s"), spaces)),
        },
        solved=None if solved is None else int(solved) % curvatures,
        damping={key: float(value) for key, value in damping.items()},
    )


def _surfaces(
    lens: Mapping[str, Any], name: str
) -> tuple[tuple[Surface, ...], tuple[tuple[float, float, float], ...]]:
    """Return the rows that the word of a lens stands for."""
    word = str(lens.get("lens_sequence", ""))
    for letter in word:
        if letter in _NOT_HELD:
            raise InputError(f"{name}: {_NOT_HELD[letter]} ('{letter}' in {word})")
        if letter not in "sRam-":
            raise InputError(f"{name}: lens_sequence: {letter!r}; allowed: s, R, a, m, -")
    if word.count("s") != 1:
        raise InputError(f"{name}: lens_sequence: {word.count('s')} stops; allowed: one")
    keys = ("c", "s", "a", "m", "nd", "vd", "dpgf")
    numbers = {key: list(lens.get(key) or []) for key in keys}
    numbers["dpgf"] = numbers["dpgf"] or [0.0] * len(numbers["nd"])
    elements = word.count("R")
    wanted = {
        "c": 2 * elements,
        "s": elements + word.count("-"),
        "a": word.count("a"),
        "m": word.count("m"),
        "nd": elements,
        "vd": elements,
        "dpgf": elements,
    }
    for key, count in wanted.items():
        if len(numbers[key]) != count:
            raise InputError(f"{name}: {key}: {len(numbers[key])}; allowed for {word}: {count}")
    rows: list[dict[str, Any]] = []
    element = curvature = asphere = metasurface = 0
    for place, letter in enumerate(word):
        if letter == "s":
            rows.append({"curvature": None, "terms": (), "glass": None, "refracting": None})
        elif letter == "m":
            rows.append({"curvature": 0.0, "terms": (), "glass": None, "refracting": None})
            model = lens.get("misc_surface_model")
            rows[-1]["phase"] = _phase(model, numbers["m"][metasurface], name)
            metasurface += 1
        elif letter == "R":
            for behind, side in ((element, place - 1), (None, place + 1)):
                terms: Sequence[float] = ()
                if 0 <= side < len(word) and word[side] == "a":
                    terms, asphere = numbers["a"][asphere], asphere + 1
                rows.append(
                    {
                        "curvature": float(numbers["c"][curvature]),
                        "terms": tuple(float(t) for t in terms),
                        "glass": behind,
                        "refracting": curvature,
                    }
                )
                curvature += 1
            element += 1
    spaces = _spaces(word)
    surfaces = tuple(
        Surface(space=0.0 if n is None else float(numbers["s"][n]), spaced=n, **row)
        for n, row in zip(spaces, rows, strict=True)
    )
    glasses = zip(numbers["nd"], numbers["vd"], numbers["dpgf"], strict=True)
    return surfaces, tuple((float(n), float(v), float(d)) for n, v, d in glasses)


def _phase(model: Any, row: Sequence[float], name: str) -> tuple[tuple[float, ...], float]:
    """Return a metasurface's phase, which must be the same at all wavelengths."""
    kind = str(model.get("class_path", "")) if isinstance(model, Mapping) else ""
    if kind.rpartition(".")[2] != _METASURFACE:
        raise InputError(f"{name}: misc_surface_model: {kind!r}; allowed: {_METASURFACE}")
    settings = _arguments(model, f"{name}: misc_surface_model")
    half = len(row) // 2
    numbers = [float(v) for v in row[:half]]
    if any(row[half:]):
        raise InputError(
            f"{name}: a metasurface whose phase goes with 1/λ, which a phase of dolens does not"
        )
    if settings.get("bezier_parameterization"):
        # x·Σ b_j·C(n, j)·x^j·(1 - x)^(n - j) in powers of x.
        n = half - 1
        numbers = [
            sum(
                (-1) ** (i - j) * math.comb(n, j) * math.comb(n - j, i - j) * numbers[j]
                for j in range(i + 1)
            )
            for i in range(half)
        ]
    return tuple(numbers), float(settings.get("normalization_radius", 1.0))


def _spaces(word: str) -> list[int | None]:
    """Return the number of the space behind each row; a stop on a vertex has none."""
    count, spaces = 0, list[int | None]()
    for letter in word:
        if letter == "R":
            spaces += [count, None]
        elif letter in "sm":
            spaces.append(None)
        elif letter == "-":
            if not spaces or spaces[-1] is not None:
                raise InputError(f"lens_sequence: {word}: a space with nothing in front of it")
            spaces[-1] = count
        count += letter in "R-"
    return spaces


def _held(given: Any, count: int) -> set[int]:
    """Return which of so many numbers a `freeze` entry holds."""
    if isinstance(given, Mapping) and count:
        toggled = {int(i) % count for i in given.get("toggle_row_col_list") or ()}
        every = set(range(count))
        return every - toggled if given.get("default") else toggled
    return set(range(count)) if given else set()


def _limits(entries: Sequence[Mapping[str, Any]]) -> Limits:
    """Return the limits of the residuals that have some."""
    by_class = {
        str(entry.get("class_path", "")).rpartition(".")[2]: entry.get("init_args") or {}
        for entry in entries
    }
    paths = by_class.get("RayPathResiduals", {})

    def largest(kind: str, key: str) -> float:
        return float(by_class.get(kind, {}).get(key, math.inf))

    air = float(paths.get("min_cutoff", -math.inf))
    own = {int(place): float(least) for place, least in paths.get("other_min_cutoffs") or ()}
    return Limits(
        air=air,
        glass=(
            float(paths.get("min_cutoff_refractive", -math.inf)),
            float(paths.get("max_cutoff_refractive", math.inf)),
        ),
        back=own.get(-1, air),
        distortion=largest("DistortionResiduals", "threshold"),
        incidence=largest("RayAngleResiduals", "max_angle"),
        slope=largest("SurfaceNormalResiduals", "max_angle"),
    )


def _model(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    try:
        found = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise InputError(f"{path}: no YAML: {str(error).splitlines()[0]}") from None
    if not isinstance(found, dict) or not isinstance(found.get("model"), dict):
        raise InputError(f"{path}: has no 'model'")
    return found["model"]


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings, the second before the first; lists are whole."""
    found = dict(below)
    for key, value in above.items():
        old = found.get(key)
        both = isinstance(old, Mapping) and isinstance(value, Mapping)
        found[key] = _merged(old, value) if both else value  # type: ignore[arg-type]
    return found


def _arguments(entry: Any, what: str) -> dict[str, Any]:
    found = entry.get("init_args") if isinstance(entry, Mapping) else None
    if not isinstance(found, Mapping):
        raise InputError(f"{what}: has no 'init_args'")
    return dict(found)


def _number(settings: Mapping[str, Any], key: str, name: str) -> float:
    value = settings.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{name}: {key}: {value!r}; allowed: a number")
    return float(value)
