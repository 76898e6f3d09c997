"""Writes zernike_optiland.json: Zernike coefficients of the Cooke triplet by Optiland 0.6.3.

Run with a Python that has Optiland, from this folder; it takes half a minute.  Nothing of dolens is
used but the lens of wavefront_optiland.py.  Rays are aimed at the stop, whose rim is the disc's:
the diameter of the entrance pupil is such that the real marginal ray meets it at 3.86 mm.  The
sphere is about the chief ray's point; coefficients are in waves, in Optiland's signs.
"""

import json
from importlib.metadata import version

import numpy as np
from optiland.wavefront import ZernikeOPD
from wavefront_optiland import WAVELENGTH, triplet

STOP, TERMS = 3.86, 37  # mm


def aimed(field):
    """The lens whose real marginal ray meets the rim of the stop, as Optiland's aiming has it."""
    diameter, height = 10.0, 0.0
    while abs(height - STOP) > 1e-9:
        lens = triplet(field, np.inf)
        lens.set_aperture(aperture_type="EPD", value=diameter)
        lens.set_ray_aiming("robust")
        lens.trace_generic(0.0, 0.0, 0.0, 1.0, WAVELENGTH)
        height = float(np.ravel(lens.surfaces.y)[4])
        diameter *= STOP / height
    return lens, diameter


def main():
    cases = []
    for field in (0.0, 14.0, 20.0):
        lens, diameter = aimed(field)
        row = {"field": field, "entrance_pupil_diameter": diameter}
        for order, kind in (("fringe", "fringe"), ("standard", "noll")):
            fit = ZernikeOPD(
                *(lens, (0.0, field / 20.0), WAVELENGTH),
                num_rings=48,
                zernike_type=kind,
                num_terms=TERMS,
            )
            row[order] = np.round(np.asarray(fit.coeffs), 8).tolist()
        cases.append(row)
    document = {
        "program": f"Optiland {version('optiland')}",
        "wavelength_nm": 1e3 * WAVELENGTH,
        "cases": cases,
    }
    with open("zernike_optiland.json", "w") as file:
        json.dump(document, file, indent=1)
        file.write("\n")


if __name__ == "__main__":
    main()
