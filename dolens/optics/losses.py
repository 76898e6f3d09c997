"""Light is lost at surfaces and in media; the kernels take both as numbers.

A surface passes, or a mirror reflects, a share of unpolarised light's power that is given as a
Chebyshev series in the cosine of incidence, Σ c_k·T_k(x), from x = -1 at the lowest cosine to 1 at
normal incidence.  The coefficients are a linear map of the shares at `nodes`, so that autograd goes
on from them to whatever a coating is made of.
"""

import math
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from dolens.cached_tensors import cached_tensors, to_be_kept
from dolens.errors import InputError
from dolens.kernels.table import POWERS, Code, Cosine, Failure, Kind, LossTable, Slot
from dolens.optics.coatings import CoatingState
from dolens.optics.materials import Medium
from dolens.optics.packing import LaidOut, lay_out
from dolens.optics.records import Records, tensor
from dolens.optics.system import OpticalSystem

# Steps that are no surfaces of the lens; a law deflects what its surface has passed.
_BETWEEN = (Kind.CHANGE_AXES, Kind.LENS_AXES, Kind.SENSOR, Kind.DEFLECT)
_GROUP = 8  # coefficients that a kernel takes at once
# Lengths of series that are tried, and how many of the last coefficients must be small.
_TERMS, _LAST = (8, 12, 16, 24, 32, 48, 64, 96, 128), 3
_KEPT = 64  # tables of a lens
# Of a share, for the precision in which rays are traced.
_NEGLIGIBLE = {torch.float64: 1e-13, torch.float32: 3e-8}


@dataclass(frozen=True, eq=False)
class Losses:
    """What a lens loses of light of W wavelengths; a surface that is not named passes all of it.

    A series converges fast in the cosine of the medium of the lower index, since in the other it
    has the root of the critical angle: for light from glass to air that is `Cosine.LEAVING`.

    Attributes:
        numbers: of S surfaces, from 1.
        coefficients: (S, W, K), of each surface's share as a series.
        cosines: S of them: which cosine the series is a function of; () where all arrive.
        lowest: S of them, below 1: the series are for cosines from here to 1, and steeper light
            has the share of this; () where all are 0.
        ratios: (S, W), index in front over that of the medium beyond a mirror, for
            `Cosine.BEYOND`; None where none is.
        absorption: (media, W), 1/mm: α of exp(-α·t), before surface 1 and after each surface; None:
            all media are clear.
    """

    numbers: tuple[int, ...]
    coefficients: Tensor
    cosines: tuple[Cosine, ...] = ()
    lowest: tuple[float, ...] = ()
    ratios: Tensor | None = None
    absorption: Tensor | None = None


def nodes(count: int, lowest: float = 0.0) -> Tensor:
    """Return the cosines (count,), ascending, at which shares determine a series."""
    angle = _angles(count)
    return 1.0 - (1.0 - lowest) * torch.sin(0.5 * angle) ** 2


def _angles(count: int) -> Tensor:
    return math.pi * (count - 0.5 - torch.arange(count, dtype=torch.float64)) / count


@cached_tensors(maxsize=16)
def _transform(count: int) -> Tensor:
    """Return the map (nodes, coefficients) from shares to their series."""
    map_ = torch.cos(_angles(count)[:, None] * torch.arange(count)) * (2.0 / count)
    map_[:, 0] *= 0.5
    return map_


@cached_tensors(maxsize=16)
def _powers(count: int) -> Tensor:
    """Return the map of a series's coefficients to those of powers of x."""
    map_ = torch.eye(count, dtype=torch.float64)
    for k in range(2, count):
        map_[k] = 2.0 * map_[k - 1].roll(1) - map_[k - 2]
    return map_


@cached_tensors(maxsize=16)
def _nearer(count: int) -> Tensor:
    """Return the map of a series's coefficients to those of the same polynomial as a series in
    2x - 1.
    """
    x = 0.5 + 0.5 * torch.cos(_angles(count))
    of_nodes = torch.cos(torch.arange(count, dtype=torch.float64)[:, None] * torch.acos(x))
    return of_nodes @ _transform(count)


@cached_tensors(maxsize=16)
def _derivative(count: int) -> Tensor:
    """Return the map of a series's coefficients to those of its derivative: T_k' is 2k times the
    sum of T_(k-1), T_(k-3) and so on, with half of T_0.
    """
    k, j = torch.arange(count, dtype=torch.float64)[:, None], torch.arange(count)
    map_ = torch.where((j < k) & ((k - j) % 2 == 1), 2.0 * k, 0.0)
    map_[:, 0] *= 0.5
    return map_


