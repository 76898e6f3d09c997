"""The light that ghost paths lose, as series for the kernels, from those of each surface alone.

Paths meet the same surfaces in the same ways: onwards or on the way back, passed or reflected.  So
the series of each is found once, and that of a path is put together.
"""

import torch

from dolens.optics.ghost_paths import Path, unfolded
from dolens.optics.losses import (
    Losses,
    SurfaceSeries,
    absorption_of,
    joined_losses,
    surface_series,
)
from dolens.optics.system import OpticalSystem

# Of shares, of which the least that count are some 1e-3.
_TOLERANCE = 1e-8


class GhostLosses:
    """Gives the losses of the paths of a lens.

    Args:
        system: the lens, with coatings.
        wavelength: nm.
    """

    def __init__(self, system: OpticalSystem, wavelength: float) -> None:
        self.count = len(system.surfaces)
        self.waves = torch.tensor([wavelength], dtype=torch.float64, device=system.device)
        self.absorption = absorption_of(system, self.waves)
        self.known: dict[tuple[int, bool, bool], SurfaceSeries | None] = {}

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
        for place, key in keys.items():
            if key not in self.known:
                number = place + 1
                self.known[key] = surface_series(ghost, number, self.waves, 1.0, _TOLERANCE)
        rows = {place + 1: self.known[key] for place, key in keys.items()}
        found = {number: row for number, row in rows.items() if row is not None}
        if len(found) < len(rows):
            return None
        return joined_losses(found, self.absorption[list(way.media)])
