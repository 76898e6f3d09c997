"""The sensor of a prescription: where it stands, how large and how curved it is.

::

    sensor: {distance: 96.0, diameter: 1.7664}
    sensor: {distance: 16.4, radius: -12.0, conic: 0}

`distance` is that from the last surface's vertex, mm.  A sensor with a `radius` (mm, of the sign
that a surface's has) is curved: rays end where they meet it.  `diameter` is the image circle.
"""

from collections.abc import Mapping
from typing import Any

from dolens.errors import InputError, check_keys
from dolens.prescriptions.checks import as_number
from dolens.prescriptions.curvatures import curvature_from, curvature_row

SENSOR_KEYS = ("distance", "diameter", "radius", "curvature", "conic")


def sensor_from(prescription: Mapping[str, Any], where: str) -> dict[str, float | None]:
    """Return the arguments of `Lens` that the sensor of a prescription gives.

    Raises:
        InputError: one line that names `where` and the key.
    """
    sensor = prescription.get("sensor")
    if not isinstance(sensor, Mapping) or "distance" not in sensor:
        raise InputError(f"{where}: 'sensor.distance' is missing (mm from the last surface)")
    check_keys(sensor, SENSOR_KEYS, f"{where}: sensor")
    found: dict[str, float | None] = {
        "sensor_distance": as_number(sensor["distance"], f"{where}: 'sensor.distance'"),
        "sensor_diameter": None,
    }
    if sensor.get("diameter") is not None:
        found["sensor_diameter"] = as_number(sensor["diameter"], f"{where}: 'sensor.diameter'")
    if any(sensor.get(key) is not None for key in ("radius", "curvature", "conic")):
        try:
            found["sensor_curvature"] = curvature_from(sensor, "curvature")
        except InputError as error:
            raise InputError(f"{where}: sensor: {error}") from None
    if sensor.get("conic") is not None:
        found["sensor_conic"] = as_number(sensor["conic"], f"{where}: 'sensor.conic'")
    return found


def sensor_row(lens: Any) -> dict[str, float]:
    """Return the sensor of a lens as a prescription writes it."""
    row = {"distance": float(lens.sensor_distance.detach())}
    if lens.sensor_diameter is not None:
        row["diameter"] = lens.sensor_diameter
    if lens.sensor_curvature is not None:
        row |= curvature_row("curvature", float(lens.sensor_curvature.detach()))
    if lens.sensor_conic is not None:
        row["conic"] = float(lens.sensor_conic.detach())
    return row
