"""Other programs' models of a lens that dolens has read: built through their own interfaces, or as
they read a file themselves; each traces given rays with given indices.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from torch import Tensor

from dolens.optics.lens import Lens


def array(values: Tensor) -> np.ndarray:
    """Return a tensor's numbers."""
    return values.detach().numpy()


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
                *(array(part[at]) for part in axes),
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
        optic.surfaces.add(index=at + 1, **_placed(*(array(part[-1]) for part in axes)))
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
        axes.append(tuple(array(part[-1]) for part in lens.global_axes()))
        surfaces.append(Surface(interact_mode="dummy"))
        steps = [
            (after.T @ before, before.T @ (there - here))
            for (here, before), (there, after) in itertools.pairwise(axes)
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
