"""A trained camera on whole pictures: without seams, with all bits, upright; and on raw files."""

import json
import struct

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image, ImageOps
from torch import nn

from dolens.errors import InputError
from dolens.experiments.camera.reconstruction import ImageNetwork
from dolens.experiments.camera.restored_windows import margin_of, restore_in_windows, windows
from dolens.experiments.camera.views.whole import Placing, at_depth, axial_function, convolved
from dolens.experiments.commands.apply import PictureCamera, apply_run, signal_of
from dolens.experiments.commands.apply_options import Options
from dolens.experiments.commands.pictures import read_array
from dolens.experiments.running.finished_run import load_run
from dolens.reconstruction import GeneralRestoration, UNetRestoration, WienerUNetRestoration
from dolens.rendering.ray_renderer import RayRenderer
from dolens.sensor.colour import linear_to_srgb, srgb_to_linear
from dolens.sensor.display import write_picture
from dolens.sensor.pictures import read_pixels
from dolens.sensor.pixels import Sensor
from dolens.sensor.readout import Readout

CPU = torch.device("cpu")


def blur(size=9, width=2.0):
    """A Gaussian function of three colours, of unit sum."""
    offsets = torch.arange(size) - size // 2
    line = torch.exp(-0.5 * (offsets / width) ** 2)
    square = line[:, None] * line
    return (square / square.sum()).expand(1, 3, size, size)


def networks():
    torch.manual_seed(1)
    for network in (
        UNetRestoration(width=4, depth=2),
        WienerUNetRestoration(4, 2, margin=16, noise_to_signal=0.5),
    ):
        nn.init.normal_(network.network.output.weight, std=5.0)  # it begins as zero
        yield network


# ---------------------------------------------------------------- windows


@pytest.mark.parametrize("network", list(networks()), ids=["unet", "wiener_unet"])
def test_a_restored_picture_does_not_depend_on_its_windows(network):
    raw = torch.rand(1, 3, 100, 150)
    functions = blur() if network.needs_point_spread_function else None
    margin = margin_of(network, functions, CPU)
    assert margin is not None
    whole, some, many = (
        restore_in_windows(network, raw, functions, None, window, margin)
        for window in (256, 128, 64)
    )
    assert (some - whole).abs().max() < 1e-4 and (many - whole).abs().max() < 1e-4
    assert (whole - linear_to_srgb(raw)).abs().max() > 0.1  # it is no identity


def test_a_network_that_is_told_the_noise_has_a_margin_too():
    network = GeneralRestoration(weights="none", width=8, down=(1,), middle=1, up=(1,))
    raw, noise = torch.rand(1, 3, 100, 300), [torch.tensor([0.01, 0.0009])]
    margin = margin_of(network, blur(), CPU, noise=noise)
    assert margin is not None
    whole, parts = (
        restore_in_windows(network, raw, blur(), None, window, margin, noise)
        for window in (512, 128)
    )
    assert (whole - parts).abs().max() < 1e-4


def test_windows_keep_every_pixel_once():
    kept = torch.zeros(150, 290)
    for part in windows(150, 290, 64):
        kept[slice(*part.rows), slice(*part.columns)] += 1
    assert (kept == 1).all()


def test_the_margin_of_convolutions_is_how_far_they_reach():
    """The margin is the next multiple of the grid."""
    near = ImageNetwork(nn.Conv2d(3, 3, 9, padding=4))
    far = ImageNetwork(nn.Conv2d(3, 3, 3, padding=70, dilation=70))
    assert margin_of(near, None, CPU) == 64
    assert margin_of(far, None, CPU) == 128


def test_a_network_that_looks_at_the_whole_picture_is_not_given_windows():
    class Normalised(nn.Module):
        def forward(self, image):
            return image / image.mean((-2, -1), keepdim=True)

    network = ImageNetwork(Normalised())
    assert margin_of(network, None, CPU, largest=256) is None
    raw = torch.rand(1, 3, 70, 90)
    whole = restore_in_windows(network, raw, None, None, 64, None)
    assert torch.equal(whole, network(raw))


# ---------------------------------------------------------------- the sensor's image


@pytest.fixture(scope="module")
def loaded(tiny_run):
    return load_run(tiny_run, with_loss=False)


@pytest.fixture(scope="module")
def camera(loaded):
    return loaded.module


