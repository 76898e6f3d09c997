"""What a drawing says as text: tolerances, and the numbers of surfaces, glass and elements."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from dolens.errors import InputError, check_keys
from dolens.manufacturing.glass_elements import Face, GlassElement
from dolens.optics.glass_catalog import Glass
from dolens.optics.lens import Lens
from dolens.optics.materials import abbe_number, index_d
from dolens.optics.surfaces.b_spline import BSpline
from dolens.optics.surfaces.clear_aperture import Circle, Ellipse, Rectangle
from dolens.optics.surfaces.conic import Conic
from dolens.optics.surfaces.outlines import Polygons
from dolens.optics.surfaces.xy_polynomial import XYPolynomial
from dolens.prescriptions.files import read_tolerance_file
from dolens.prescriptions.numbers import require_mapping
from dolens.tolerancing.tolerances import Tolerances, tolerances_from

AGREE = "to be agreed"
# What a drawing says that no ray trace needs, in ISO 10110's codes.
SHOP_KEYS = {
    "form": "3/",
    "centring": "4/",
    "imperfections": "5/",
    "coating": "coating",
    "chamfer": "chamfer",
    "stress": "0/",
    "bubbles": "1/",
    "striae": "2/",
    "diameter": "diameter",
    "roughness": "roughness",
}


@dataclass(frozen=True)
class ShopTolerances:
    """Tolerances by parameter and by the shop's keys; what is absent is to be agreed.

    Attributes:
        labels: name of a lens's parameter → (half-range, unit), in mm, degrees or the parameter's
            own unit; for a curvature, the half-range in mm of the radius.
        shop: one of `SHOP_KEYS` → text, for every element.
    """

    labels: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    shop: Mapping[str, str] = field(default_factory=dict)

    def of(self, name: str) -> str:
        """Return a parameter's tolerance as text, such as `± 0.02 mm`, or `to be agreed`."""
        if name not in self.labels:
            return AGREE
        number, unit = self.labels[name]
        return f"± {number:.3g}{unit if unit == '°' else f' {unit}'}".strip()

    def said(self, key: str) -> str:
        """Return what a drawing says under a key of `SHOP_KEYS`, or `to be agreed`."""
        return self.shop.get(key, AGREE)

    @property
    def complete(self) -> bool:
        """Return whether nothing that a drawing needs is left to be agreed."""
        return bool(self.labels) and all(key in self.shop for key in SHOP_KEYS)


def read_tolerances(lens: Lens, path: str) -> tuple[Lens, ShopTolerances]:
    """Read tolerances for the drawings of a lens from a YAML file.

    Args:
        lens: stays as it is.
        path: see `read_tolerance_file`; its `drawing` maps the keys of `SHOP_KEYS` to text.

    Returns:
        A lens with the file's elements, and the tolerances.

    Raises:
        InputError: one line that names the file and the key.
    """
    drawn, content, _ = read_tolerance_file(lens, path)
    shop = content.get("drawing") or {}
    require_mapping(shop, f"{path}: drawing")
    check_keys(shop, SHOP_KEYS, f"{path}: drawing")
    labels = {}
    if content.get("tolerances"):
        try:
            factor = content.get("tolerance_factor", 1.0)
            labels = drawn_labels(tolerances_from(drawn, content["tolerances"], factor))
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
    known = ShopTolerances(labels, {key: str(value) for key, value in shop.items()})
    return drawn.requires_grad_(False), known


def drawn_labels(tolerances: Tolerances) -> dict[str, tuple[float, str]]:
    """Return half-ranges as drawings give them: of radii in place of curvatures, ΔR = Δc/c²."""
    found: dict[str, tuple[float, str]] = {}
    columns: list[Any] = [tolerances.nominal, tolerances.half_range, tolerances.steps]
    for name, unit, *numbers in zip(
        tolerances.names, tolerances.unit_names, *(c.tolist() for c in columns), strict=True
    ):
        nominal, half_range, step = numbers
        if name.endswith(".curvature"):
            if nominal != 0.0:
                found[name] = (abs(step) / nominal**2, "mm")
            else:
                found[name] = (abs(step), "1/mm")
        elif unit == "deg":
            found[name] = (half_range, "°")
        elif unit == "%":
            found[name] = (100.0 * half_range, "%")
        else:
            found[name] = (half_range, unit)
    return found