def series(shares: Tensor) -> Tensor:
    """Return the coefficients (..., K) of the series with these shares (..., K) at `nodes`."""
    return shares.double() @ _transform(shares.shape[-1]).to(shares.device)


class SurfaceSeries(NamedTuple):
    """What one surface passes, or a mirror reflects, as a series.

    Attributes:
        coefficients: (W, K).
        cosine: that it is a function of.
        ratio: (W, 1), index in front over that beyond, for `Cosine.BEYOND`, else ones.
    """

    coefficients: Tensor
    cosine: Cosine
    ratio: Tensor


def losses_of(
    system: OpticalSystem, wavelengths: Tensor, sense: float = 1.0, tolerance: float = 1e-12
) -> Losses | None:
    """Return the losses of a lens's coatings and glasses; None where no series of 128 terms or
    fewer gives the shares of a surface.

    Args:
        system: the lens.
        wavelengths: (W,), nm.
        sense: +1 for light towards the sensor, -1 for light towards the object.
        tolerance: of the shares: the largest of a series's last coefficients.
    """
    waves = wavelengths.detach().double().reshape(-1, 1)
    found: dict[int, SurfaceSeries] = {}
    for number, surface in enumerate(system.surfaces, 1):
        if surface.coating is not None:
            one = surface_series(system, number, waves[:, 0], sense, tolerance)
            if one is None:
                return None
            found[number] = one
    return joined_losses(found, absorption_of(system, waves[:, 0]))


def absorption_of(system: OpticalSystem, wavelengths: Tensor) -> Tensor:
    """Return the absorption (media, W), 1/mm, in double precision, at wavelengths (W,), nm."""
    alphas = (torch.as_tensor(a, dtype=torch.float64) for a in system.absorptions(wavelengths))
    return torch.stack([alpha.to(wavelengths.device).expand(len(wavelengths)) for alpha in alphas])


def joined_losses(found: Mapping[int, SurfaceSeries], absorption: Tensor) -> Losses:
    """Return the losses of a lens.

    Args:
        found: number of a surface → its series.
        absorption: (media, W), 1/mm.
    """
    longest = max((one.coefficients.shape[-1] for one in found.values()), default=_GROUP)
    padded = [
        pad(one.coefficients, (0, longest - one.coefficients.shape[-1])) for one in found.values()
    ]
    cosines = tuple(one.cosine for one in found.values())
    ratios = [one.ratio[:, 0] for one in found.values()]
    return Losses(
        tuple(found),
        torch.stack(padded) if padded else absorption.new_zeros((0, absorption.shape[1], longest)),
        cosines,
        ratios=torch.stack(ratios) if Cosine.BEYOND in cosines else None,
        absorption=absorption if bool(absorption.any()) else None,
    )


def surface_series(
    system: OpticalSystem,
    number: int,
    wavelengths: Tensor,
    sense: float = 1.0,
    tolerance: float = 1e-12,
) -> SurfaceSeries | None:
    """Return the series of a coated surface; None where no series of 128 terms or fewer gives its
    shares.

    Args:
        system: the lens.
        number: of the surface, which has a coating.
        wavelengths: (W,), nm.
        sense: as of `losses_of`, as the last argument.
        tolerance: of the shares.
    """
    waves = wavelengths.detach().double().reshape(-1, 1)
    surface, mirror = system.surfaces[number - 1], number in system.mirrors
    coating, places = surface.coating, (number - 1, number)
    assert coating is not None  # as the argument says
    if sense < 0.0 and not mirror:
        coating, places = coating.turned_round(), places[::-1]
    mode = (mirror, surface.deflection is not None, tolerance)
    varies = torch.is_grad_enabled() and any(n.requires_grad for n in coating.tensors)
    if system.index_offsets or varies:
        of_media = system.indices(waves)
        front, behind = (
            torch.as_tensor(of_media[place], dtype=torch.float64).expand(waves.shape)
            for place in places
        )
        return _computed_series(coating, front, behind, waves, *mode)
    front_medium, behind_medium = (system.materials[place] for place in places)
    numbers = tuple(map(float, waves[:, 0].tolist()))
    values = tuple(float(value.detach()) for value in coating.tensors)
    one = _series_of_numbers(coating.structure, values, front_medium, behind_medium, numbers, *mode)
    return one and SurfaceSeries(*(_beside(part, waves) for part in one))


def _beside(part: Tensor | Cosine, like: Tensor) -> Any:
    return part.to(like.device) if isinstance(part, Tensor) else part