@pytest.fixture(scope="module")
def applied(tiny_run, tmp_path_factory):
    """The folder of a picture that a camera was applied to, the camera, and what it found.

    The picture is two windows wide.
    """
    parent = tmp_path_factory.mktemp("applied")
    torch.manual_seed(3)
    blocks = torch.nn.functional.interpolate(torch.rand(1, 3, 8, 10), size=(60, 100))[0]
    write_picture(parent / "blocks.png", blocks, 8)
    options = Options(depths=(8000.0, 4500.0), bits=16, save_raw=True, window=64)
    return apply_run(tiny_run, [parent / "blocks.png"], options, out=parent / "out")


@pytest.fixture
def pictures(applied) -> PictureCamera:
    camera = applied[1]
    camera.options = Options(bits=16)
    return camera


def test_a_small_picture_is_imaged_as_rays_image_it(camera):
    """Near the axis the one function of the axis is what independent rays see."""
    lens, values = camera.lens, dict(camera.variables())
    torch.manual_seed(2)
    scene = at_depth(camera.views.scene, 6000.0, lens)
    sensor = Sensor(16, 16, camera.views.sensor.pixel_pitch)
    texture = torch.nn.functional.interpolate(torch.rand(1, 3, 13, 13), size=(80, 80))[0]
    rays = RayRenderer(sensor, 24).render(lens.with_values(values), scene, texture[None], 0)[0, 0]
    functions = axial_function(lens.with_values(values), scene, sensor, 33, "none")
    image = convolved(texture, functions)[:, 32:48, 32:48]
    assert (image - rays).abs().max() < 0.02 and (image - rays).square().mean().sqrt() < 0.005


def test_nearer_than_the_run_s_depths_the_blur_keeps_its_light(camera):
    """At 1.5 m the lens is far out of focus, and the function's window has grown."""
    scene = at_depth(camera.views.scene, 1500.0, camera.lens)
    functions = axial_function(
        camera.lens.with_values(camera.variables()), scene, camera.views.sensor, 33, "none"
    )
    assert functions.shape[-1] > 33
    assert (functions.sum((-2, -1)) - 1.0).abs().max() < 0.01


def test_a_depth_that_is_none_is_refused():
    with pytest.raises(InputError, match=r"--depth: 0\.0; allowed: a positive number"):
        Placing(0.0)


# ---------------------------------------------------------------- files


def test_a_picture_goes_in_and_comes_out(applied, tmp_path):
    folder, camera, found = applied
    names = {path.name for path in folder.iterdir()}
    for depth in ("8m", "4.5m"):
        kinds = ("sensor.png", "restored.png", "comparison.png", "raw.npy")
        assert {f"blocks_{depth}_{kind}" for kind in kinds} <= names
    record = json.loads((folder / "blocks.json").read_text())
    assert record["step"] == 2 and record["margin"] == camera.margin
    assert record["images"]["blocks_8m"]["psnr_db"] == found[0].metrics["psnr_db"]
    assert 5.0 < found[0].metrics["raw_psnr_db"] < 60.0
    # What the simulated sensor gave, taken as a real one's, is restored to the same picture.
    raw = folder / "blocks_8m_raw.npy"
    camera.options = Options(raw=True, bits=16)
    camera.restore(raw, tmp_path)
    again = read_pixels(tmp_path / "blocks_8m_raw_restored.png").linear()
    first = read_pixels(folder / "blocks_8m_restored.png").linear()
    assert (linear_to_srgb(again) - linear_to_srgb(first)).abs().max() < 1.0 / 255
    assert read_pixels(folder / "blocks_8m_restored.png").bits == 16


def test_noise_belongs_to_the_seed_and_not_to_the_windows(pictures, tmp_path):
    write_picture(tmp_path / "grey.png", torch.full((3, 60, 100), 0.5), 8)

    def restored(**options):
        pictures.options = Options(bits=16, **options)
        pictures.apply(tmp_path / "grey.png", tmp_path)
        return linear_to_srgb(read_pixels(tmp_path / "grey_restored.png").linear())

    first, small, other = restored(), restored(window=64), restored(seed=1)
    assert (first - small).abs().max() < 1e-4
    assert (first - other).abs().max() > 1e-2


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_sixteen_bits_survive(tmp_path, suffix):
    values = torch.arange(3 * 20 * 30).reshape(3, 20, 30) / 65535
    write_picture(tmp_path / f"deep.{suffix}", values, 16)
    picture = read_pixels(tmp_path / f"deep.{suffix}")
    assert picture.bits == 16
    assert (linear_to_srgb(picture.linear()) - values).abs().max() < 1e-6


