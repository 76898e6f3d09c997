"""Fields of a prescription: points of the object or of the image, their weights and vignetting."""

from collections.abc import Sequence
from typing import Any

import torch

from dolens.errors import InputError, check_keys
from dolens.optics.field_and_aperture import heights_of_pupil_angles, object_fields
from dolens.optics.fields import Fields, Vignetting
from dolens.optics.lens import Lens
from dolens.optics.paraxial import vergence
from dolens.prescriptions.checks import as_number, require_mapping

_FIELD_KINDS = ("angles", "heights", "pupil_angles", "image_heights", "real_image_heights")
_ANGLES = ("angles", "pupil_angles")
# Kinds of field points on the image, and whether real rays decide.
_BY_THE_IMAGE = {"image_heights": False, "real_image_heights": True}


def fields_from(value: Any, place: str) -> Fields | None:
    """Read the fields of a prescription, of any kind; None where it has none.

    Raises:
        InputError: one line that names the key.
    """
    if value is None:
        return None
    require_mapping(value, place)
    check_keys(value, (*_FIELD_KINDS, "weights", "vignetting"), place)
    kinds = [kind for kind in _FIELD_KINDS if value.get(kind) is not None]
    if len(kinds) != 1:
        raise InputError(
            f"{place}: give one of 'angles', 'pupil_angles' (degrees), 'heights', 'image_heights' "
            "and 'real_image_heights' (mm)"
        )
    kind, points = kinds[0], value[kinds[0]]
    shape = f"{place}: '{kind}' must be a list of points [x, y]"
    if not isinstance(points, list | tuple) or not points:
        raise InputError(f"{shape}, not {points!r}")
    found = []
    for point in points:
        if not isinstance(point, list | tuple) or len(point) != 2:
            raise InputError(f"{shape}, not {point!r}")
        x, y = (as_number(entry, f"{place}: '{kind}'") for entry in point)
        # Beyond 90° in x and y at once there is no convention of which direction is meant.
        limit = 180.0 if kind == "angles" and 0.0 in (x, y) else 90.0
        if kind in _ANGLES and max(abs(x), abs(y)) >= limit:
            along = "" if kind == "pupil_angles" else " (180 along x or y alone)"
            raise InputError(f"{place}: '{kind}' must be below 90 degrees{along}, not {point!r}")
        found.append((x, y))
    weights, vignetting = value.get("weights"), value.get("vignetting")
    if weights is not None:
        weights = tuple(weights_from(weights, len(found), f"{place}: 'weights'"))
    if vignetting is not None:
        if not isinstance(vignetting, list | tuple) or len(vignetting) != len(found):
            raise InputError(f"{place}: 'vignetting' must be a list of {len(found)}, one a field")
        vignetting = tuple(_vignetting(one, f"{place}: 'vignetting'") for one in vignetting)
    return Fields(kind, tuple(found), weights, vignetting)


def _vignetting(value: Any, place: str) -> Vignetting:
    require_mapping(value, place)
    check_keys(value, Vignetting._fields, place)
    found = Vignetting(
        **{key: as_number(entry, f"{place}: '{key}'") for key, entry in value.items()}
    )
    if max(found.compression_x, found.compression_y) >= 1.0:
        raise InputError(f"{place}: compressions must be below 1, which leaves no light")
    return found


def weights_from(value: Any, count: int, place: str) -> list[float]:
    """Read as many weights: numbers that are not negative, of any positive sum."""
    if not isinstance(value, list | tuple) or len(value) != count:
        raise InputError(f"{place} must be a list of {count} numbers")
    found = [as_number(entry, place) for entry in value]
    if min(found) < 0.0 or not any(found):
        raise InputError(f"{place} must not be negative, and not all zero")
    return found


def unequal_weights(values: Sequence[float], count: int, place: str) -> list[float] | None:
    """Return the weights that a file gives its first `count` wavelengths or fields; None where it
    gives none, or all are the same.

    Raises:
        InputError: too few, a negative one, or zeros alone; the message begins with the place.
    """
    if not values:
        return None
    if len(values) < count:
        raise InputError(f"{place} gives {len(values)} weights for {count}")
    found = weights_from(list(values[:count]), count, place)
    return found if len(set(found)) > 1 else None


def field_rows(fields: Fields) -> dict[str, Any]:
    """Return the mapping that `fields_from` reads back."""
    rows: dict[str, Any] = {fields.kind: [list(point) for point in fields.points]}
    if fields.weights is not None:
        rows["weights"] = list(fields.weights)
    if fields.vignetting is not None:
        rows["vignetting"] = [
            {key: value for key, value in one._asdict().items() if value}
            for one in fields.vignetting
        ]
    return rows


def set_object_fields(lens: Lens) -> Lens:
    """Give a new lens the fields of the object that belong to those of its prescription.

    Raises:
        InputError: the lens forms no image, or no chief ray lands there, or the entrance pupil is
            at infinity.
    """
    fields = lens.fields
    if fields is None or fields.kind in ("angles", "heights"):
        return lens
    kind = "angles" if vergence(lens.object_distance) == 0.0 else "heights"
    points = torch.tensor(fields.points, dtype=torch.float64)
    if fields.kind in _BY_THE_IMAGE:
        points = object_fields(lens, points, _BY_THE_IMAGE[fields.kind])
    elif kind == "heights":
        points = heights_of_pupil_angles(lens, points)
    lens.fields = fields._replace(kind=kind, points=tuple((x, y) for x, y in points.tolist()))
    return lens
