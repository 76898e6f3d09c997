"""A table of what the source of a lens publishes, beside what its prescription gives."""

import math

import torch

from dolens.analysis.conditions import Conditions
from dolens.analysis.first_order_numbers import first_order_numbers
from dolens.lens_page.tables import Table, number
from dolens.optics.lens import Lens
from dolens.optics.published import Published

# Attribute of `Published` → name of the quantity and its unit.
_ROWS = {
    "efl": ("effective focal length", "mm"),
    "f_number": ("F-number", ""),
    "na": ("numerical aperture, image", ""),
    "object_na": ("numerical aperture, object", ""),
    "entrance_pupil_diameter": ("entrance pupil diameter", "mm"),
    "half_field": ("half field", "°"),
    "image_height": ("image height", "mm"),
    "object_height": ("object height", "mm"),
    "bfd": ("back focal distance", "mm"),
    "length": ("length of the lens", "mm"),
    "track": ("total track", "mm"),
    "magnification": ("magnification", ""),
}


@torch.no_grad()
def published_table(lens: Lens, where: Conditions) -> Table:
    """Return the published numbers of a lens, and the same quantities computed at its conditions.

    Fields are not computed: the fields of the lens are those that it is used with.  The focal
    length is compared without its sign, which is negative behind an intermediate image.

    Args:
        lens: a lens whose `published` is not None.
        where: its conditions.
    """
    published = lens.published or Published()
    found = first_order_numbers(lens, where.reference_wavelength, where.object_distance)
    computed = {
        "efl": abs(found.efl),
        "f_number": abs(found.f_number),
        "na": abs(0.5 / found.working_f_number),
        "entrance_pupil_diameter": found.entrance_pupil_diameter,
        "bfd": found.bfd,
        "length": found.length,
        "track": found.total_track,
        "magnification": found.magnification,
    }
    if where.object_distance is not None:
        # The paraxial marginal ray has n·u = m·n'·u'; the aperture is a sine.
        n = float(lens.materials[0].index(where.reference_wavelength))
        slope = abs(found.magnification * computed["na"]) / n
        computed["object_na"] = n * math.sin(math.atan(slope))
    rows = []
    for key, (name, unit) in _ROWS.items():
        value = getattr(published, key)
        if value is None:
            continue
        said = number(value, 7)
        if key == "efl" and published.efl_tolerance is not None:
            said += f" ± {number(published.efl_tolerance, 3)}"
        rows.append((name, said, number(computed[key], 7) if key in computed else "", unit))
    parts = [published.kind, lens.source, published.note]
    caption = ". ".join(part.strip().rstrip(".") for part in parts if part)
    return Table(
        ("quantity", "published", "computed", "unit"),
        rows,
        caption[:1].upper() + caption[1:] + "." if caption else "",
        frozenset({0, 3}),
    )
