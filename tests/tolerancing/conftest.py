import pytest
import torch
import yaml

from dolens.analysis.pupil_quadrature import gaussian_quadrature
from dolens.prescriptions import lens_from_prescription

LINES = (656.2725, 587.5618, 486.1327)
FIELDS = ((0.0, 0.0), (0.0, 20.0), (-14.0, 0.0))


@pytest.fixture
def triplet(root):
    """The Cooke triplet with its three elements free to move."""
    return triplet_of(root)


@pytest.fixture(scope="session")
def spots(root):
    """Of that triplet; aiming the rays takes longer than all that is done with them."""
    return gaussian_quadrature(triplet_of(root), FIELDS, LINES, 3, 6, symmetry=False)


def triplet_of(root):
    prescription = yaml.safe_load((root / "conf/lens/cooke_triplet.yaml").read_text())
    prescription["elements"] = {
        "front": {"surfaces": [1, 2]},
        "middle": {"surfaces": [3, 4]},
        "rear": {"surfaces": [5, 6]},
    }
    return lens_from_prescription(prescription, torch.float64)


TOLERANCES = {
    "elements.*.tilt_[xy]": 0.05,
    "elements.*.decenter_[xy]": 0.02,
    "elements.*.shift_z": {"half_range": 0.02, "distribution": "normal"},
    "thicknesses.[135]": 0.02,
    "surfaces.*.curvature": {"half_range": 0.001, "relative": True},
}


@pytest.fixture
def settings():
    """Typical tolerances of every kind."""
    return dict(TOLERANCES)


@pytest.fixture
def traced_spots():
    """Centroids (S, 2) and RMS radii (S,) as their definitions say, spot by spot, mm."""

    def trace(lens, spots):
        hit = lens.trace(spots.rays)
        centroids, radii = [], []
        for spot in range(spots.count):
            mine = spots.spot == spot
            points = hit.position[mine, :2].detach()
            weight = spots.weight[mine, None]
            centroid = (weight * points).sum(0)
            centroids.append(centroid)
            radii.append((weight * (points - centroid).square()).sum().sqrt())
        return torch.stack(centroids), torch.stack(radii)

    return trace