_EVEN = re.compile(r"a\d+")
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

_CONIC = r"\dfrac{r^2/R}{1+\sqrt{1-(1+k)\,r^2/R^2}}"
_POWERS = r"+\sum_i a_i\,r^i"
_ZERNIKE = f"$z={_CONIC}{_POWERS}" + r"+\sum_j z_j\,Z_j(\rho,\varphi)$"
EQUATIONS = {
    "conic": f"$z={_CONIC}$",
    "asphere": f"$z={_CONIC}{_POWERS}$",
    "polynomial": r"$z=\sum_{ij} a_{ij}\,x^i y^j$",
    "implicit": r"$z=\sum_{ij} a_{ij}\,x^i y^j+b\,z^2$",
    "odd_asphere": f"$z={_CONIC}{_POWERS}$",
    "biconic": r"$z=\dfrac{x^2/R_x+y^2/R_y}{1+\sqrt{1-(1+k_x)\,x^2/R_x^2-(1+k_y)\,y^2/R_y^2}}$",
    "toroid": r"$z=f(y)+\dfrac{x^2/R_x}{g+\sqrt{g^2-x^2/R_x^2}},\quad g=1-f(y)/R_x$",
    "zernike_standard": _ZERNIKE,
    "zernike_fringe": _ZERNIKE,
    "q_con": f"$z={_CONIC}" + r"+u^4\sum_m q_m\,Q_m^{\mathrm{con}}(u^2)$",
    "q_bfs": r"$z=z_k(r)+\dfrac{u^2(1-u^2)}{\cos\psi}\sum_m q_m\,Q_m^{\mathrm{bfs}}(u^2)$",
}
# Numbers of a surface that are no coefficients, and their symbols on a drawing.
_SYMBOLS = {"conic": "k", "conic_x": "k_x", "conic_y": "k_y"}
_LENGTHS = {
    "normalization_radius": "norm. radius",
    "decenter_x": "decentre x",
    "decenter_y": "decentre y",
}
# What an equation leaves to words.
_MEANINGS = {
    "toroid": ("f(y)", "conic of Ry and k_y, plus Σ a_i·yⁱ"),
    "zernike_standard": ("Z", "Zernike polynomials, Noll's order and norm"),
    "zernike_fringe": ("Z", "Zernike polynomials, fringe order"),
    "q_con": ("Q", "Forbes 2007, u = r/norm. radius"),
    "q_bfs": ("Q, ψ", "Forbes 2007; ψ: slope of z_k, conic of R, k"),
    "grid_sag": ("grid", "in the design's YAML file"),
}


def length(value: float, least: int = 3, most: int = 6) -> str:
    """Return a length in mm, with three to six decimals; a minus is a minus sign."""
    text = number(value, most).rstrip("0")
    whole, _, decimals = text.partition(".")
    return f"{whole}.{decimals.ljust(least, '0')}"


def number(value: float, decimals: int) -> str:
    """Return a number with its decimals; a minus is a minus sign, and zero has none."""
    text = f"{value:.{decimals}f}"
    return text.replace("-", "" if float(text) == 0.0 else "−")


def coefficient(value: float) -> str:
    """Return a coefficient with nine digits at most: `2e−06`, `1.23456789e−06`."""
    return f"{value:.9g}".replace("-", "−")


def radius_text(face: Face, is_front: bool) -> str:
    """Return `R 22.014 CX`, `R ∞ (plane)`, or what the surface is where it has no radius.

    The radius is a magnitude: CX (convex) bulges out of the glass, CC (concave) into it.
    """
    if face.flat:
        return "R ∞ (plane)"
    if "curvature_x" in face.parameters and "curvature_y" in face.parameters:
        return ", ".join(_one_radius(face, f"_{axis}", is_front) for axis in "xy")
    if "curvature" not in face.parameters:
        kind = "cubic B-spline" if issubclass(face.shape, BSpline) else face.shape.kind
        return f"freeform: {kind.replace('_', ' ')}"
    text = _one_radius(face, "", is_front)
    return "R ∞, aspheric" if text == "R ∞" else text


