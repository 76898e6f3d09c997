"""Pictures of radiance: Radiance's own files, floating-point numbers, and what is refused."""

import math

import numpy as np
import pytest
import tifffile
import torch

from dolens import InputError
from dolens.sensor.radiance import radiance_picture, read_radiance_file

HEADER = b"#?RADIANCE\n# by hand\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2.0\n\n"


def shared_exponent(values):
    """Bytes of colours with the exponent that they share, by Ward's definition."""
    found = np.zeros((*values.shape[:-1], 4), np.uint8)
    for place in np.ndindex(values.shape[:-1]):
        largest = values[place].max()
        if largest > 1e-32:
            mantissa, exponent = math.frexp(largest)
            found[place][:3] = values[place] * mantissa * 256.0 / largest
            found[place][3] = exponent + 128
    return found


def packed(row):
    """A row's four bytes each by runs: one run of three, and the rest as they are."""
    width = len(row)
    out = bytes([2, 2, width >> 8, width & 255])
    for channel in row.T:
        out += bytes([128 + 3, channel[0], width - 3]) + bytes(channel[3:])
    return out


@pytest.fixture
def values():
    found = 10.0 ** np.random.default_rng(1).uniform(-3, 5, (4, 9, 3))
    found[:, :3] = found[:, :1]
    found[2, 5] = 0.0
    return found


@pytest.mark.parametrize("runs", [False, True])
def test_a_radiance_file_is_read_within_its_eight_bits(tmp_path, values, runs):
    rgbe = shared_exponent(values)
    body = b"".join(map(packed, rgbe)) if runs else rgbe.tobytes()
    path = tmp_path / "lamp.hdr"
    path.write_bytes(HEADER + b"-Y 4 +X 9\n" + body)
    found = read_radiance_file(path)
    error = np.abs(found - values).max(-1)
    assert (error <= values.max(-1) / 255.0).all()
    assert (found[2, 5] == 0.0).all()
    assert torch.equal(radiance_picture(path), torch.from_numpy(found).permute(2, 0, 1))


def test_floating_point_numbers_are_light_as_they_stand(tmp_path, values):
    wanted = torch.from_numpy(values).permute(2, 0, 1).float()
    assert torch.equal(radiance_picture(values), wanted)
    assert torch.equal(radiance_picture(wanted), wanted)
    np.save(tmp_path / "lamp.npy", values.astype(np.float32))
    tifffile.imwrite(tmp_path / "lamp.tif", values.astype(np.float32), photometric="rgb")
    for name in ("lamp.npy", "lamp.tif"):
        assert torch.equal(radiance_picture(tmp_path / name), wanted)


def test_whole_numbers_are_srgb():
    grey = np.full((2, 3), 188, np.uint8)
    assert float(radiance_picture(grey)[0, 0, 0]) == pytest.approx(0.5029, abs=1e-4)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"nothing", "is no file of Radiance; it begins with #\\?RADIANCE"),
        (HEADER.replace(b"rgbe", b"xyze") + b"-Y 4 +X 9\n", "holds XYZ; allowed: FORMAT=32"),
        (HEADER + b"+Y 4 +X 9\n", "its size is '\\+Y 4 \\+X 9'; allowed: -Y height"),
        (HEADER + b"-Y 4 +X 9\n\2\2\0\x09\x90", "cannot be decoded as Radiance"),
        (HEADER + b"-Y 40000 +X 40000\n", "megapixels"),
    ],
)
def test_what_is_no_radiance_is_refused(tmp_path, data, message):
    path = tmp_path / "lamp.hdr"
    path.write_bytes(data)
    with pytest.raises(InputError, match=message):
        radiance_picture(path)


def test_openexr_is_refused_by_name(tmp_path):
    with pytest.raises(InputError, match="OpenEXR is not read; allowed:"):
        radiance_picture(tmp_path / "lamp.exr")
