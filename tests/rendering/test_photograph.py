"""`lens.photograph` and `dolens.restore`: what a sensor sees of a picture, and what is restored."""

import copy
import io
import math
import re

import numpy as np
import pytest
import torch
from PIL import Image

import dolens
from dolens import InputError, load_lens
from dolens.reconstruction import WienerTVRestoration, psnr_db
from dolens.sensor.colour import srgb_to_linear
from dolens.sensor.display import linear_picture
from dolens.sensor.pictures import read_pixels


def blocks(height=64, width=96):
    """Colours of photographs, mostly grey, as sRGB values (3, H, W)."""
    generator = torch.Generator().manual_seed(3)
    grey = 0.2 + 0.6 * torch.rand(1, 1, 8, 12, generator=generator)
    coarse = grey + 0.2 * (torch.rand(1, 3, 8, 12, generator=generator) - 0.5)
    return torch.nn.functional.interpolate(coarse, (height, width))[0].clamp(0.0, 1.0)


@pytest.fixture(scope="module")
def lens():
    return load_lens("cooke_triplet")


def decibels(picture):
    return float(psnr_db(picture.image[None], picture.truth[None]))


def test_light_is_that_of_the_picture_and_falls_off_as_the_lens_s(lens):
    photo = lens.photograph(torch.ones(3, 48, 64), light=None)
    rows, columns = torch.arange(48.0), torch.arange(64.0)
    assert photo.signal[:, 23:25, 31:33].mean() == pytest.approx(1.0, abs=0.005)
    assert (photo.signal - photo.illumination(rows, columns)).abs().max() < 0.01
    assert torch.allclose(photo.truth, torch.ones(3, 48, 64))


def test_a_pixel_is_the_truth_weighted_by_the_function_of_its_place(lens):
    photo = load_lens("double_gauss").photograph(blocks(), light=None)
    place = torch.tensor([20.0]), torch.tensor([70.0])
    function = photo.point_spread_functions(*place)[0, 0]
    reach = function.shape[-1] // 2
    truth = srgb_to_linear(photo.truth)[:, 20 - reach : 21 + reach, 70 - reach : 71 + reach]
    light = photo.illumination(*place)[:, 0, 0]
    expected = light * (function.flip(-2, -1) * truth).sum((-2, -1))
    assert torch.allclose(photo.signal[:, 20, 70], expected, atol=0.01)


def test_noise_is_that_of_so_many_electrons(lens):
    still = lens.photograph(blocks(), light=None)
    assert still.noise == (0.0, 0.0)
    for light, read in ((100.0, 3.0), (400.0, 0.0)):
        photo = lens.photograph(blocks(), light=light, read_noise=read)
        assert photo.noise == pytest.approx((1.0 / light, (read / light) ** 2))
        variance = float((photo.signal - still.signal).square().mean())
        expected = float(still.signal.mean()) / light + (read / light) ** 2
        assert variance == pytest.approx(expected, rel=0.03)
    again, other = (lens.photograph(blocks(), light=400.0, read_noise=0.0, seed=s) for s in (0, 1))
    assert torch.equal(again.signal, photo.signal) and not torch.equal(other.signal, photo.signal)


def test_distances_are_millimetres_and_the_lens_s_own_by_default():
    gauss = load_lens("double_gauss")  # focused on infinity
    near, far, own = (gauss.photograph(blocks(), d, None) for d in (500.0, math.inf, None))
    assert (near.distance, far.distance, own.distance) == (500.0, math.inf, math.inf)
    assert torch.equal(far.image, own.image) and decibels(near) < decibels(far) - 1.0


def test_pixels_are_chosen_in_millimetres(lens):
    photo = lens.photograph(blocks(), sensor=(18.0, 12.0), pixel_pitch=0.375)
    assert photo.image.shape == photo.truth.shape == (3, 32, 48)
    assert "48×32 pixels of 375 µm, 18×12 mm" in repr(photo)
    mosaic = lens.photograph(blocks(), pattern="RGGB")
    assert mosaic.signal.shape == (1, 64, 96) and mosaic.image.shape == (3, 64, 96)


def test_a_lens_is_left_as_it_is(lens):
    before = copy.deepcopy(lens.state_dict())
    grads = [p.requires_grad for p in lens.parameters()]
    photo = lens.photograph(blocks())
    assert not photo.image.requires_grad and not photo.truth.requires_grad
    assert grads == [p.requires_grad for p in lens.parameters()]
    assert all(torch.equal(value, before[name]) for name, value in lens.state_dict().items())


def test_what_is_restored_is_nearer_the_truth(lens):
    for settings in ({}, {"pattern": "RGGB"}, {"light": None}):
        photo = lens.photograph(blocks(), **settings)
        restored = dolens.restore(photo)
        assert restored.image.shape == (3, 64, 96) and restored.truth is photo.truth
        assert float(restored.image.min()) >= 0.0 and float(restored.image.max()) <= 1.0
        assert decibels(restored) > decibels(photo) + 3.0
    photo = lens.photograph(blocks())
    other = dolens.restore(photo, WienerTVRestoration())
    assert decibels(other) > decibels(photo) + 3.0