def _one_radius(face: Face, suffix: str, is_front: bool) -> str:
    """Return `R 22.014 CX`, `Rx ∞`, ... of the curvature with this suffix."""
    curvature = float(face.parameters[f"curvature{suffix}"])
    name = f"R{suffix[1:]}"
    if curvature == 0.0:
        return f"{name} ∞"
    convex = (curvature > 0.0) == is_front
    return f"{name} {length(abs(1.0 / curvature))} {'CX' if convex else 'CC'}"


def signed_radius(face: Face) -> str:
    """Return the radius with its sign, positive where the centre lies towards +z, or the kind."""
    if face.flat:
        return "∞"
    if "curvature" not in face.parameters:
        return "freeform"
    c = float(face.parameters["curvature"])
    return (length(1.0 / c) if c else "∞") + (" asphere" if is_aspheric(face) else "")


def is_aspheric(face: Face) -> bool:
    """Return whether a surface is neither a plane nor a sphere."""
    if face.flat:
        return False
    further = [p for name, p in face.parameters.items() if name != "curvature"]
    return not issubclass(face.shape, Conic) or any(bool((p != 0.0).any()) for p in further)


def equation(face: Face) -> str | None:
    """Return the equation of an aspheric surface's sag as mathematical text, or None."""
    if not is_aspheric(face):
        return None
    if issubclass(face.shape, XYPolynomial):
        return EQUATIONS["implicit" if "b" in face.parameters else "polynomial"]
    if issubclass(face.shape, Conic):
        higher = any(_EVEN.fullmatch(name) and float(p) for name, p in face.parameters.items())
        return EQUATIONS["asphere" if higher else "conic"]
    return EQUATIONS.get(face.shape.kind)


def coefficient_rows(face: Face) -> list[tuple[str, str]]:
    """Return name and value of what shapes an aspheric surface, beside its radius."""
    if not is_aspheric(face):
        return []
    rows = []
    for name, symbol in (("curvature", "R"), ("curvature_x", "Rx"), ("curvature_y", "Ry")):
        c = float(face.parameters.get(name, 0.0))
        side = "towards +z" if c > 0.0 else "towards −z"
        if c:
            rows.append((f"{symbol}, signed", f"{length(1.0 / c)} mm ({side})"))
    for name, value in face.parameters.items():
        if name.startswith(("curvature", "spacing")) or value.dim() > 0:
            continue
        symbol = _SYMBOLS.get(name, name)
        if name in _SYMBOLS:
            rows.append((symbol, length(float(value))))
            continue
        if name in _LENGTHS:
            rows.append((_LENGTHS[name], f"{length(float(value))} mm"))
            continue
        power = _power(name)
        raised = "" if power == 1 else str(power).translate(_RAISED)
        unit = f" mm{raised}" if power != 0 else ""
        rows.append((symbol, coefficient(float(value)) + unit))
    if issubclass(face.shape, BSpline):
        count = "×".join(map(str, face.parameters["coefficients"].shape))
        rows.append(("coefficients", f"{count}, in the design's YAML file"))
    if face.shape.kind in _MEANINGS:
        rows.append(_MEANINGS[face.shape.kind])
    return rows


def clear_aperture_text(face: Face) -> str:
    """Return the clear aperture: `Ø 19.000`, or the sides of a rectangle."""
    edge = face.aperture.edge
    text = (
        f"{length(2.0 * edge.half_width_x)} × {length(2.0 * edge.half_width_y)}"
        if isinstance(edge, Rectangle)
        else f"ellipse {length(2.0 * edge.semi_axis_x)} × {length(2.0 * edge.semi_axis_y)}"
        if isinstance(edge, Ellipse)
        else edge.words(length)
        if isinstance(edge, Polygons)
        else f"Ø {length(2.0 * edge.semi_diameter)}"
    )
    obscured = face.aperture.obscuration
    if obscured is None:
        return text
    if isinstance(obscured, Circle):
        return f"{text}, obscured to Ø {length(2.0 * obscured.semi_diameter)}"
    return f"{text}, obscured"


