"""Lenses from the rows of their surfaces."""

from dolens import Lens
from dolens.prescriptions import lens_from_prescription

GLASS = "1.5168/64.17"


def prescription_of_rows(*rows, semi_diameter=5.0, sensor=50.0, **keys) -> dict:
    """Return a prescription of surfaces, one after the other.

    Args:
        rows: of each surface its keys, or its radius, the gap behind it in mm and the medium there;
            one whose radius is None is an aperture.
        semi_diameter: of those that give none, mm.
        sensor: distance from the last surface, mm, or the keys of the sensor.
        **keys: of the lens.
    """
    surfaces = {}
    for number, row in enumerate(rows, 1):
        if not isinstance(row, dict):
            radius, thickness, material = row
            shape = {"type": "aperture"} if radius is None else {"type": "sphere", "radius": radius}
            row = shape | {"thickness": thickness, "material": material}
        if number == len(rows):
            row = {key: value for key, value in row.items() if key != "thickness"}
        surfaces[str(number)] = {"semi_diameter": semi_diameter, "material": "air", **row}
    sensor = sensor if isinstance(sensor, dict) else {"distance": sensor}
    return {"surfaces": surfaces, "sensor": sensor} | keys


def lens_of_rows(*rows, **keys) -> Lens:
    """Return the lens of `prescription_of_rows`, without gradients."""
    return lens_from_prescription(prescription_of_rows(*rows, **keys)).requires_grad_(False)
