"""Photographs with depth maps beside them, and a camera trained on them."""

import numpy as np
import pytest
import torch
from PIL import Image

from dolens.errors import InputError
from dolens.experiments.data.crops import centred_crop, random_crop
from dolens.experiments.data.image_folder import RgbdFolderDataModule, read_depth_map
from dolens.experiments.data.photographs import Photograph
from dolens.rendering.auto.probes import probe_texture
from dolens.sensor.pixels import Sensor
from tests.experiments.tiny_experiment import CAMERA


def write(folder, name, depth, ending="png"):
    """A photograph that shows its depth in its red channel, and the map."""
    folder.mkdir(parents=True, exist_ok=True)
    red = (np.asarray(depth) // 40).clip(0, 255).astype(np.uint8)
    Image.fromarray(np.stack([red, red // 2, 255 - red], -1)).save(folder / f"{name}.png")
    path = folder / f"{name}_depth.{ending}"
    if ending == "npy":
        np.save(path, np.asarray(depth, np.float32) / 1000.0)
    else:
        Image.fromarray(np.asarray(depth, np.uint16)).save(path)
    return path


def ramp(height=60, width=80):
    """From 4.5 to 8 m from left to right, and something nearer in front of it."""
    depth = np.linspace(4500, 8000, width)[None].repeat(height, 0)
    depth[20:40, 30:50] = 4600
    return depth.astype(np.uint16)


def test_crops_carry_the_depth_of_what_they_show(tmp_path):
    for number in range(4):
        write(tmp_path, f"scene{number}", ramp())
    data = RgbdFolderDataModule(
        tmp_path, crop_size=24, batch_size=2, scale_range=(1.0, 1.0), steps_per_epoch=3
    )
    data.setup()
    assert sum(len(paths) for paths in data.paths.values()) == 4
    for batch in (*data.train_dataloader(), *data.test_dataloader()):
        assert batch.shape[1:] == (4, 24, 24)
        # Red says what the depth is, wherever the crop was cut and however it was mirrored.
        shown = (batch[:, 3] / 40).floor().clamp(max=255) / 255
        linear = torch.where(shown > 0.04045, ((shown + 0.055) / 1.055) ** 2.4, shown / 12.92)
        assert torch.allclose(batch[:, 0], linear, atol=1e-6)


def test_a_smaller_image_has_no_depths_between_two_surfaces():
    depth = torch.full((64, 64), 8000.0)
    depth[:, 30:] = 500.0
    photo = Photograph("edge", torch.zeros(3, 64, 64, dtype=torch.uint8), depth)
    for crop in (
        centred_crop(photo, (20, 20), 1, 0, 3.0),
        random_crop(photo, (20, 20), 1, 2, (1.5, 3.0)),
    ):
        assert set(crop[3].unique().tolist()) <= {500.0, 8000.0}


@pytest.mark.parametrize("ending", ["png", "npy"])
def test_units(tmp_path, ending):
    path = write(tmp_path, "a", ramp(), ending)
    unit = 1000.0 if ending == "npy" else 1.0
    found = read_depth_map(path, unit)
    assert torch.allclose(found, torch.from_numpy(ramp().astype(np.float32)), rtol=1e-6)


def test_holes_take_the_depth_of_the_far_side(tmp_path):
    """What a depth camera does not see beside a near thing is shadow on the far one."""
    depth = np.full((9, 12), 6000, np.uint16)
    depth[:, 6:] = 1000
    depth[2:7, 3:6] = 0
    found = read_depth_map(write(tmp_path, "a", depth), 1.0)
    assert bool((found[:, :6] == 6000.0).all()) and bool((found[:, 6:] == 1000.0).all())


def test_not_finite_is_a_hole(tmp_path):
    depth = np.full((4, 4), 2.0, np.float32)
    depth[1, 1], depth[2, 2] = np.nan, np.inf
    np.save(tmp_path / "a.npy", depth)
    assert bool((read_depth_map(tmp_path / "a.npy", 1000.0) == 2000.0).all())


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros((4, 4), np.uint16), "no depth above 0"),
        (np.ones((4, 4, 3), np.uint8), r"uint8 of shape \(4, 4, 3\)"),
        (np.array(["a"], dtype=object), "cannot be decoded"),
    ],
)
def test_a_map_that_is_none_is_an_error(tmp_path, values, message):
    np.save(tmp_path / "a.npy", values)
    with pytest.raises(InputError, match=message):
        read_depth_map(tmp_path / "a.npy", 1.0)


def test_a_photograph_without_its_map_is_an_error(tmp_path):
    for number in range(4):
        path = write(tmp_path, f"scene{number}", ramp())
    path.unlink()
    data = RgbdFolderDataModule(tmp_path, crop_size=24)
    with pytest.raises(InputError, match=r"scene3.png: no depth map .* allowed: scene3_depth"):
        data.setup()


def test_a_map_of_another_size_is_named_and_passed_over(tmp_path, caplog):
    for number in range(4):
        write(tmp_path, f"scene{number}", ramp())
    Image.fromarray(ramp(30, 40)).save(tmp_path / "scene0_depth.png")
    data = RgbdFolderDataModule(tmp_path, crop_size=24, unreadable="skip")
    for split in ("train", "validation", "test"):
        photographs = data.photographs(split)
        for number in range(len(photographs)):
            if photographs.paths[number].stem != "scene0":
                assert photographs[number].depth.shape == (60, 80)
            elif len(photographs) > 1:
                assert photographs[number].name != str(tmp_path / "scene0.png")
                assert "60×80 pixels and a depth map of 30×40" in caplog.text
            else:
                with pytest.raises(InputError, match="none of 1 files"):
                    photographs[number]


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"depth_suffix": ""}, "depth_suffix"), ({"depth_unit": 0.0}, "depth_unit")],
)
def test_settings_out_of_range_are_errors(tmp_path, settings, message):
    with pytest.raises(InputError, match=message):
        RgbdFolderDataModule(tmp_path, **settings)


def test_a_renderer_that_chooses_is_tried_on_colours_alone(tmp_path):
    for number in range(4):
        write(tmp_path, f"scene{number}", ramp())
    data = RgbdFolderDataModule(tmp_path, crop_size=24)
    data.setup()
    assert data.most_detailed().shape == (1, 3, 24, 24)
    sensor = Sensor(10, 10, 0.01)
    assert probe_texture(sensor, 3, 0, data.most_detailed()).shape == (3, 3, 74, 74)


def test_a_camera_is_trained_on_a_folder(trained, tmp_path):
    for number in range(4):
        write(tmp_path / "scenes", f"scene{number}", ramp(120, 160))
    layers = ("scene=layers", "views=layers", "data=rgbd_folder")
    metrics = trained(*CAMERA, *layers, f"data.root={tmp_path / 'scenes'}").metrics
    assert 0.0 < metrics["test/psnr_db/4.5-8m"] < 60.0
