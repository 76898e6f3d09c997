"""Numbers of Zemax's listings of Huygens point spread functions at 532 nm, which the authors of
DeepWaveOptics (ICCV 2025) published beside their own (github.com/JerryHoTaiwan/DeepWaveOptics,
benchmarks/reference, 2025-01-27 and 2025-02-04).
"""

import math

import pytest
import torch

from dolens import Rays
from dolens.analysis.conditions import conditions
from dolens.diffraction.point_spread import point_spread
from dolens.prescriptions import lens_from_prescription


@pytest.mark.parametrize(("field", "height"), [(35.0, 27.2045324), (40.0, 34.8598109)])
def test_the_chief_ray_of_a_singlet_meets_the_sensor_where_the_listing_says(field, height):
    """Towards the centre of the paraxial entrance pupil; eight digits are listed."""
    front = {"type": "sphere", "radius": 8.0, "semi_diameter": 7.9, "thickness": 3.0}
    back = {"type": "sphere", "radius": 12.0, "semi_diameter": 7.0, "material": "air"}
    lens = lens_from_prescription(
        {"stop": 2, "surfaces": {"1": {**front, "material": "N-BK7"}, "2": back},
         "sensor": {"distance": 30.0}}
    )  # fmt: skip
    index = float(lens.materials[1].index(532.0))
    pupil = 1.0 / (index / 3.0 - (index - 1.0) / 8.0)
    angle = math.radians(field)
    start = torch.tensor([0.0, -pupil * math.tan(angle), 0.0], dtype=torch.float64)
    way = torch.tensor([0.0, math.sin(angle), math.cos(angle)], dtype=torch.float64)
    with torch.no_grad():
        met = lens.trace(Rays(start, way, 532.0)).position
    assert float(met[1]) == pytest.approx(height, abs=3e-6)


def test_a_triplet_in_focus_has_the_strehl_ratio_of_the_listing():
    radii = [22.02643118, -434.782599, -22.22222134, 20.28397563, 79.99999881, -18.38235270]
    gaps = [3.259000063, 6.008000136, 1.0, 4.868000031, 2.951999664]
    media = ["SCHOTT:SK16", "air", "SCHOTT:F2", "air", "SCHOTT:SK16", "air"]
    rows = {
        str(n): {"type": "sphere", "radius": radius, "semi_diameter": 7.5, "material": medium}
        for n, (radius, medium) in enumerate(zip(radii, media, strict=True), 1)
    }
    for n, gap in enumerate(gaps, 1):
        rows[str(n)]["thickness"] = gap
    rows["1"]["semi_diameter"] = 1.5
    lens = lens_from_prescription(
        {"stop": 1, "wavelengths": [532], "surfaces": rows, "sensor": {"distance": 42.352025986}}
    )
    found = point_spread(lens, conditions(lens, [[0.0, 0.0]], [532.0]))
    assert float(found.strehl_ratio) == pytest.approx(0.999, abs=5e-4)
