"""An arrangement of sources and planes, and the information in its images."""

from dataclasses import dataclass

from torch import Tensor

from dolens.alignment.information import FisherInformation
from dolens.alignment.pose import Pose

# An eigenvector with a larger standard deviation, in the scales, is not seen at all.
UNSEEN = 1e4


@dataclass(frozen=True)
class Arrangement:
    """Holds sources and planes, and the information in their images.

    Attributes:
        name: of the arrangement.
        pose: the lens where it is; its variables are what is unknown.
        information: that the images carry on it.
        spread: (P,), standard deviations along the eigenvectors of θ/scale, the largest first.
        eigenvectors: (P, P), of the Fisher information, one a row.
        estimates: (M, P), degrees and mm, from M measurements with other photons; None: none.
    """

    name: str
    pose: Pose
    information: FisherInformation
    spread: Tensor
    eigenvectors: Tensor
    estimates: Tensor | None

    @property
    def bounds(self) -> Tensor:
        """Return bounds (P,), degrees and mm."""
        return self.information.bounds / self.pose.units
