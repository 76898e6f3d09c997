"""A design of a search becomes a lens with a prescription."""

from typing import Any

import torch
from torch import Tensor

from dolens.lens_search.arrangement import AIR, STOP, Arrangement, asphere
from dolens.lens_search.lens_merit import with_glasses_of
from dolens.lens_search.merit import SearchMerit
from dolens.lens_search.real_pupils import stop_radii, with_real_beams
from dolens.lens_search.specification import Specification
from dolens.optics.lens import Lens
from dolens.prescriptions.build import lens_from_prescription

# Edges of elements over the height of the beam.  A polynomial may turn steeply where no ray passes,
# and where light may be vignetted the edges are what clips it.
_MARGIN, _TIGHT = 1.05, 1.005


def designed_lens(
    arrangement: Arrangement, specification: Specification, values: Tensor, name: str
) -> Lens:
    """Return a design as a lens with a stop that limits the beam, fields and wavelengths.

    The stop's semi-diameter is that of the axial beam at the reference wavelength, by a real ray.
    Other apertures pass the whole beam with some room.

    Args:
        arrangement: the order of its elements.
        specification: what it is for.
        values: u, (P,).
        name: of the lens.
    """
    specification = with_glasses_of(arrangement, specification, values)
    values = values[: arrangement.variables]
    f = specification.focal_length
    merit = SearchMerit.of(arrangement, specification, 1, 1)
    numbers, found = merit.first_order(values[None])
    radius = 0.5 * f / specification.f_number
    field = max(float(t) for t in merit.rays.tangent) * f
    zero = torch.zeros(1, dtype=torch.float64)
    conditions = with_real_beams(merit, values[None], merit.full(1))
    stop_radius = float(stop_radii(merit, values[None], conditions)) * f
    surfaces: dict[str, dict[str, Any]] = {}
    gaps = [*(float(gap) * f for gap in numbers.gaps), None]
    media = [*arrangement.gap_media, AIR]
    for place, number in enumerate(arrangement.sequence):
        row: dict[str, Any] = {"type": "aperture"}
        if number == STOP:
            row["semi_diameter"] = stop_radius
        else:
            curvature = float(numbers.curvatures[number]) / f
            height = abs(float(found.marginal[number] + zero)) * radius
            height += abs(float(found.chief[number] + zero)) * field
            height *= float(conditions.beam[0, number])
            row, margin = {"type": "plane"}, _TIGHT if specification.vignetting else _MARGIN
            if arrangement.is_asphere(number):
                margin = _TIGHT
                terms = enumerate(numbers.coefficients[number])
                row = asphere(
                    curvature or 1e-12 / f, [float(a) / f ** (2 * n + 3) for n, a in terms]
                )
            elif curvature != 0.0:
                row = {"type": "sphere", "radius": 1.0 / curvature}
                height = min(height, 0.99 / abs(curvature) / margin)
            row["semi_diameter"] = margin * height
        if gaps[place] is not None:
            row["thickness"] = gaps[place]
        medium = media[place]
        row["material"] = "air" if medium == AIR else specification.element_glasses[medium]
        surfaces[str(place + 1)] = row
    image = float(numbers.image) * f
    return lens_from_prescription(
        {
            "name": name,
            "stop": arrangement.stop_place + 1,
            "wavelengths": list(specification.wavelengths),
            "reference_wavelength": specification.wavelengths[specification.reference],
            "fields": {"angles": [[0.0, float(angle)] for angle in specification.fields]},
            "surfaces": surfaces,
            "sensor": {"distance": image, "diameter": 2.2 * field},
        },
        dtype=torch.float64,
        where=name,
    )