def test_files_arrays_and_tensors_are_one_picture(tmp_path):
    tensor = (blocks() * 255.0).round().to(torch.uint8)
    array = tensor.permute(1, 2, 0).numpy()
    Image.fromarray(array).save(tmp_path / "a.png")
    linear = linear_picture(tmp_path / "a.png")
    assert torch.equal(linear, linear_picture(str(tmp_path / "a.png")))
    assert linear.shape == (3, 64, 96) and linear.dtype == torch.float32
    for same in (tensor, array, array.astype(np.uint16) * 257, array / 255.0, tensor / 255.0):
        assert torch.allclose(linear_picture(same), linear, atol=1e-6)
    grey = linear_picture(array[..., 0])
    assert torch.equal(grey[0], grey[2]) and torch.equal(grey[0], linear[0])
    assert torch.equal(linear_picture(tensor[:1]), grey)
    rounded = linear_picture(blocks().to(torch.bfloat16))
    assert (rounded - linear_picture(blocks())).abs().max() < 0.02


def test_a_restored_picture_is_a_page_beside_its_photograph_and_truth(lens, tmp_path):
    photo = lens.photograph(blocks())
    restored = dolens.restore(photo)
    restored.save(tmp_path / "new/page.html")
    text = (tmp_path / "new/page.html").read_text()
    assert re.findall(r'alt="(\w+)"', text) == ["truth", "sensor", "restored"]
    for picture in (photo, restored):
        assert f"<td>{decibels(picture):.2f}</td>" in text
    photo.save(tmp_path / "photo.html")
    assert re.findall(r'alt="(\w+)"', (tmp_path / "photo.html").read_text()) == ["truth", "sensor"]


def test_pictures_are_written_and_show_themselves(lens, tmp_path):
    photo = lens.photograph(blocks())
    for name, bits in (("a.png", 8), ("new/b.tif", 16), ("c.png", 16)):
        photo.save(tmp_path / name, bits)
        found = read_pixels(tmp_path / name)
        assert found.bits == bits
        values = torch.from_numpy(found.values.astype(np.float32)).permute(2, 0, 1)
        assert (values / (2**bits - 1) - photo.image).abs().max() <= 0.501 / (2**bits - 1)
    shown = Image.open(io.BytesIO(photo._repr_png_()))
    assert np.array_equal(np.asarray(shown), read_pixels(tmp_path / "a.png").values)
    large = dolens.sensor.display.Picture(torch.rand(3, 600, 2048), torch.rand(3, 600, 2048))
    assert Image.open(io.BytesIO(large._repr_png_())).size == (1024, 300)
    assert repr(large) == "Picture of 2048×600 pixels"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"picture": "none.jpg"}, "none.jpg: no such file"),
        ({"picture": [0.5]}, "picture: of type list; allowed: a path, an array"),
        ({"picture": torch.rand(9, 9, 3)}, r"picture: a tensor of shape \(9, 9, 3\); allowed"),
        ({"picture": np.zeros((3, 9, 9))}, r"picture: an array of shape \(3, 9, 9\); allowed"),
        ({"picture": np.zeros((9, 9, 4))}, r"picture: an array of shape \(9, 9, 4\); allowed"),
        ({"picture": np.zeros((9, 9), int)}, "picture: of int64; allowed: sRGB values as uint8"),
        ({"picture": np.full((9, 9), 255.0)}, "picture: values from 255 to 255; allowed: sRGB"),
        ({"picture": np.full((9, 9), np.nan)}, "picture: values from nan to nan; allowed: sRGB"),
        ({"picture": torch.rand(3, 9, 9)}, "sensor: 9×9 pixels; allowed: 16 or more along each"),
        ({"distance": "2m"}, "distance: '2m'; allowed: above 0 mm, or infinity"),
        ({"distance": -2.0}, "distance: -2.0; allowed: above 0 mm"),
        ({"light": 0}, r"light: 0; allowed: above 0 to 1e\+09 electrons"),
        ({"read_noise": math.nan}, r"read_noise: nan; allowed: 0 to 1e\+09 electrons"),
        ({"pattern": "RGB"}, "pattern: 'RGB' is unknown; did you mean 'RGGB'"),
        ({"sensor": 36}, r"sensor: 36; allowed: its width and height in mm, as \(36, 24\)"),
        ({"sensor": (36, "24")}, "sensor: '24'; allowed: above 0 to 100000 mm"),
        ({"sensor": (900, 600)}, "sensor: .* do not pass the lens; give a smaller one"),
        ({"pixel_pitch": 0}, "pixel_pitch: 0; allowed: above 0 to 1000 mm"),
        ({"pixel_pitch": 1e-3}, "pixel_pitch: the sensor would have 607 megapixels; allowed: 64"),
        ({"diffraction": "waves"}, "diffraction: 'waves' is unknown; did you mean 'wave'"),
        ({"seed": 0.5}, "seed: 0.5; allowed: whole numbers from 0"),
    ],
)
def test_what_cannot_be_photographed_is_refused_in_one_line(lens, given, message):
    with pytest.raises(InputError, match=message):
        lens.photograph(**{"picture": blocks(), **given})


def test_what_cannot_be_restored_or_written_is_refused_in_one_line(lens, tmp_path):
    with pytest.raises(InputError, match="photograph: of type Tensor; allowed: what lens"):
        dolens.restore(blocks())
    photo = lens.photograph(blocks())
    with pytest.raises(InputError, match=r"a\.jpg: allowed endings of a picture: \.png, \.tif"):
        photo.save(tmp_path / "a.jpg")
    with pytest.raises(InputError, match="bits: 12; allowed: 8, 16"):
        photo.save(tmp_path / "a.png", bits=12)
