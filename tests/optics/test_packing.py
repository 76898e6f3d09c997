"""What is kept of a lens between traces is its structure as it is now, and nothing else."""

import dataclasses

import pytest
import torch
import yaml

from dolens import InputError, Rays
from dolens.optics.jacobian import ray_jacobian
from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture
from dolens.optics.surfaces.xy_polynomial import XYPolynomial
from dolens.prescriptions import lens_from_prescription


def bundle():
    xy = torch.rand((200, 2), generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 8.0
    position = torch.cat((xy - 4.0, torch.full((200, 1), -5.0, dtype=torch.float64)), 1)
    direction = torch.tensor([[0.02, -0.01, 1.0]], dtype=torch.float64)
    return Rays(position, direction / direction.norm(), 587.5618)


def change_aperture(lens):
    lens.surfaces["2"].aperture = ClearAperture(Circle(3.0), Circle(1.0))


def change_material(lens):
    materials = list(lens.materials)
    materials[1], materials[5] = materials[3], materials[3]
    lens.materials = tuple(materials)


def change_curvature(lens):
    with torch.no_grad():
        lens.surfaces["3"].curvature *= 1.1


def change_gap(lens):
    with torch.no_grad():
        lens.thicknesses["2"] += 0.3


def change_pose(lens):
    with torch.no_grad():
        lens.elements["rear"].tilt_x += 0.01


@pytest.mark.parametrize(
    "change", [change_aperture, change_material, change_curvature, change_gap, change_pose]
)
def test_a_lens_changed_between_traces_is_traced_as_it_is_now(root, change):
    given = yaml.safe_load((root / "conf/lens/cooke_triplet.yaml").read_text(encoding="utf-8"))
    given["elements"] = {"rear": {"surfaces": [5, 6], "decenter_x": 0.1}}
    lens = lens_from_prescription(given)
    variables = ["surfaces.*.curvature", "elements.rear.tilt_x"]
    before = lens.trace(bundle())
    ray_jacobian(lens, bundle(), variables)
    change(lens)
    found, moved = lens.trace(bundle()), ray_jacobian(lens, bundle(), variables)
    lens.backend = "reference"
    expected, slopes = lens.trace(bundle()), ray_jacobian(lens, bundle(), variables)
    both = expected.valid & before.valid
    different = (expected.position - before.position)[both].abs().max() > 1e-4
    assert different or not torch.equal(expected.valid, before.valid)
    assert torch.equal(found.status, expected.status)
    assert (found.position - expected.position)[expected.valid].abs().max() < 1e-12
    assert (moved.derivatives - slopes.derivatives).abs().max() < 1e-9


class Leaning(XYPolynomial):
    """A polynomial on a wedge that no kernel knows of."""

    kind = "leaning"

    @classmethod
    def sag_and_gradient(cls, p, x, y):
        sag, sx, sy, exists = super().sag_and_gradient(p, x, y)
        return sag + 0.05 * x, sx + 0.05, sy, exists


def test_a_kernel_is_not_inherited_by_another_sag(registered):
    registered(Leaning)
    surface = {"type": "leaning", "x2": 0.01, "semi_diameter": 8.0, "material": "1.5"}
    lens = lens_from_prescription({"surfaces": {"1": surface}, "sensor": {"distance": 20.0}})
    rays = dataclasses.replace(bundle(), direction=torch.tensor([[0.0, 0.0, 1.0]]).double())
    # Light bends towards the thicker side by (1 - 1/n) of the wedge's angle, to first order.
    slope = lens.trace(rays).direction[..., 0].detach() + 0.02 * rays.position[..., 0] / 3.0
    assert slope.mean() == pytest.approx(-0.05 / 3.0, rel=0.02)
    lens.backend = "cpu"
    with pytest.raises(InputError, match=r"surface 1 \(leaning\) has no kernel"):
        lens.trace(rays)
