"""The light that ghost paths lose, as series for the kernels, from those of each surface alone.

Paths meet the same surfaces in the same ways: onwards or on the way back, passed or reflected.  So
the series of each is found once, and that of a path is put together.
"""

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from dolens.kernels.table import Cosine
from dolens.optics.ghost_paths import Path, unfolded
from dolens.optics.losses import Losses, losses_of
from dolens.optics.system import OpticalSystem

# Series grow until their last two terms are smaller than this part of the share at normal
# incidence.
_TERMS, _ENOUGH = (12, 24, 48), 1e-5


class _Row(NamedTuple):
    """A surface as light comes to it has these coefficients (W, K), cosine and ratio (W,)."""

    coefficients: Tensor
    cosine: Cosine
    ratio: Tensor


class GhostLosses:
    """Gives the losses of the paths of a lens.

    Args:
        system: the lens, with coatings.
        wavelength: nm.
    """

    def __init__(self, system: OpticalSystem, wavelength: float) -> None:
        self.count = len(system.surfaces)
        self.waves = torch.tensor([wavelength], dtype=torch.float64, device=system.device)
        absorptions = [torch.as_tensor(a).double() for a in system.absorptions(self.waves)]
        self.absorption = torch.stack([a.expand(1) for a in absorptions]).to(system.device)
        self.known: dict[tuple[int, bool, bool], _Row | None] = {}

    def of(self, path: Path, ghost: OpticalSystem) -> Losses | None:
        """Return the losses of a path; None where a coating's are no series, as those of a table.

        Args:
            path: surfaces that reflect; () is the image's.
            ghost: the path's system.
        """
        way = unfolded(path, self.count)
        keys = {
            place: (number, way.onwards[place], place in way.bounces)
            for place, number in enumerate(way.numbers)
            if ghost.surfaces[place].coating is not None
        }
        new = {key: place for place, key in keys.items() if key not in self.known}
        if new:
            self._find(ghost, new)
        found = [self.known[key] for key in keys.values()]
        rows = [row for row in found if row is not None]
        if len(rows) < len(found):
            return None
        most = max((len(row.coefficients[0]) for row in rows), default=_TERMS[0])
        series = [pad(row.coefficients, (0, most - row.coefficients.shape[1])) for row in rows]
        return Losses(
            tuple(place + 1 for place in keys),
            torch.stack(series) if rows else self.waves.new_zeros(0, 1, most),
            tuple(row.cosine for row in rows),
            ratios=torch.stack([row.ratio for row in rows]) if rows else None,
            absorption=self.absorption[list(way.media)] if bool(self.absorption.any()) else None,
        )

    def _find(self, ghost: OpticalSystem, new: dict[tuple[int, bool, bool], int]) -> None:
        """Find the series of surfaces at places of a path's system."""
        for terms in _TERMS:
            places = {*new.values()}
            alone = [
                surface if place in places else replace(surface, coating=None)
                for place, surface in enumerate(ghost.surfaces)
            ]
            found = losses_of(replace(ghost, surfaces=alone), self.waves, terms)
            at = {number - 1: row for row, number in enumerate(found.numbers)}
            ratios = found.ratios
            for key, place in list(new.items()):
                row = at[place]
                series = found.coefficients[row]
                # At normal incidence all polynomials are one.
                normal = series.detach().sum(-1).abs().amin()
                tail = series[:, -2:].detach().abs().amax()
                self.known[key] = None
                if float(tail) > _ENOUGH * float(normal):
                    continue
                ratio = torch.ones_like(self.waves) if ratios is None else ratios[row]
                self.known[key] = _Row(series, found.cosines[row], ratio)
                del new[key]
            if not new:
                return
