"""Starts of a search are random lenses that are sound by paraxial optics.

Powers of the elements, their bendings, thicknesses and air spaces are drawn; the curvatures are
then scaled until the focal length is right.  Of many such lenses those are kept whose back focus,
beam and Petzval sum are within reach, the best of them first.
"""

import math

import torch
from torch import Tensor

from dolens.lens_search.arrangement import AIR
from dolens.lens_search.merit import SearchMerit

# Lenses that are drawn for one that is kept.
DRAWN = 24
# Newton's steps for the factor of the curvatures.
_STEPS = 12
# Of axial colour in the strain: that of a singlet of crown is worth 0.25.
_COLOUR = 30.0


def random_starts(
    merit: SearchMerit, count: int, generator: torch.Generator, drawn: int = DRAWN
) -> Tensor:
    """Return variables u of up to `count` starts, (n, P), the most promising first.

    Args:
        merit: knows the arrangement and the specification.
        count: how many.
        generator: of the random numbers.
        drawn: lenses that are drawn for one that is kept.
    """
    lenses = merit.completed(_drawn(merit, drawn * count, generator), generator)
    scaled = _with_focal_length(merit, lenses)
    rank = _rank(merit, scaled)
    best = rank.argsort()[:count]
    return scaled[best[torch.isfinite(rank[best])]]


def _drawn(merit: SearchMerit, count: int, generator: torch.Generator) -> Tensor:
    """Draw lenses whose focal length is not yet right."""
    arrangement = merit.arrangement

    def uniform(low: float, high: float) -> Tensor:
        drawn = torch.rand(count, generator=generator, dtype=torch.float64)
        return low + (high - low) * drawn

    def logarithmic(low: float, high: float) -> Tensor:
        return uniform(math.log(low), math.log(high)).exp()

    lower, upper = merit.bounds()
    columns = []
    previous: Tensor | None = None
    for behind in arrangement.media_behind:
        # An element's back follows from its front by a drawn power; cemented ones share a face.
        curvature = uniform(-2.5, 2.5) if previous is None else previous + uniform(-4.0, 4.0)
        columns.append(curvature)
        previous = None if behind == AIR else curvature
    s = arrangement.surfaces
    for gap, medium in enumerate(arrangement.gap_media, s):
        low = max(float(lower[gap]), 1e-3)
        high = min(float(upper[gap]), 0.3 if medium != AIR else 0.4)
        columns.append(logarithmic(low, max(high, 1.001 * low)))
    low = max(float(lower[arrangement.image_column]), 0.05)
    columns.append(uniform(low, max(1.2, 1.5 * low)))
    # Aspheres begin as parabolas.
    columns += [torch.zeros(count, dtype=torch.float64)] * sum(arrangement.terms)
    return torch.stack(columns, -1)


def _with_focal_length(merit: SearchMerit, drawn: Tensor) -> Tensor:
    """Scale the curvatures of each lens until its power is one, by the secant method."""
    s = merit.arrangement.surfaces

    def power(factor: Tensor) -> Tensor:
        return merit.paraxial_of(scaled(factor))[0]

    def scaled(factor: Tensor) -> Tensor:
        return torch.cat([drawn[:, :s] * factor[:, None], drawn[:, s:]], 1)

    old, new = torch.full((len(drawn),), 0.5).to(drawn), torch.ones(len(drawn)).to(drawn)
    at_old, at_new = power(old) - 1.0, power(new) - 1.0
    for _ in range(_STEPS):
        change = at_new - at_old
        step = torch.where(change.abs() > 1e-12, -at_new * (new - old) / change, 0.0)
        old, at_old = new, at_new
        new = (new + step.clamp(-0.5, 0.5)).clamp(-4.0, 4.0)
        at_new = power(new) - 1.0
    found = scaled(new)
    found[at_new.abs() > 1e-3] = torch.nan
    back_focus = merit.paraxial_of(found)[2]
    lower, upper = merit.bounds()
    image = merit.arrangement.image_column
    within = (back_focus >= lower[image]) & (back_focus <= upper[image])
    found[:, image] = torch.where(within, back_focus, torch.nan)
    return found


def _rank(merit: SearchMerit, lenses: Tensor) -> Tensor:
    """Return how promising lenses are, the least first; infinite where one is out of reach.

    It is what strains a lens: the squares of the marginal and the chief ray's bending at each
    surface at full aperture and field, and the Petzval sum.
    """
    specification = merit.specification
    numbers, found = merit.first_order(lenses)
    aperture = 0.5 / specification.f_number
    field = math.tan(math.radians(specification.fields[-1]))
    strain = 4.0 * found.petzval.square() + (_COLOUR * merit.colour(lenses)).square()
    good = torch.isfinite(lenses).all(-1)
    for curvature, marginal, chief in zip(
        numbers.curvatures, found.marginal, found.chief, strict=True
    ):
        height = aperture * abs(marginal) + field * abs(chief)
        steep = curvature * height
        good &= (steep.abs() < 0.8) & (height < 1.0)
        strain = strain + steep.square()
    limit = specification.limits.track
    if limit is not None:
        s = merit.arrangement.surfaces
        lengths = lenses[:, s : merit.arrangement.image_column + 1]
        good &= lengths.sum(-1) < limit / specification.focal_length
    return torch.where(good & torch.isfinite(strain), strain, torch.inf)
