import numpy as np
import pytest
import torch
from PIL import Image

from dolens.errors import InputError
from dolens.experiments.data.folder_index import IndexFile
from dolens.experiments.data.photographs import (
    EXTENSIONS,
    Photograph,
    normalised_extensions,
    read_photograph,
)
from dolens.sensor.pictures import probe_picture


def _save(path, array, **options):
    Image.fromarray(array).save(path, **options)
    return path


def test_colour_is_kept_as_bytes(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    photo = read_photograph(_save(tmp_path / "a.png", pixels))
    assert (photo.height, photo.width) == (5, 7)
    assert torch.equal(photo.encoded, torch.from_numpy(pixels).permute(2, 0, 1))


def test_greyscale_is_repeated(tmp_path):
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    photo = read_photograph(_save(tmp_path / "a.png", pixels))
    assert torch.equal(photo.encoded, torch.from_numpy(pixels).expand(3, 3, 4))


def test_sixteen_bit_greyscale_is_rounded(tmp_path):
    pixels = np.array([[0, 128, 129, 257, 32896, 65535]], dtype=np.uint16)
    photo = read_photograph(_save(tmp_path / "a.png", pixels))
    assert photo.encoded[0].tolist() == [[0, 0, 1, 1, 128, 255]]


def test_exif_orientation_is_applied(tmp_path):
    pixels = np.zeros((2, 3, 3), dtype=np.uint8)
    pixels[0, 0] = 255
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned a quarter clockwise
    photo = read_photograph(_save(tmp_path / "a.png", pixels, exif=exif))
    assert (photo.height, photo.width) == (3, 2)
    assert photo.encoded[0].nonzero().tolist() == [[0, 1]]


def test_transparency_is_light_over_black(tmp_path):
    pixels = np.full((1, 3, 4), 255, dtype=np.uint8)
    pixels[0, :, 3] = 255, 0, 128
    photo = read_photograph(_save(tmp_path / "a.png", pixels))
    # Half the light of white is encoded as 188, not as 128.
    assert photo.encoded[0, 0].tolist() == [255, 0, 188]


def test_palette_with_a_transparent_colour(tmp_path):
    image = Image.new("P", (2, 1))
    image.putpalette([10, 20, 30, 200, 0, 0])
    image.putpixel((1, 0), 1)
    image.save(tmp_path / "a.png", transparency=1)
    assert read_photograph(tmp_path / "a.png").encoded[:, 0].T.tolist() == [[10, 20, 30], [0] * 3]


def test_cmyk(tmp_path):
    Image.new("CMYK", (8, 8), (0, 0, 0, 0)).save(tmp_path / "a.jpg")
    assert (read_photograph(tmp_path / "a.jpg").encoded > 250).all()


@pytest.mark.parametrize("content", [b"", b"no image", b"\x89PNG\r\n\x1a\n" + b"\0" * 20])
def test_broken_files_are_named(tmp_path, content):
    path = tmp_path / "broken.png"
    path.write_bytes(content)
    assert probe_picture(path)
    with pytest.raises(InputError, match=r"broken\.png: cannot be decoded") as caught:
        read_photograph(path)
    assert "\n" not in str(caught.value)


def test_missing_and_floating_point_files_are_named(tmp_path):
    with pytest.raises(InputError, match=r"none\.png: no such file"):
        read_photograph(tmp_path / "none.png")
    path = _save(tmp_path / "float.tif", np.zeros((2, 2), dtype=np.float32))
    with pytest.raises(InputError, match=r"float\.tif: floating-point"):
        read_photograph(path)


@pytest.mark.parametrize(
    "encoded",
    [torch.zeros(3, 2, 2), torch.zeros(2, 2, 3, dtype=torch.uint8)[:, :, :2]],
)
def test_a_photograph_is_three_channels_of_bytes(encoded):
    with pytest.raises(InputError, match="photograph x"):
        Photograph("x", encoded)


def test_listing_is_recursive_sorted_and_finite(tmp_path):
    for name in ("b/c/2.JPG", "b/1.png", "a.jpeg", "b/.hidden.png", "notes.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "b" / "loop").symlink_to(tmp_path)
    index = IndexFile(tmp_path, EXTENSIONS).index()
    assert list(index.names) == ["a.jpeg", "b/1.png", "b/c/2.JPG"]
    assert len(IndexFile(tmp_path, normalised_extensions(["PNG"])).index()) == 1
