"""An arrangement of sources and planes, and the information in its images."""

from dataclasses import dataclass

from torch import Tensor

from dolens.alignment.information import Knowledge
from dolens.alignment.pose import Pose

# A combination known worse than so many of its scales is not known at all.
UNSEEN = 1e4


@dataclass(frozen=True)
class Arrangement:
    """Holds sources and planes, and the information in their images.

    Attributes:
        name: of the arrangement.
        pose: the lens where it is; its variables are what is unknown.
        known: of it.
        spread: (P,), standard deviations of combinations of θ/scale, the worst known first.
        combinations: (P, P), those, one a row.
        estimates: (M, P), degrees and mm, from M measurements with other photons; None: none.
    """

    name: str
    pose: Pose
    known: Knowledge
    spread: Tensor
    combinations: Tensor
    estimates: Tensor | None

    @property
    def bounds(self) -> Tensor:
        """Return bounds (P,), degrees and mm."""
        return self.known.bounds / self.pose.units
