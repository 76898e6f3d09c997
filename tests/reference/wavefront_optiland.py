"""Writes wavefront_optiland.json: wavefronts and PSFs of the Cooke triplet by Optiland 0.6.3.

Run with a Python that has Optiland, from this folder; it takes three minutes.  Nothing of dolens is
used.  The lens is the source's (`conf/lens/cooke_triplet.yaml`) at 587.5618 nm, where the indices
are nd, with every surface clipped at its semi-diameter and more rays than pass.  The objects are at
infinity at three fields, and a point 5 m before the first vertex.

OPD is in waves, of the chief ray less the ray, on a sphere about where Optiland's chief ray lands
(not aimed: through the centre of the paraxial entrance pupil), whose radius reaches to the paraxial
exit pupil on the axis.  PSFs are its sums over rays, equally weighted, over the largest value; rows
run along +y, columns along +x, about `psf_centre`.
"""

import json
from importlib.metadata import version

import numpy as np
from optiland.materials import IdealMaterial
from optiland.optic import Optic
from optiland.physical_apertures import RadialAperture
from optiland.psf import HuygensPSF
from optiland.wavefront import Wavefront

WAVELENGTH = 0.5875618  # µm
# radius, thickness, nd, semi-diameter; mm
SURFACES = [
    (22.014, 3.259, 1.6204, 9.5),
    (-435.760, 6.008, 1.0, 9.5),
    (-22.213, 1.000, 1.6200, 4.0),
    (20.292, 4.750, 1.0, 3.86),
    (79.684, 2.952, 1.6204, 7.5),
    (-18.395, 42.208, 1.0, 7.5),
]
PIXEL, SIZE = 0.5e-3, 41  # mm


def triplet(field, distance):
    lens = Optic()
    lens.surfaces.add(index=0, radius=np.inf, thickness=distance)
    for number, (radius, thickness, index, semi_diameter) in enumerate(SURFACES, 1):
        lens.surfaces.add(
            index=number,
            radius=radius,
            thickness=thickness,
            material=IdealMaterial(n=index),
            aperture=RadialAperture(r_max=semi_diameter),
            is_stop=number == 4,
        )
    lens.surfaces.add(index=7)
    lens.set_aperture(aperture_type="EPD", value=12.0)
    infinite = np.isinf(distance)
    lens.fields.set_type(field_type="angle" if infinite else "object_height")
    lens.fields.add(y=field)
    # Optiland normalises fields by the largest: without this one a field of zero has no unit.
    lens.fields.add(y=20.0 if infinite else 1500.0)
    lens.wavelengths.add(value=WAVELENGTH, is_primary=True)
    return lens


def case(field, distance):
    lens = triplet(field, distance)
    relative = (0.0, field / (20.0 if np.isinf(distance) else 1500.0))
    front = Wavefront(
        lens, fields=[relative], wavelengths=[WAVELENGTH], num_rays=13, distribution="uniform"
    )
    data = front.get_data(relative, WAVELENGTH)
    passed = np.asarray(data.intensity) > 0.0
    psf = HuygensPSF(lens, relative, WAVELENGTH, num_rays=512, image_size=SIZE, pixel_pitch=PIXEL)
    # Relative to its own peak; Optiland's normalisation is another lens's.
    image = np.asarray(psf.psf)
    return {
        "field": field,
        "object_distance": None if np.isinf(distance) else distance,
        "centre": [float(c) for c in data.reference_center],
        "radius": float(data.radius),
        "sphere_x": np.asarray(data.pupil_x)[passed].tolist(),
        "sphere_y": np.asarray(data.pupil_y)[passed].tolist(),
        "opd_waves": np.asarray(data.opd)[passed].tolist(),
        "psf_centre": [float(np.ravel(psf.cx)[0]), float(np.ravel(psf.cy)[0])],
        "psf": np.round(image / image.max(), 7).tolist(),
    }


def main():
    cases = [case(f, np.inf) for f in (0.0, 14.0, 20.0)] + [case(1000.0, 5000.0)]
    document = {
        "program": f"Optiland {version('optiland')}",
        "wavelength_nm": 1e3 * WAVELENGTH,
        "psf_step_mm": PIXEL * SIZE / (SIZE - 1),
        "cases": cases,
    }
    with open("wavefront_optiland.json", "w") as file:
        json.dump(document, file)


if __name__ == "__main__":
    main()
