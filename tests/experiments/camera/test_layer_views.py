"""Photographs given a depth, and a camera trained on them."""

import math

import pytest
import torch

from dolens.errors import InputError
from dolens.experiments.camera.views.depths import with_occluders
from tests.experiments.tiny_experiment import CAMERA, ONE_EPOCH


def occluded(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    textures = torch.linspace(0.0, 1.0, 64).expand(2, 3, 48, 64).clone()
    return with_occluders(textures, 1000.0, 8000.0, count, generator), textures


def test_depths_stay_in_their_range_and_near_things_hide_far_ones():
    """The background takes the farther half of the range in vergence; what hides it is nearer."""
    bare, textures = occluded(0)
    assert torch.equal(bare[:, :3], textures)
    middle = 2.0 / (1.0 / 1000.0 + 1.0 / 8000.0)
    assert middle <= float(bare[:, 3].min()) and float(bare[:, 3].max()) <= 8000.0
    full, _ = occluded(6)
    assert float(full[:, 3].min()) >= 1000.0
    hidden = full[:, 3] < middle
    assert 0.1 < float(hidden.float().mean()) < 0.95
    assert torch.equal(full[:, 0][~hidden], textures[:, 0][~hidden])
    # What is seen at an edge changes: the light in front is of another place.
    assert float((full[:, 0] - textures[:, 0])[hidden].abs().mean()) > 0.1


def test_occluders_are_a_function_of_the_seed():
    """So a resumed run sees what an uninterrupted one does."""
    assert torch.equal(occluded(5, 3)[0], occluded(5, 3)[0])
    assert not torch.equal(occluded(5, 3)[0], occluded(5, 4)[0])
    with pytest.raises(InputError, match="allowed: 0 < a <= b"):
        with_occluders(torch.ones(1, 3, 8, 8), 8000.0, 1000.0, 1, torch.Generator())


RENDERERS = {
    "rays": CAMERA,
    "psf": [
        *(o for o in CAMERA if o != "renderer=rays"),
        *("renderer=psf", "renderer.fields=[1,1]", "renderer.size=33"),
    ],
}


@pytest.mark.parametrize("renderer", RENDERERS)
def test_a_camera_is_trained_on_scenes_with_depth(trained, renderer):
    """One image a scene, and metrics that say its range of depths."""
    layers = ("scene=layers", "scene.layers=4", "views=layers")
    found = trained(*RENDERERS[renderer], *layers, ONE_EPOCH)
    assert math.isfinite(found.metrics["test/psnr_db/4.5-8m"])
    assert "images" in found.figures


def test_layers_without_a_scene_of_layers_are_refused(refused):
    """One line that says what to choose."""
    refused("choose scene=layers", *CAMERA, "views=layers")