@cached_tensors(maxsize=4096)
def _series_of_numbers(
    structure: CoatingState,
    values: tuple[float, ...],
    front: Medium,
    behind: Medium,
    wavelengths: tuple[float, ...],
    mirror: bool,
    deflects: bool,
    tolerance: float,
) -> SurfaceSeries | None:
    """Return the series of a coating of these numbers, which many ghost paths share."""
    waves = torch.tensor(wavelengths, dtype=torch.float64)[:, None]
    coating = structure.with_tensors([torch.tensor(v, dtype=torch.float64) for v in values])
    before, after = (
        torch.as_tensor(medium.index(waves), dtype=torch.float64).expand(waves.shape)
        for medium in (front, behind)
    )
    return _computed_series(coating, before, after, waves, mirror, deflects, tolerance)


def _computed_series(
    coating: CoatingState,
    front: Tensor,
    behind: Tensor,
    waves: Tensor,
    mirror: bool,
    deflects: bool,
    tolerance: float,
) -> SurfaceSeries | None:
    """Return the series of what a coating passes from front to behind, or reflects; indices and
    wavelengths (W, 1).
    """
    ratio = front / (coating.behind(behind, waves) if mirror else behind)
    thinner = not ratio.is_complex() and bool((ratio > 1.0).all()) and not deflects
    cosine = Cosine.ARRIVING
    if thinner:
        cosine = Cosine.BEYOND if mirror else Cosine.LEAVING

    def coefficients(terms: int) -> Tensor:
        u = nodes(terms).to(waves).expand(len(waves), terms)
        if thinner:
            u = (1.0 - (1.0 - u.square()) / ratio.square()).sqrt()
        found = coating.shares(front, behind, u, waves)
        return series(found.reflected if mirror else found.passed)

    with torch.no_grad():  # a graph would take most of the time
        last = ((terms, coefficients(terms)[:, -_LAST:].abs().max()) for terms in _TERMS)
        enough = next((terms for terms, most in last if float(most) <= tolerance), None)
    if enough is None:
        return None
    beyond = ratio if cosine == Cosine.BEYOND else torch.ones_like(waves)
    return SurfaceSeries(coefficients(enough), cosine, beyond)


def loss_table_of(
    system: OpticalSystem,
    wavelengths: tuple[float, ...],
    sense: float,
    first: int,
    last: int,
    to_sensor: bool,
) -> LossTable | None:
    """Return the losses at the steps of a lens, or a part of it, that is traced; None where
    `losses_of` finds none.  What needs no graph is kept while the coatings have the same numbers.

    Args:
        system: the lens.
        wavelengths: nm, in the order of a table's columns of indices.
        sense: as of `lay_out`, as the further arguments.
        first: surface.
        last: surface.
        to_sensor: whether rays go there.
    """
    coatings = [surface.coating for surface in system.surfaces if surface.coating is not None]
    numbers = [number for coating in coatings for number in coating.tensors]
    stays = not system.index_offsets
    stays &= not (torch.is_grad_enabled() and any(n.requires_grad for n in numbers))
    values = tuple(float(number.detach()) for number in numbers) if stays else ()
    kept = system.derived.setdefault(("losses", sense, first, last, to_sensor), {})
    key = (wavelengths, values)
    if stays and key in kept:
        return kept[key]
    with to_be_kept() if stays else nullcontext():
        waves = torch.tensor(wavelengths, dtype=torch.float64, device=system.device)
        losses = losses_of(system, waves, sense, 1e-12 if system.dtype == torch.float64 else 1e-7)
        table = None
        if losses is not None:
            found = lay_out(system, sense, first, last, to_sensor)
            table = loss_table(losses, found, len(wavelengths), len(system.surfaces))
    if stays:
        if len(kept) >= _KEPT:
            kept.clear()
        kept[key] = table
    return table


def loss_table(losses: Losses, found: LaidOut, wavelengths: int, surfaces: int) -> LossTable:
    """Return the losses at a table's steps.

    Args:
        losses: of the whole lens.
        found: the part of it that is traced.
        wavelengths: columns of the table's indices.
        surfaces: of the lens.

    Raises:
        InputError: tensors of other shapes than the lens and the wavelengths ask for.
    """
    layout = found.layout
    absorption, ratios = losses.absorption, losses.ratios
    _check(losses, wavelengths, surfaces)
    steps, order = _steps(layout, losses.numbers, losses.cosines)
    coefficients = losses.coefficients.double()
    if coefficients.shape[-1] % _GROUP:
        coefficients = pad(coefficients, (0, -coefficients.shape[-1] % _GROUP))
    if ratios is None:
        ratios = coefficients.new_ones((len(losses.numbers), wavelengths))
    media = len(layout.media) + int(layout.waves)
    if absorption is None:
        of_media = coefficients.new_zeros((media, wavelengths))
    else:
        of_media = pad(absorption.double()[_media(layout)], (0, 0, 0, media - len(layout.media)))
    coefficients = coefficients[order]
    lowest = torch.tensor(losses.lowest or (0.0,) * len(losses.numbers), dtype=torch.float64)
    scales = 2.0 / (1.0 - lowest[order])
    terms, summed = coefficients.shape[-1], coefficients.detach()
    slopes = scales[:, None, None] * (summed @ _derivative(terms))
    powers = summed @ _powers(terms)
    counts, small = _summed(summed, powers)
    by_powers = small[:, None, None]
    summed = torch.where(by_powers, powers, summed)
    slopes = torch.where(by_powers, slopes @ _powers(terms), slopes)
    near, near_counts = _near(coefficients.detach(), counts, found.scalars[0].dtype)
    of_series = torch.stack((counts, near_counts), 1)
    of_steps = of_series[steps[:, 0]] if len(order) else steps
    steps = torch.cat((steps, of_steps), 1)
    parts = (of_media, ratios.double()[order], scales, coefficients, summed, slopes, near)
    numbers = torch.cat([part.reshape(-1) for part in parts])
    return LossTable(numbers, steps, len(order), absorption is not None)


