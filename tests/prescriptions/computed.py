"""What a loaded lens computes, in few numbers, so that two lenses can be told apart by them."""

import math
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from dolens.analysis.conditions import conditions, full_field
from dolens.analysis.spot_diagram import spot_diagram
from dolens.errors import InputError
from dolens.optics.diffractive import transmission
from dolens.optics.fields import vignetting_margin
from dolens.optics.lens import Lens
from dolens.optics.metasurface import Cells
from dolens.optics.rays import Rays

# Where rays start: x and y, mm.
_POINTS = [[0.0, 0.0], [0.31, 0.73], [-1.17, 0.41], [0.2, -2.3], [2.9, 1.7], [-0.5, 4.1]]
# A grid of points of a surface, mm.
_GRID = torch.meshgrid([torch.linspace(-9.0, 9.1, 37, dtype=torch.float64)] * 2, indexing="ij")
# Sags are asked for within this part of it.
_REACH = 0.7
# Points of the stop over its semi-diameter.
_STOP = [[0.5, 0.6], [-0.3, 0.7], [0.1, -0.8]]
# Directions of these rays, x and y components.
_SLOPES = [[0.0, 0.0], [0.02, -0.05]]
# °C, far from the temperature of any lens here.
_HOT = 75.0
# Rays of a spot.
_RAYS = 64


def fingerprint(lens: Lens) -> Iterator[Tensor]:
    """Yield what a lens computes, the cheap numbers first; a state of it after the other.

    They are: fixed rays through the lens at each of its wavelengths, with their path lengths and
    validity; what its coatings reflect and pass, and what reliefs of diffractive elements pass;
    margins of its clear apertures, and how large its surfaces are drawn; first-order numbers; the
    same rays through the heated lens; sags; vignetting and paraxial chief rays of its own fields;
    their spots and real chief rays, with the means over wavelengths and fields that their weights
    make; its full field.
    """
    there = [lens, *(lens.in_state(name) for name in lens.state_names)]
    for compute in (
        _rays,
        _coatings,
        _reliefs,
        _apertures,
        _first_order,
        _hot_rays,
        _sags,
        _beams,
        _spots,
        _full_field,
    ):
        for one in there:
            yield _numbers(compute, one)


class Computed:
    """Holds a lens's fingerprint, of which only so much is computed as comparisons need."""

    def __init__(self, lens: Lens) -> None:
        self._left = fingerprint(lens)
        self._known: list[Tensor] = []

    def differs(self, lens: Lens) -> bool:
        """Return whether another lens computes anything else."""
        for at, other in enumerate(fingerprint(lens)):
            if at == len(self._known):
                own = next(self._left, None)
                if own is None:
                    return True  # it has more states
                self._known.append(own)
            own = self._known[at]
            if own.shape != other.shape or not torch.equal(own.nan_to_num(), other.nan_to_num()):
                return True
        return at + 1 < len(self._known)


def _numbers(compute: Callable[[Lens], Sequence[Tensor]], lens: Lens) -> Tensor:
    """Return the numbers in one row; a lens of which there are none has a row of its own."""
    with torch.no_grad():
        try:
            return torch.cat([part.double().reshape(-1) for part in compute(lens)])
        except InputError:
            return torch.tensor([math.nan])


def _waves(lens: Lens) -> Tensor:
    return torch.tensor(lens.wavelengths or (lens.primary_wavelength,), dtype=lens.dtype)


def _rays(lens: Lens) -> list[Tensor]:
    at = torch.tensor(_POINTS, dtype=lens.dtype)
    slope = torch.tensor(_SLOPES, dtype=lens.dtype)
    along = (1.0 - slope.square().sum(-1, keepdim=True)).sqrt()
    position = torch.cat([at, torch.full_like(at[:, :1], -1.0)], -1)
    direction = torch.cat([slope, along], -1)
    hit = lens.trace(Rays(position, direction[:, None, None], _waves(lens)[:, None]))
    return [hit.position, hit.direction, hit.path_length, hit.valid, hit.status]


def _coatings(lens: Lens) -> list[Tensor]:
    cosines = torch.tensor([1.0, 0.8, 0.6], dtype=lens.dtype)
    waves = _waves(lens)[:, None]
    coatings = [state.coating for state in lens.system().surfaces if state.coating is not None]
    found = [part for c in coatings for part in c.shares(1.1, 1.6, cosines, waves)]
    return found or [torch.zeros(0)]


def _reliefs(lens: Lens) -> list[Tensor]:
    system, at = lens.system(), torch.linspace(-0.7, 0.7, 31, dtype=torch.float64)
    found = [torch.zeros(0)]
    for number in system.diffractive:
        relief = system.surfaces[number - 1].relief
        if isinstance(relief, Cells):
            for wave in (500.0, 600.0):
                for weight, part in relief.parts:
                    passed = part.transmission(at, at, wave)
                    # A phase of all of it makes no irradiance.
                    passed = passed * torch.sgn(passed.sum()).conj()
                    found.append(weight * torch.view_as_real(passed))
            continue
        media = system.materials[number - 1], system.materials[number]
        for wave in (500.0, 600.0):
            passed = transmission(relief, at, at, relief.step(*media, wave) / wave, media)
            found.append(torch.view_as_real(passed))
    return found


def _apertures(lens: Lens) -> list[Tensor]:
    x, y = _GRID
    clear = [s.aperture for s in lens.surfaces.values() if hasattr(s, "aperture")]
    drawn = torch.tensor([aperture.semi_diameter for aperture in clear])
    return [drawn, *(aperture.margin(x, y) for aperture in clear)]


def _sags(lens: Lens) -> list[Tensor]:
    x, y = (_REACH * part for part in _GRID)
    found = []
    for surface in lens.surfaces.values():
        values = {**dict(surface.named_parameters()), **dict(surface.named_buffers())}
        if not surface.changes_axes:
            found.append(type(surface).sag_and_gradient(values, x, y)[0])
    return found


def _first_order(lens: Lens) -> list[Tensor]:
    found = lens.first_order(lens.primary_wavelength, lens.object_distance)
    return [found.efl, found.bfd, found.entrance_pupil.z, found.entrance_pupil.diameter]


def _hot_rays(lens: Lens) -> list[Tensor]:
    return _rays(lens.at(_HOT))


def _beams(lens: Lens) -> list[Tensor]:
    seen = conditions(lens)
    paraxial = [
        lens.paraxial_rays(height, lens.primary_wavelength, seen.object_distance).chief.height
        for height in seen.fields.flatten().tolist()
    ]
    return [vignetting_margin(lens.fields, seen.fields, seen.fields.new_tensor(_STOP)), *paraxial]


def _spots(lens: Lens) -> list[Tensor]:
    seen = conditions(lens)
    spots = spot_diagram(lens, seen, _RAYS)
    square = spots.polychromatic_rms.square()
    return [spots.rms, spots.chief, square, (seen.field_weights * square).sum()]


def _full_field(lens: Lens) -> list[Tensor]:
    return [torch.tensor(full_field(lens, lens.object_distance))]
