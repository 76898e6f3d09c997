"""Writes field_curves_optiland.json: field curves, lateral colour and MTF of the Cooke triplet.

By Optiland 0.6.3, with rays aimed at the real stop.  Run with a Python that has Optiland, from this
folder; it takes a minute.  Nothing of dolens is used.  The lens is the source's
(`conf/lens/cooke_triplet.yaml`), its indices by the two-term formula between lines C, d and F, the
object at infinity.  Optiland writes field curvature as the distance along z from the sensor to
where rays 1e-5 of the pupil beside the chief ray meet it, distortion in percent of f·tan θ with its
own linear scale near the axis, and the MTF on the axis by a Fourier transform of the pupil.
"""

import json
from importlib.metadata import version

import numpy as np
from optiland.analysis import Distortion, FieldCurvature
from optiland.materials import IdealMaterial
from optiland.mtf import FFTMTF
from optiland.optic import Optic
from optiland.physical_apertures import RadialAperture

LINES = {"C": 0.6562725, "d": 0.5875618, "F": 0.4861327}  # µm
# radius, thickness, (nd, Vd) or None for air
SURFACES = [
    (22.014, 3.259, (1.6204, 60.31)),
    (-435.760, 6.008, None),
    (-22.213, 1.000, (1.6200, 36.37)),
    (20.292, 4.750, None),
    (79.684, 2.952, (1.6204, 60.31)),
    (-18.395, 42.208, None),
]
EDGE = 20.0  # degrees, edge of the field
COUNT = 9
STOP = 2.0 * 3.86


def index(glass, line):
    if glass is None:
        return 1.0
    nd, vd = glass
    squares = {name: 1.0 / (1e3 * wave) ** 2 for name, wave in LINES.items()}
    b = (nd - 1.0) / vd / (squares["F"] - squares["C"])
    return nd + b * (squares[line] - squares["d"])


def triplet(line):
    lens = Optic()
    lens.surfaces.add(index=0, radius=np.inf, thickness=np.inf)
    for number, (radius, thickness, glass) in enumerate(SURFACES, 1):
        lens.surfaces.add(
            index=number,
            radius=radius,
            thickness=thickness,
            material=IdealMaterial(n=index(glass, line)),
            is_stop=number == 4,
            aperture=RadialAperture(r_max=0.5 * STOP) if number == 4 else None,
        )
    lens.surfaces.add(index=7)
    lens.set_aperture(aperture_type="float_by_stop_size", value=STOP)
    lens.fields.set_type(field_type="angle")
    lens.fields.add(y=0.0)
    lens.fields.add(y=EDGE)
    lens.wavelengths.add(value=LINES[line], is_primary=True)
    lens.ray_tracer.set_aiming("iterative", 50, 1e-10)
    return lens


def chief_heights(line):
    lens = triplet(line)
    heights = []
    for share in np.linspace(0.0, 1.0, COUNT):
        lens.trace_generic(0.0, float(share), 0.0, 0.0, wavelength=LINES[line])
        heights.append(float(lens.surfaces.y[-1, 0]))
    return heights


lens = triplet("d")
curvature = FieldCurvature(lens, num_points=COUNT).data[0]
distortion = Distortion(lens, num_points=COUNT).data[0]
mtf = FFTMTF(lens, fields=[(0.0, 0.0)], num_rays=256, max_freq=200.0)
frequency = np.asarray(mtf.freq).reshape(-1)
kept = frequency[: len(mtf.mtf[0][0])] <= 200.0
heights = {line: chief_heights(line) for line in LINES}
table = {
    "origin": f"Optiland {version('optiland')}, tests/reference/field_curves_optiland.py",
    "field_deg": np.linspace(0.0, EDGE, COUNT).tolist(),
    "tangential_mm": np.asarray(curvature[0]).tolist(),
    "sagittal_mm": np.asarray(curvature[1]).tolist(),
    "distortion_percent": np.asarray(distortion).tolist(),
    "chief_height_mm": heights,
    "frequency_per_mm": frequency[: len(kept)][kept][::4].tolist(),
    "axial_mtf": np.asarray(mtf.mtf[0][0])[kept][::4].tolist(),
}
with open("field_curves_optiland.json", "w") as file:
    json.dump(table, file, indent=1)
    file.write("\n")