def surface_rows(
    element: GlassElement, is_front: bool, tolerances: ShopTolerances
) -> list[tuple[str, str]]:
    """Return the rows of a surface's column: name and text."""
    face = element.front if is_front else element.back
    rows = [("", radius_text(face, is_front))]
    if "curvature" in face.parameters:
        name = f"surfaces.{face.number}.curvature"
        rows.append(("ΔR" if not face.flat else "Δ(1/R)", tolerances.of(name)))
    rows += coefficient_rows(face)
    rows.append(
        (
            "Øe" if not isinstance(face.aperture.edge, Rectangle) else "clear",
            clear_aperture_text(face).removeprefix("Ø "),
        )
    )
    cemented = element.cemented[0 if is_front else 1]
    rows += [
        ("chamfer", tolerances.said("chamfer")),
        ("coating", "cemented" if cemented else tolerances.said("coating")),
        ("3/ form", tolerances.said("form")),
        ("4/ centring", tolerances.said("centring")),
        ("5/ imperfections", tolerances.said("imperfections")),
    ]
    if is_aspheric(face):
        rows.append(("roughness", tolerances.said("roughness")))
    return rows


def material_rows(element: GlassElement, tolerances: ShopTolerances) -> list[tuple[str, str]]:
    """Return the rows of the glass's column: name, maker, nd, Vd, code, and quality."""
    medium = element.material
    nd, vd = index_d(medium), abbe_number(medium)
    if isinstance(medium, Glass):
        maker, _, name = medium.name.partition(":")
        rows = [("glass", name), ("maker", maker)]
    else:
        rows = [("glass", medium.name), ("maker", f"glass of these nd, Vd: {AGREE}")]
    rows += [("nd", f"{nd:.5f}"), ("Vd", "∞" if math.isinf(vd) else f"{vd:.2f}")]
    if not math.isinf(vd) and nd < 2.0:
        rows.append(("code", f"{round(1000 * (nd - 1.0)):03d}{round(10 * vd):03d}"))
    return [
        *rows,
        ("0/ stress", tolerances.said("stress")),
        ("1/ bubbles", tolerances.said("bubbles")),
        ("2/ striae", tolerances.said("striae")),
    ]


def sag_rows(face: Face, count: int = 13) -> list[tuple[str, str, str]]:
    """Return r, sag (mm) and slope (degrees) of a rotational asphere, from vertex to aperture.

    The distances r are round numbers, about `count` of them, and the aperture's edge.
    """
    edge = face.semi_diameter
    ticks = MaxNLocator(count - 1, steps=[1, 2, 2.5, 5, 10]).tick_values(0.0, edge)
    steps = np.asarray(ticks)
    steps = steps[steps >= 0.0]
    r = np.append(steps[steps < edge - 0.2 * (steps[1] - steps[0])], edge)
    sag, slope, _, _ = face.sag_and_slopes(r, np.zeros_like(r))
    return [
        (length(a), length(b, 6), number(math.degrees(math.atan(c)), 4))
        for a, b, c in zip(r, sag, slope, strict=True)
    ]


def sag_grid(face: Face, count: int = 7) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, y (mm) and the sag (mm) on a grid over a freeform's aperture, NaN outside it."""
    half_x, half_y = face.aperture.edge.extent
    x, y = np.meshgrid(np.linspace(-half_x, half_x, count), np.linspace(-half_y, half_y, count))
    sag = face.sag(x, y)
    if not isinstance(face.aperture.edge, Rectangle):
        sag = np.where(np.hypot(x, y) <= face.semi_diameter * (1.0 + 1e-12), sag, np.nan)
    return x[0], y[:, 0], sag


def _power(name: str) -> int:
    """Return the power of mm that a coefficient's unit has: 1 less the powers of its lengths."""
    if name == "b":
        return -1
    if _EVEN.fullmatch(name):
        return 1 - int(name[1:])
    total = 0
    for part in re.findall(r"[xy]\d*", name):
        total += int(part[1:] or 1)
    return 1 - total
