"""Spots of several object distances are joined to one set of rays."""

from collections.abc import Sequence

import torch

from dolens.analysis.pupil_quadrature import SpotRays
from dolens.optics.rays import Rays


def joined_spots(parts: Sequence[SpotRays]) -> SpotRays:
    """Return the spots of several sets as one, in their order.

    Args:
        parts: of the same lens; either all have chief rays or none has.
    """
    spots, chiefs, count, rays = [], [], 0, 0
    for part in parts:
        spots.append(part.spot + count)
        if part.chief is not None:
            chiefs.append(part.chief + rays)
        count, rays = count + part.count, rays + len(part.spot)
    return SpotRays(
        rays=Rays(
            torch.cat([part.rays.position for part in parts]),
            torch.cat([part.rays.direction for part in parts]),
            torch.cat([torch.as_tensor(part.rays.wavelength) for part in parts]),
        ),
        spot=torch.cat(spots),
        weight=torch.cat([part.weight for part in parts]),
        fields=torch.cat([part.fields for part in parts]),
        wavelengths=torch.cat([part.wavelengths for part in parts]),
        centred=torch.cat([part.centred for part in parts]),
        launched=sum(part.launched for part in parts),
        light=torch.cat([part.light for part in parts]),
        chief=torch.cat(chiefs) if chiefs else None,
    )
