"""The media of a prescription: the materials of its rows, its surroundings, and what expands."""

from collections.abc import Mapping
from typing import Any

from dolens.errors import InputError
from dolens.optics.glass import Environment, Glass
from dolens.optics.materials import IndexModel, Medium, index_model, parse_material
from dolens.prescriptions.checks import as_number

# 1e-6/K: of the mount of the air gap behind a surface, or of glass whose catalogue does not say.
EXPANSION_KEY = "thermal_expansion"


def environment_of(prescription: Mapping[str, Any], where: str) -> Environment | None:
    """Return the temperature and pressure that a prescription gives; None where it gives neither.

    Raises:
        InputError: they are no numbers, or impossible.
    """
    given = {
        key: as_number(prescription[key], f"{where}: '{key}'")
        for key in ("temperature", "pressure")
        if prescription.get(key) is not None
    }
    try:
        return Environment(**given) if given else None
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def medium_of(value: object, model: IndexModel, place: str, air: Environment | None) -> Medium:
    """Return the medium that a row names, at the prescription's temperature and pressure.

    Raises:
        InputError: there is none, or it is no medium.
    """
    if value is None:
        raise InputError(f"{place}: 'material' is missing (the medium behind the surface)")
    try:
        return parse_material(str(value), model, air)
    except InputError as error:
        raise InputError(f"{place}: {error}") from None


def expansion_of(row: Mapping[str, Any], medium: Medium, place: str) -> float | None:
    """Return the thermal expansion (1e-6/K) that a row gives, or None.

    Raises:
        InputError: it is no number, or the medium behind the surface has one in its catalogue.
    """
    rate = row.get(EXPANSION_KEY)
    if rate is None:
        return None
    own = catalogue_expansion(medium)
    if own is not None:
        raise InputError(
            f"{place}: '{EXPANSION_KEY}' is that of a mount, or of glass whose catalogue does not "
            f"say; {medium.name} has {1e6 * own:g} there"
        )
    return as_number(rate, f"{place}: '{EXPANSION_KEY}'")


def catalogue_expansion(medium: Medium) -> float | None:
    """Return the thermal expansion (1/K) that a medium's catalogue gives, or None."""
    return medium.expansion if isinstance(medium, Glass) else None


def canonical(material: str) -> str:
    """Return one name for a medium in another program's file, in which `occluder` is air; unchanged
    if none.
    """
    try:
        name = parse_material(material, index_model("dfc")).name
    except InputError:
        return material
    return "air" if name == "occluder" else name


def canonical_digits(material: str) -> str:
    """Return the same, with the numbers of nd/Vd and nd/Vd/ΔPgF as their shortest digits."""
    name = canonical(material)
    parts = name.split("/")
    try:
        return "/".join(repr(float(part)) for part in parts) if len(parts) > 1 else name
    except ValueError:
        return name
