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
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dolens.errors import InputError, one_line
from dolens.file_text import decode_text
from dolens.optics.aiming import aim
from dolens.optics.lens import Lens
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Rays, Status
from dolens.prescriptions.build import lens_from_prescription
from dolens.prescriptions.check_files import lens_files
from dolens.prescriptions.files import read_lens_file
from dolens.prescriptions.zemax import parse_zemax
from dolens.prescriptions.zemax_system import factor_to_mm
from dolens.prescriptions.zemax_writer import zemax_of

# Points of the stop, over its semi-diameter.
PUPIL = ((0.0, 0.0), (0.0, 0.7), (0.0, -0.7), (0.7, 0.0), (-0.45, 0.5), (0.0, 0.95))
MOST_FIELDS, MOST_WAVELENGTHS = 5, 5


@dataclass(frozen=True)
class Traced:
    """Rays of one wavelength: where they start, and where dolens lands them.

    Attributes:
        wavelength: nm.
        position: (N, 3), mm, in the lens's axes.
        direction: (N, 3).
        landed: (N, 3), mm, on the image, in the lens's axes.
        path: (N,), mm.
        indices: of every medium.
    """

    wavelength: float
    position: np.ndarray
    direction: np.ndarray
    landed: np.ndarray
    path: np.ndarray
    indices: list[float]


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
            _array(rays.position.reshape(-1, 3)[kept]),
            _array(rays.direction.reshape(-1, 3)[kept]),
            _array(landed),
            _array(hit.path_length.flatten()[kept]),
            [float(n) for n in system.indices(wavelength)],
        )


def _array(values: Tensor) -> np.ndarray:
    return values.detach().numpy()


class UnlikeError(Exception):
    """The other program has no such surface, or reads another number of them."""


@dataclass(frozen=True)
class Plain:
    """A surface as other programs know it: its shape, its place, and the index behind it."""

    kind: str
    curvature: float
    conic: float
    terms: list[float]
    mirror: bool
    origin: np.ndarray
    rotation: np.ndarray
    number: int


def plain_surfaces(lens: Lens) -> list[Plain]:
    """Return the surfaces that bend light, with their places in the lens's axes."""
    axes = lens.global_axes()
    found = []
    for number, surface in lens.surfaces.items():
        if surface.changes_axes:
            continue
        at = int(number) - 1
        p = {key: float(value.detach()) for key, value in surface._parameters.items()}
        kind = {"aperture": "plane"}.get(surface.kind, surface.kind)
        known = ("plane", "sphere", "conic", "even_asphere", "odd_asphere")
        if kind not in known or surface.phase is not None:
            raise UnlikeError(f"surface {number} is a {surface.kind} or has a phase")
        powers = {int(key[1:]): value for key, value in p.items() if key[0] == "a"}
        step = 2 if kind == "even_asphere" else 1
        terms = [powers.get(n, 0.0) for n in range(step, max(powers, default=0) + 1, step)]
        found.append(
            Plain(
                *(kind, p.get("curvature", 0.0), p.get("conic", 0.0), terms),
                lens.materials[int(number)].name == "mirror",
                *(_array(part[at]) for part in axes),
                int(number),
            )
        )
    return found


