"""Tolerances as a drawing gives them: those of a tolerance analysis, and the shop's own."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from dolens.errors import InputError, check_keys
from dolens.optics.lens import Lens
from dolens.prescriptions.numbers import require_mapping
from dolens.tolerancing.tolerances import Tolerances, read_tolerance_file, tolerances_from

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
