"""Real lens files are traced ray by ray by dolens and by other programs, and the results compared.

    python scripts/compare_with_peers.py FOLDER --out differences.json

Optiland and ray-optics are used where they are installed.  Rays of several fields, pupil points and
all wavelengths start at the same points in the same directions in every program, and indices are
the same constants everywhere.  Each program is asked

- `built`: for the lens that dolens has read, built through its own interface;
- `file`: for the lens that it reads from the same file;
- `written`: for the lens that it reads from the `.zmx` file that dolens writes of it.

A row gives the largest differences of image points and path lengths (mm), the number of rays, and
the largest difference of the program's own indices of glass; or why there is none.
"""

import argparse
import json
import logging
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from benchmarks.peer_readers import Optiland, RayOptics, Traced, UnlikeError, array

from dolens.errors import InputError, one_line
from dolens.files import decode_text
from dolens.optics.aiming import aim
from dolens.optics.lens import Lens
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Rays, Status
from dolens.prescriptions.build import lens_from_prescription
from dolens.prescriptions.files import lens_files, read_lens_file
from dolens.prescriptions.zemax.file import parse_zemax
from dolens.prescriptions.zemax.system import factor_to_mm
from dolens.prescriptions.zemax.writer import zemax_of

# Points of the stop, over its semi-diameter.
PUPIL = ((0.0, 0.0), (0.0, 0.7), (0.0, -0.7), (0.7, 0.0), (-0.45, 0.5), (0.0, 0.95))
MOST_FIELDS, MOST_WAVELENGTHS = 5, 5


def traced(lens: Lens) -> Iterator[Traced]:
    """Trace rays of a lens, wavelength by wavelength; only those that get through."""
    system = lens.system().opened().traced_by("reference")
    origin, rotation = (part[-1].detach() for part in lens.global_axes())
    points = lens.fields.points if lens.fields else ((0.0, 0.0),)
    spread = torch.linspace(0, len(points) - 1, min(len(points), MOST_FIELDS)).round().int()
    field = torch.tensor([points[int(i)] for i in spread], dtype=torch.float64)
    if lens.fields is None or lens.fields.kind == "angles":
        field = torch.deg2rad(field)
    pupil = torch.tensor(PUPIL, dtype=torch.float64)
    for wavelength in (lens.wavelengths or (lens.primary_wavelength,))[:MOST_WAVELENGTHS]:
        rays = aim(system, field[:, None], pupil, wavelength, lens.object_distance)
        hit = trace_rays(system, Rays(rays.position, rays.direction, wavelength), 1.0)
        kept = (rays.converged & (hit.status == Status.OK)).flatten()
        if not bool(kept.any()):
            continue
        # In the image's own axes z counts from the first vertex along the axis.
        local = hit.position.reshape(-1, 3)[kept].double()
        local = local - local.new_tensor([0.0, 0.0, float(system.vertices[-1])])
        landed = local @ rotation.T + origin
        yield Traced(
            wavelength,
            array(rays.position.reshape(-1, 3)[kept]),
            array(rays.direction.reshape(-1, 3)[kept]),
            array(landed),
            array(hit.path_length.flatten()[kept]),
            [float(n) for n in system.indices(wavelength)],
        )


def compared(
    lens: Lens, bundles: list[Traced], model: Optiland | RayOptics, unit: float
) -> dict[str, object]:
    """Return the largest differences of a program's rays from ours, for a model in a unit in mm."""
    media = [0, *(plain for plain in range(1, len(lens.surfaces) + 1))]
    media = [m for m in media if m == 0 or not lens.surfaces[str(m)].changes_axes]
    origin, rotation = (array(part[-1]) for part in lens.global_axes())
    point, path, glass, rays, lost = 0.0, 0.0, 0.0, 0, 0
    for bundle in bundles:
        ours = [bundle.indices[m] for m in media]
        theirs = model.indices(bundle.wavelength)
        if len(theirs) != len(ours):
            raise UnlikeError(f"{len(theirs) - 1} surfaces for {len(ours) - 1}")
        glass = max(glass, *(abs(a - b) for a, b in zip(ours, theirs, strict=True)))
        scaled = replace(bundle, position=bundle.position / unit)
        landed, length = (unit * found for found in model.trace(scaled, ours))
        if isinstance(model, RayOptics):
            landed = landed @ rotation.T + origin
        kept = np.isfinite(landed).all(-1)
        lost, rays = lost + int((~kept).sum()), rays + int(kept.sum())
        if kept.any():
            point = max(point, float(np.abs(landed - bundle.landed)[kept].max()))
            path = max(path, float(np.abs(length - bundle.path)[kept].max()))
    return {"point": point, "path": path, "rays": rays, "lost": lost, "glass": glass}


def rows_of(path: Path, programs: Sequence[type]) -> dict[str, object]:
    """Return the comparisons of one file, by program and mode."""
    try:
        prescription, _ = read_lens_file(path)
        lens = lens_from_prescription(prescription, where=str(path)).requires_grad_(False)
        bundles = list(traced(lens))
        unit = 1.0
        if path.suffix.lower() == ".zmx":
            unit = float(
                factor_to_mm(
                    parse_zemax(decode_text(path.read_bytes(), str(path)), str(path)), str(path)
                )
            )
    except InputError as error:
        return {"refused": one_line(error)}
    found: dict[str, object] = {}
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / "lens.zmx"
        try:
            written.write_text(zemax_of(prescription))
        except InputError as error:
            found["not written"] = one_line(error)
        for program in programs:
            modes = {
                "built": lambda p=program: p.built(lens),
                # Both leave lengths in the file's unit.
                "file": lambda p=program: p.read(path),
                "written": lambda p=program: p.read(written),
            }
            for mode, make in modes.items():
                try:
                    found[f"{program.name} {mode}"] = compared(
                        lens, bundles, make(), unit if mode == "file" else 1.0
                    )
                except Exception as error:
                    # Whatever stops another program, the next file is still compared.
                    what = f"{type(error).__name__}: {one_line(error)}"
                    found[f"{program.name} {mode}"] = {"error": what[:200]}
    return found


def installed() -> list[type]:
    """Return the other programs that can be imported."""
    found = []
    for module, program in (("optiland", Optiland), ("rayoptics", RayOptics)):
        try:
            __import__(module)
        except ImportError:
            continue
        found.append(program)
    return found


def main() -> None:
    """Compare the files of a folder, and print a line each where a difference exceeds the limit."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="lens files")
    parser.add_argument("--out", type=Path, help="all rows, as JSON")
    parser.add_argument("--limit", type=float, default=1e-9, help="mm; larger ones are printed")
    parser.add_argument("--only", default="", help="part of the file's name")
    arguments = parser.parse_args()
    programs = installed()
    if not programs:
        print("neither Optiland nor ray-optics is installed: only what dolens reads is listed")
    rows: dict[str, object] = {}
    begin = time.monotonic()
    for path in lens_files(arguments.folder):
        if arguments.only not in path.name:
            continue
        rows[path.name] = rows_of(path, programs)
        for mode, row in rows[path.name].items():
            if isinstance(row, dict) and row.get("point", 0.0) > arguments.limit:
                print(f"{row['point']:.1e} mm, {row['rays']} rays, {mode}: {path.name}", flush=True)
        if arguments.out:
            arguments.out.write_text(json.dumps(rows, indent=1))
    print(f"{len(rows)} files in {time.monotonic() - begin:.0f} s", *(p.name for p in programs))


if __name__ == "__main__":
    # What files and other programs have to say of themselves.
    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)
    np.seterr(all="ignore")
    main()
