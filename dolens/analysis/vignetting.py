"""The vignetted pupil of a field is found on the stop."""

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.aiming import AimedRays
from dolens.optics.fields import vignetting_margin
from dolens.optics.lens import Lens
from dolens.optics.ray_tracing import trace_rays

# Stop coordinates are searched for the edge of the light on so many radii, twice.
_RADII = 48
# Points along each side of the stop in the search for where light passes at all.
_SIDE = 32


class VignettedPupils:
    """The vignetted pupils of F fields are searched together, because aiming costs by the call.

    Stop coordinates are x and y over its semi-diameter.

    Args:
        lens: the lens; its reference wavelength counts.
        fields: (F, 2), degrees or mm.
        object_distance: mm in front of the first vertex; None for an object at infinity.
    """

    def __init__(self, lens: Lens, fields: Tensor, object_distance: float | None) -> None:
        self.lens, self.fields, self.object_distance = lens, fields, object_distance

    def aim(self, pupil: Tensor) -> AimedRays:
        """Aim rays of every field at points (F, N, 2) of the stop."""
        wavelength = self.lens.primary_wavelength
        return self.lens.aim(self.fields[:, None], pupil, wavelength, self.object_distance)

    def passes(self, pupil: Tensor) -> Tensor:
        """Return whether rays through points of the stop pass the lens, (F, N), bool.

        Of the lens's own fields those outside the beam that vignetting factors leave do not.
        """
        beam = vignetting_margin(self.lens.fields, self.fields, pupil) > 0.0
        return trace_rays(self.lens.system(), self.aim(pupil)).valid.cpu() & beam.cpu()

    def centres(self, meridional: Tensor) -> Tensor:
        """Return the centroid of each vignetted pupil, (F, 2); every arm from it meets the
        boundary.

        Args:
            meridional: (F,), bool: the lens and the field make it lie on the y axis.

        Raises:
            InputError: no light of a field passes.
        """
        axis = (torch.arange(_SIDE).double() + 0.5) * (2.0 / _SIDE) - 1.0
        points = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
        points = points[points.norm(dim=-1) < 1.0]
        passing = self.passes(points.expand(len(self.fields), -1, 2))
        dark = ~passing.any(1)
        if bool(dark.any()):
            field = self.fields[int(torch.nonzero(dark)[0])].tolist()
            raise InputError(f"no light of field {tuple(field)} passes the lens")
        share = passing.double() / passing.sum(1, keepdim=True)
        middle = share @ points
        middle[passing.all(1)] = 0.0
        middle[meridional, 0] = 0.0
        return middle

    def boundary_radius(self, centres: Tensor, arms: Tensor) -> Tensor:
        """Return the distance of the boundary from the centre along each arm (F, A, 2), (F, A)."""
        centres = centres[:, None]
        # |c + ρa| = 1: the stop's own edge.
        along = (arms * centres).sum(-1)
        far = -along + (along.square() + 1.0 - centres.square().sum(-1)).sqrt()
        low, high = torch.zeros_like(far), far
        steps = (torch.arange(_RADII).double() + 1.0)[:, None, None] / _RADII
        for turn in range(2):
            radii = low + steps * (high - low)
            # The last of the first turn lies on the stop's edge, where a ray is outside.
            tried = centres + (radii * (1.0 - 1e-9))[..., None] * arms
            passing = self.passes(tried.transpose(0, 1).flatten(1, 2))
            passing = passing.reshape(len(far), _RADII, -1).transpose(0, 1)
            # Number of radii that pass before the first that does not.
            good = passing.long().cumprod(0).sum(0)
            edges = torch.cat([low[None], radii])
            low, high = (
                edges.gather(0, good[None])[0],
                edges.gather(0, (good + 1).clamp(max=_RADII)[None])[0],
            )
            if turn == 0 and bool((good == _RADII).all()):
                break
        return low
