"""Operands of a camera's lens: where its objects are, and lenses that they cannot be asked of."""

import pytest
import torch

from dolens.experiments.camera.lens_merit import CameraOperands
from dolens.optics.aiming import aim
from dolens.optimize import merit
from tests.experiments.camera.test_field_views import doublet
from tests.experiments.tiny_experiment import FIXED_WINDOWS, IN_TURNS, TINY_DOUBLET, UNTESTED

DLS = [*IN_TURNS, "optimizer.least_squares.every=1"]
TRAINED = [*TINY_DOUBLET, *FIXED_WINDOWS, *UNTESTED]


@pytest.mark.parametrize("distance", [500.0, 1.0e6])
def test_magnification_is_that_of_the_objects_distance(root, distance):
    """Of an object at distance s before the front focus: -f/s."""
    lens = doublet(root).double()
    operands = CameraOperands([{"kind": "magnification", "target": 0.0}], lens, distance)
    penalty, values = operands.penalty(lens)
    order = lens.first_order()
    expected = -float(order.efl / (distance + order.ffd))
    assert float(values["magnification"]) == pytest.approx(expected, rel=1e-9)
    assert float(penalty) == pytest.approx(expected**2, rel=1e-9)


def test_fields_are_heights_of_near_objects_and_angles_of_far_ones(root):
    """A far object's height over its distance is the tangent of its angle."""
    lens = doublet(root).double()
    angle = {"kind": "chief_ray_angle", "max": 5.0, "field": [0.0, 10.0]}
    height = {**angle, "field": [0.0, -1e9 * torch.tensor(10.0).deg2rad().tan().item()]}
    (far,) = CameraOperands([angle], lens, float("inf")).penalty(lens)[1].values()
    (near,) = CameraOperands([height], lens, 1e9).penalty(lens)[1].values()
    assert float(near) == pytest.approx(float(far), rel=1e-6)


@pytest.mark.parametrize("optimizer", [[], DLS])
def test_a_camera_hands_its_scenes_distance_to_its_operands(made, trained, monkeypatch, optimizer):
    asked = [
        *TRAINED,
        *optimizer,
        "scene.depths=[700.0]",
        "operands=[{kind: magnification, target: -0.1, weight: 1.0}]",
        "trainer.max_epochs=1",
    ]
    module = made(*asked)
    order = module.lens.first_order()
    _, values = module.lens_steps.penalty(module.variables())
    expected = -float(order.efl / (700.0 + order.ffd))
    assert float(values["magnification"]) == pytest.approx(expected, rel=1e-4)
    seen, properties = [], merit.LensProperties
    monkeypatch.setattr(merit, "LensProperties", lambda *a: seen.append(a[2]) or properties(*a))
    trained(*asked)
    assert set(seen) == {700.0}


class Unreachable:
    """Aims as it should, until the first curvature has moved by a part of itself."""

    def __init__(self, lens, part):
        self.start, self.part = float(lens.surfaces["1"].curvature), part
        self.asked = 0

    def __call__(self, system, *arguments):
        aimed = aim(system, *arguments)
        self.asked += 1
        if abs(float(system.surfaces[0].parameters["curvature"]) / self.start - 1.0) > self.part:
            object.__setattr__(aimed, "converged", torch.zeros_like(aimed.converged))
        return aimed


@pytest.mark.parametrize("optimizer", [[], DLS])
def test_a_step_that_loses_a_chief_ray_is_taken_back(made, trained, monkeypatch, caplog, optimizer):
    """Training goes on, loudly, with a lens that can be judged."""
    operand = "operands=[{kind: chief_ray_angle, field: [0, -1.0e5], max: 60.0}]"
    asked = [*TRAINED, *optimizer, operand]
    aimer = Unreachable(made(*asked).lens, 1e-9)
    monkeypatch.setattr("dolens.optimize.operands.aim", aimer)
    metrics = trained(*asked).metrics
    assert aimer.asked > 8
    assert metrics["lens_steps/taken_back"] == 4
    assert metrics["variables/surfaces.1.curvature"] == pytest.approx(aimer.start, rel=1e-6)
    assert len([m for m in caplog.messages if "the chief ray of field (0, -100000)" in m]) == 4


def test_a_camera_that_begins_so_is_refused(refused, root, monkeypatch):
    monkeypatch.setattr("dolens.optimize.operands.aim", Unreachable(doublet(root), -1.0))
    refused(
        "operands: the chief ray of field (0, -1000) does not reach the stop of lens",
        *TRAINED,
        "operands=[{kind: distortion, field: [0, -1.0e3], max: 60.0}]",
    )