def test_eight_bits_are_read_as_the_training_reads_them(tmp_path):
    values = torch.randint(0, 256, (3, 9, 7), dtype=torch.uint8)
    Image.fromarray(values.permute(1, 2, 0).numpy()).save(tmp_path / "a.png")
    picture = read_pixels(tmp_path / "a.png")
    assert (picture.linear() - srgb_to_linear(values.double() / 255)).abs().max() < 6e-8
    assert picture.bits == 8


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_of_all_kinds_come_out_upright(tmp_path, orientation):
    """Pillow turns 8-bit pictures; 16-bit ones are turned alike."""
    pixels = np.random.default_rng(0).integers(0, 256, (5, 8, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[274] = orientation
    Image.fromarray(pixels).save(tmp_path / "a.png", exif=exif)
    upright = np.asarray(ImageOps.exif_transpose(Image.open(tmp_path / "a.png")))
    deep = pixels.astype(np.uint16) * 257
    tifffile.imwrite(
        tmp_path / "b.tif", deep, photometric="rgb",
        extratags=[(274, "H", 1, orientation, True)],
    )  # fmt: skip
    for name in ("a.png", "b.tif"):
        encoded = linear_to_srgb(read_pixels(tmp_path / name).linear()) * 255
        assert np.array_equal(encoded.round().permute(1, 2, 0).numpy(), upright), name


def test_grey_and_transparent_pictures(tmp_path):
    grey = np.linspace(0, 65535, 48).reshape(6, 8).astype(np.uint16)
    Image.fromarray(grey).save(tmp_path / "grey.png")
    found = read_pixels(tmp_path / "grey.png")
    assert found.bits == 16 and torch.equal(found.linear()[0], found.linear()[2])
    rgba = np.full((4, 4, 4), 65535, np.uint16)
    rgba[..., 3] = 32768
    tifffile.imwrite(tmp_path / "half.tif", rgba, photometric="rgb", extrasamples=["unassalpha"])
    # Half of the light of white: composited in linear light over black.
    found = read_pixels(tmp_path / "half.tif").linear()
    assert (found - 32768 / 65535).abs().max() < 1e-6


def test_raw_numbers_are_those_of_the_run_s_sensor(tmp_path):
    """A mosaic of 12 bits whose black is 256: reading a readout's own codes gives its signal."""
    readout = Readout(bits=12, black_level=0.0625, pattern="RGGB", read_noise=0.001)
    signal = readout(torch.rand(1, 3, 20, 24) * 0.9, torch.Generator().manual_seed(0))
    codes = ((signal * (1 - 0.0625) + 0.0625) * 4095).round()[0, 0].numpy().astype(np.uint16)
    tifffile.imwrite(tmp_path / "raw.tif", codes)
    array = read_array(tmp_path / "raw.tif")
    black = dict(black_level=0.0625 * 4095)
    for levels in ({}, {**black, "white_level": 4095}):
        found = signal_of(array, readout, tmp_path / "raw.tif", **levels)
        assert (found - signal).abs().max() < 1e-5
    with pytest.raises(InputError, match="RGGB filters: give one number a pixel"):
        signal_of(np.zeros((8, 8, 3), np.uint16), readout, tmp_path)
    with pytest.raises(InputError, match="black must be below white"):
        signal_of(array, readout, tmp_path, 5000.0)
    with pytest.raises(InputError, match=r"give \(height, width, 3\)"):
        signal_of(array, Readout(), tmp_path)


def _broken_png(path):
    header = struct.pack(">IIBBBBB", 9, 9, 16, 2, 0, 0, 0)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + b"IHDR" + header)


BAD = {
    "missing": (None, "no such file"),
    "text": (lambda p: p.write_text("no picture"), "cannot be decoded"),
    "cut off": (_broken_png, "cannot be decoded"),
    "a folder": (lambda p: p.mkdir(), "is no file"),
    "tiny": (lambda p: Image.new("RGB", (5, 5)).save(p), "16 or more along each side"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_refused_in_one_line(pictures, tmp_path, case):
    make, expected = BAD[case]
    path = tmp_path / "bad.png"
    if make:
        make(path)
    with pytest.raises(InputError) as caught:
        pictures.apply(path, tmp_path)
    assert expected in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bits": 12}, "--bits"),
        ({"window": 100}, "multiples of 64"),
        ({"black_level": 3.0}, "give --raw too"),
        ({"raw": True, "depths": (5.0,)}, "leave out --depth"),
        # Other numbers that are out of range: test_hostile_options.py.
        *(({"depths": (d,)}, "--depth") for d in (0.0, float("nan"), float("inf"))),
        ({"megapixels": 0.0}, "--megapixels"),
    ],
)
def test_options_that_cannot_be_or_do_not_go_together_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        Options(**options)