class Optiland:
    """Optiland's model of a lens."""

    name = "Optiland"

    def __init__(self, optic: object) -> None:
        self.group = optic.surfaces if hasattr(optic, "surfaces") else optic.surface_group

    @classmethod
    def built(cls, lens: Lens) -> "Optiland":
        """Build the lens of dolens."""
        from optiland.optic import Optic

        optic = Optic()
        optic.surfaces.add(index=0, radius=np.inf, z=-np.inf)
        for at, surface in enumerate(plain_surfaces(lens), 1):
            kinds = {"even_asphere": "even_asphere", "odd_asphere": "odd_asphere"}
            more = {"coefficients": surface.terms} if surface.kind in kinds else {}
            optic.surfaces.add(
                index=at,
                surface_type=kinds.get(surface.kind, "standard"),
                radius=1.0 / surface.curvature if surface.curvature else np.inf,
                conic=surface.conic,
                material="mirror" if surface.mirror else "air",
                is_stop=surface.number == lens.stop,
                **_placed(surface.origin, surface.rotation),
                **more,
            )
        axes = lens.global_axes()
        optic.surfaces.add(index=at + 1, **_placed(*(_array(part[-1]) for part in axes)))
        return cls(optic)

    @classmethod
    def read(cls, path: Path) -> "Optiland":
        """Read a file."""
        from optiland.fileio import load_zemax_file

        return cls(load_zemax_file(str(path)))

    def indices(self, wavelength: float) -> list[float]:
        """Return the program's own indices in front of the surfaces and behind each."""
        media = [surface.material_post for surface in self.group.surfaces[:-1]]
        return [float(np.ravel(medium.n(wavelength / 1000.0))[0]) for medium in media]

    def trace(self, rays: Traced, indices: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        """Return points on the image and path lengths, NaN where a ray is lost."""
        from optiland.materials import IdealMaterial
        from optiland.rays import RealRays

        surfaces = self.group.surfaces
        for surface, index in zip(surfaces[:-1], indices, strict=True):
            surface.material_post = IdealMaterial(n=index)
        for surface in surfaces:
            surface.aperture = None
        one = np.ones(len(rays.path))
        bundle = RealRays(*rays.position.T, *rays.direction.T, one, one * rays.wavelength / 1000.0)
        self.group.trace(bundle, skip=1)
        return np.stack([bundle.x, bundle.y, bundle.z], -1), np.asarray(bundle.opd)


def _placed(origin: np.ndarray, rotation: np.ndarray) -> dict[str, float]:
    """Return Optiland's place of a surface: turned about its x, then y, then z."""
    angles = {
        "rx": np.arctan2(rotation[2, 1], rotation[2, 2]),
        "ry": np.arctan2(-rotation[2, 0], np.hypot(rotation[2, 1], rotation[2, 2])),
        "rz": np.arctan2(rotation[1, 0], rotation[0, 0]),
    }
    place = dict(zip("xyz", origin, strict=True)) | angles
    return {key: float(value) for key, value in place.items()}


class RayOptics:
    """A model of a lens in ray-optics: its path of surfaces, transformations and media."""

    name = "ray-optics"

    def __init__(self, path: Callable[[float], list[list]]) -> None:
        self.path = path

    @classmethod
    def built(cls, lens: Lens) -> "RayOptics":
        """Build the lens of dolens."""
        from rayoptics.elem import profiles
        from rayoptics.elem.surface import Surface

        shapes = {
            "conic": lambda s: profiles.Conic(c=s.curvature, cc=s.conic),
            "even_asphere": lambda s: profiles.EvenPolynomial(
                c=s.curvature, cc=s.conic, coefs=s.terms
            ),
            "odd_asphere": lambda s: profiles.RadialPolynomial(
                c=s.curvature, ec=s.conic + 1.0, coefs=s.terms
            ),
        }
        axes = [(np.zeros(3), np.eye(3))]
        surfaces = [Surface(interact_mode="dummy")]
        sense, senses = 1.0, [1.0]
        for plain in plain_surfaces(lens):
            make = shapes.get(plain.kind, lambda s: profiles.Spherical(c=s.curvature))
            mode = "reflect" if plain.mirror else "transmit"
            surfaces.append(Surface(profile=make(plain), interact_mode=mode))
            axes.append((plain.origin, plain.rotation))
            sense = -sense if plain.mirror else sense
            senses.append(sense)
        axes.append(tuple(_array(part[-1]) for part in lens.global_axes()))
        surfaces.append(Surface(interact_mode="dummy"))
        steps = [
            (after.T @ before, before.T @ (there - here))
            for (here, before), (there, after) in zip(axes[:-1], axes[1:], strict=True)
        ] + [None]
        rows = zip(surfaces, steps, [*senses, sense], strict=True)
        segments = [[surface, None, step, 1.0, z] for surface, step, z in rows]
        return cls(lambda wavelength: segments)

    @classmethod
    def read(cls, path: Path) -> "RayOptics":
        """Read a file."""
        from rayoptics.gui.appcmds import open_model

        model = open_model(str(path)).seq_model

        def segments(wavelength: float) -> list[list]:
            # Its own rounding of the file's wavelengths.
            near = min(model.wvlns, key=lambda own: abs(own - wavelength))
            if abs(near - wavelength) > 1e-6 * wavelength:
                raise UnlikeError(f"no wavelength of {wavelength} nm")
            found = [list(segment) for segment in model.path(near)]
            found[0][2] = (np.eye(3), np.zeros(3))
            return found

        return cls(segments)

    def indices(self, wavelength: float) -> list[float]:
        """Return the program's own indices in front of the surfaces and behind each."""
        return [abs(float(segment[3])) for segment in self.path(wavelength)[:-1]]

    def trace(self, rays: Traced, indices: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        """Return points on the image in its own axes, and path lengths; NaN where a ray is lost."""
        from rayoptics.raytr.raytrace import trace_raw
        from rayoptics.raytr.traceerror import TraceError

        path = self.path(rays.wavelength)
        for segment, index in zip(path, [*indices, indices[-1]], strict=True):
            segment[3] = index
        landed, length = np.full_like(rays.landed, np.nan), np.full(len(rays.path), np.nan)
        for i, (point, direction) in enumerate(zip(rays.position, rays.direction, strict=True)):
            try:
                ray = trace_raw(
                    *(iter(path), point, direction, rays.wavelength), intersect_obj=False
                )[0]
            except TraceError:
                continue
            landed[i] = ray[-1][0]
            length[i] = sum(n * s[2] for n, s in zip(indices, ray, strict=False))
        return landed, length


def compared(
    lens: Lens, bundles: list[Traced], model: Optiland | RayOptics, unit: float
) -> dict[str, object]:
    """Return the largest differences of a program's rays from ours, for a model in a unit in mm."""
    media = [0, *(plain for plain in range(1, len(lens.surfaces) + 1))]
    media = [m for m in media if m == 0 or not lens.surfaces[str(m)].changes_axes]
    origin, rotation = (_array(part[-1]) for part in lens.global_axes())
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
    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)
    np.seterr(all="ignore")
    programs = installed()
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
    main()
