"""Lenses of a search, measured twice: in float64 and again in 80 digits.

    python scripts/lens_search/retrace.py outputs/search_quartet/<date_time>/lens/forms/*.yaml
    python scripts/lens_search/retrace.py LENS.yaml --rings 6 --arms 12 --aimed

It prints two tables.  The first has RMS spots of every field (µm, over the whole pupil, about the
centroid of all wavelengths) through the paraxial entrance pupil, which is f/3 for a quartet: in
NumPy for a quartet, then by the second tracer; and with --aimed by rays that sample the stop.  The
second has EFL, back focus, length, distortion and the smallest gaps at the edge of these beams, in
80 digits.
Neither tracer is dolens; a lens's glass by a catalogue's name is the only thing asked of it.
"""

import argparse
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from mpmath import mp, mpf

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from lens_search import quartet
from lens_search.exact_trace import ExactLens, ExactSpots, Fails, spots
from lens_search.plain_lens import PlainLens, read
from lens_search.plain_trace import PupilRays, pupil_rays
from lens_search.quartet_files import of_lens

_PUPIL = {"entrance_pupil_diameter": quartet.FOCAL_LENGTH / quartet.F_NUMBER}


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("lenses", nargs="+", type=Path)
    parser.add_argument("--rings", type=int, default=4)
    parser.add_argument("--arms", type=int, default=8, help="of half the pupil")
    parser.add_argument("--aimed", action="store_true", help="also aim rays at the stop's rim")
    arguments = parser.parse_args()
    rays = pupil_rays(arguments.rings, arguments.arms, rim=5)
    found = [(path, *_traced(path, rays, arguments.aimed)) for path in arguments.lenses]
    print("| lens | fields (°) | float64 (µm) | 80 digits (µm) | mean |", end="")
    print(" largest difference | aimed at the stop (µm) | mean | failed rays |")
    print("|---|---|---|---|---|---|---|---|---|")
    for path, lens, exact, aimed in found:
        print(_spot_row(path, lens, exact, aimed, rays))
    print("\n| lens | EFL (mm) | back focus | image distance | length | distortion (%) |", end="")
    print(" least gap at the edge, inside the beam (mm) | out to the larger beam (mm) |")
    print("|---|---|---|---|---|---|---|---|")
    for path, lens, exact, aimed in found:
        print(_shape_row(path, lens, exact if aimed is None else aimed))


def _traced(
    path: Path, rays: PupilRays, aimed: bool
) -> tuple[PlainLens, ExactSpots, ExactSpots | None]:
    lens = read(path)
    through = replace(lens, pupil=_PUPIL) if _is_quartet(lens) else lens
    return lens, spots(through, rays), spots(lens, rays, aimed=True) if aimed else None


def _is_quartet(lens: PlainLens) -> bool:
    try:
        of_lens(lens)
    except SystemExit:
        return False
    return lens.angles == tuple(quartet.ANGLES)


def _spot_row(
    path: Path, lens: PlainLens, exact: ExactSpots, aimed: ExactSpots | None, rays: PupilRays
) -> str:
    plain, largest = "", ""
    if _is_quartet(lens):
        own = quartet.measure(of_lens(lens)[None], rays).rms[0]
        plain = _numbers(own)
        largest = f"{max(abs(float(a - b)) for a, b in zip(own, exact.rms, strict=True)):.1e}"
    cells = [
        str(path),
        _numbers(lens.angles),
        plain,
        _numbers(exact.rms),
        _mean(exact),
        largest,
        "" if aimed is None else _numbers(aimed.rms),
        "" if aimed is None else _mean(aimed),
        str(exact.failed + (0 if aimed is None else aimed.failed)),
    ]
    return "| " + " | ".join(cells) + " |"


def _shape_row(path: Path, lens: PlainLens, exact: ExactSpots) -> str:
    at = ExactLens(lens, lens.reference)
    distortion = [
        100 * (y / (at.focal_length * mp.tan(mp.radians(mp.mpf(a)))) - 1)
        for y, a in zip(exact.chief, lens.angles, strict=True)
        if a
    ]
    last = len(lens.rows) - 1
    inner = [_edge(at, k, min(exact.height[k], exact.height[k + 1])) for k in range(last)]
    outer = [_edge(at, k, max(exact.height[k], exact.height[k + 1])) for k in range(last)]
    length = mp.fsum(max(row.gap, 0.0) if k == 0 else row.gap for k, row in enumerate(lens.rows))
    cells = [
        str(path),
        mp.nstr(at.focal_length, 10),
        mp.nstr(at.back_focus, 8),
        mp.nstr(at.gap[-1], 8),
        mp.nstr(length, 8),
        _numbers(distortion),
        mp.nstr(min(inner), 6),
        mp.nstr(min(outer), 6),
    ]
    return "| " + " | ".join(cells) + " |"


def _edge(at: ExactLens, k: int, height: mpf) -> mpf:
    """Return the gap behind surface k at a height; minus infinity where a surface ends before."""
    if at.gap[k] < 0:
        return mp.inf  # a gap back to the first vertex, from a stop in the entrance pupil
    try:
        return at.gap[k] - at.sag(k, height**2)[0] + at.sag(k + 1, height**2)[0]
    except Fails:
        return -mp.inf


def _mean(found: ExactSpots) -> str:
    return mp.nstr(mp.fsum(found.rms) / len(found.rms), 12)


def _numbers(values: Iterable) -> str:
    return ", ".join(mp.nstr(mp.mpf(v), 8) for v in values)


if __name__ == "__main__":
    main()
