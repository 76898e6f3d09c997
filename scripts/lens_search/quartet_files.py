"""Candidates of the quartet from and to lens files of dolens, without dolens."""

from pathlib import Path

import numpy as np
import yaml

from lens_search.plain_lens import PlainLens, entrance_pupil, read
from lens_search.plain_trace import Array
from lens_search.quartet import ANGLES, F_NUMBER, FOCAL_LENGTH, INDEX


def candidate(path: Path) -> Array:
    """Return the 17 variables of a lens file's quartet.

    Planes between two media of one index, such as a stop's, are taken out; the entrance pupil is
    where the stop's paraxial image lies.

    Raises:
        SystemExit: one line, where the file is no quartet of this problem.
    """
    lens = read(path)
    return of_lens(lens)


def of_lens(lens: PlainLens) -> Array:
    """Return the 17 variables of a lens that was read; as `candidate`."""
    indices = lens.indices(lens.reference)
    curvatures, gaps, before, lead = [], [], 1.0, 0.0
    for row, index in zip(lens.rows, indices, strict=True):
        if index == before and row.curvature == 0.0 and not row.terms:
            if gaps:
                gaps[-1] += row.gap
            else:
                lead += row.gap
        else:
            if row.conic or row.terms:
                raise SystemExit(f"{lens.path}: the quartet is of spheres")
            curvatures.append(row.curvature)
            gaps.append(row.gap)
        before = index
    wanted = [INDEX, 1.0] * 4
    found = [n for n in indices if n != 1.0]
    if len(curvatures) != 8 or len(found) != 4 or not np.allclose(found, wanted[::2], atol=2e-5):
        raise SystemExit(f"{lens.path}: not four lenses of n = {INDEX}")
    distance, *_ = entrance_pupil(lens)
    return np.array([*curvatures, *gaps, distance - lead])


def stop_of(path: Path) -> tuple[int, float] | None:
    """Return the segment of air and the place (mm) of a file's own stop, as in `stops`.

    None where the stop is no plane in air.
    """
    lens = read(path)
    spheres, place = 0, 0.0
    for number, row in enumerate(lens.rows):
        if number == lens.stop:
            if row.curvature or spheres % 2:
                return None
            return spheres // 2, place if spheres else row.gap
        if row.curvature or row.material != "air":
            spheres, place = spheres + 1, 0.0
        place += row.gap
    return None


def write(candidate: Array, path: Path, name: str) -> None:
    """Write a candidate as a lens file whose first surface is a stop in its entrance pupil.

    A pupil behind the first vertex is written as a plane there and a gap of its own back to it,
    with a negative thickness.
    """
    pupil = float(candidate[16])
    rows = {"1": {"type": "aperture", "semi_diameter": FOCAL_LENGTH / F_NUMBER / 2.0}}
    rows["1"] |= {"thickness": -pupil, "material": "air"}
    for k in range(8):
        c = float(candidate[k])
        row = {"type": "sphere", "radius": 1.0 / c if c else float("inf"), "semi_diameter": "auto"}
        if k < 7:
            row["thickness"] = float(candidate[8 + k])
        rows[str(k + 2)] = row | {"material": INDEX if k % 2 == 0 else "air"}
    data = {
        "name": name,
        "stop": 1,
        "wavelengths": [587.5618],
        "reference_wavelength": 587.5618,
        "fields": {"angles": [[0.0, float(a)] for a in ANGLES]},
        "entrance_pupil_diameter": FOCAL_LENGTH / F_NUMBER,
        "surfaces": rows,
        "sensor": {"distance": float(candidate[15]), "diameter": 60.0},
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(data, sort_keys=False))