def _summed(coefficients: Tensor, powers: Tensor) -> tuple[Tensor, Tensor]:
    """Return of each series (S, W, K) how many terms are summed, (S,), negative of T_k; and
    whether they are powers of x, (S,): those of series that converge fast lose no digits.
    """
    small = (powers.abs().sum(-1) < POWERS).all(-1)
    place = torch.arange(1, coefficients.shape[-1] + 1)
    last = torch.where(coefficients != 0.0, place, 1).amax((1, 2))
    count = (last + _GROUP - 1) // _GROUP * _GROUP
    return torch.where(small, count, -count), small


def _near(coefficients: Tensor, counts: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return each series (S, W, K) for 0 < x ≤ 1 as powers of 2x - 1, and how many are summed,
    (S,): none where these are no fewer than `counts`, or would lose digits.
    """
    terms = coefficients.shape[-1]
    near = coefficients @ _nearer(terms)
    left = near.abs().flip(-1).cumsum(-1).flip(-1).amax(1)  # of the terms from each on
    count = (left > _NEGLIGIBLE[dtype]).sum(-1).clamp(min=1)
    count = (count + _GROUP - 1) // _GROUP * _GROUP
    powers = torch.where(torch.arange(terms) < count[:, None, None], near, 0.0) @ _powers(terms)
    holds = (powers.abs().sum(-1) < POWERS).all(-1) & (count < counts.abs())
    return powers, torch.where(holds, count, 0)


@cached_tensors(maxsize=256)
def _steps(
    layout: Records, numbers: tuple[int, ...], cosines: tuple[Cosine, ...]
) -> tuple[Tensor, Tensor]:
    """Return `LossTable.steps`, and which of the surfaces of these numbers its series are of."""
    found: list[tuple[int, int]] = []
    order: list[int] = []
    for row in layout.codes:
        number = int(layout.constants[int(row[Code.OFFSET]) + Slot.TAG]) >> Failure.BITS
        series, cosine = -1, Cosine.ARRIVING
        if int(row[Code.KIND]) not in _BETWEEN and number in numbers:
            place, series = numbers.index(number), len(order)
            cosine = cosines[place] if cosines else cosine
            order.append(place)
        found.append((series, int(cosine)))
    return tensor(found, np.int64).reshape(-1, 2), tensor(order, np.int64)


@cached_tensors(maxsize=256)
def _media(layout: Records) -> Tensor:
    return tensor(layout.media, np.int64)


def _check(losses: Losses, wavelengths: int, surfaces: int) -> None:
    """Raise `InputError` where losses do not fit the lens and its light."""
    numbers, count = losses.numbers, len(losses.numbers)
    if any(number not in range(1, surfaces + 1) for number in numbers) or len(set(numbers)) < count:
        raise InputError(f"losses: surfaces {numbers}, each once, of a lens of {surfaces}")
    shapes = {
        "coefficients": (losses.coefficients, (count, wavelengths)),
        "ratios": (losses.ratios, (count, wavelengths)),
        "absorption": (losses.absorption, (surfaces + 1, wavelengths)),
    }
    for name, (given, shape) in shapes.items():
        if given is not None and tuple(given.shape[:2]) != shape:
            raise InputError(f"losses: {name} {tuple(given.shape)} must begin with {shape}")
    for name, of_surfaces in (("cosines", losses.cosines), ("lowest", losses.lowest)):
        if of_surfaces and len(of_surfaces) != count:
            raise InputError(f"losses: {len(of_surfaces)} {name} for {count} surfaces")
    if any(not 0.0 <= lowest < 1.0 for lowest in losses.lowest):
        raise InputError(f"losses: lowest cosines from 0 to below 1, not {losses.lowest}")
