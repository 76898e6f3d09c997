"""Image files are read as the light that they mean, or refused in one line."""

import os
import resource
import struct
import zlib

import numpy as np
import pytest
import tifffile
from PIL import Image

from dolens.errors import InputError
from dolens.sensor.image_files import read_numbers
from dolens.sensor.pictures import probe_picture, read_pixels

CYAN, GREY = (0, 255, 255), (199, 199, 199)
COVERED = (146, 146, 146)  # of grey 199 with alpha 128, in linear light over black
INKS = np.array([255, 0, 0, 0])
ALPHA = np.array([199, 199, 199, 128])
TIMES_ALPHA = np.array([100, 100, 100, 128])


def tiff(samples, **options):
    """A writer of a TIFF of one colour, of 8 bits or of 16 that mean the same."""

    def write(path, bits):
        values = np.broadcast_to(np.asarray(samples), (16, 16, np.size(samples)))
        values = values[..., 0] if np.size(samples) == 1 else values
        kind, scale = (np.uint8, 1) if bits == 8 else (np.uint16, 257)
        tifffile.imwrite(path, (values * scale).astype(kind), metadata=None, **options)

    return write


def png(samples, colour, *chunks):
    """A writer of a PNG of one colour, whose 16-bit values mean the same as those of 8 bits."""

    def write(path, bits):
        values = np.broadcast_to(np.asarray(samples), (16, 16, np.size(samples)))
        wide = values.astype(np.uint8) if bits == 8 else (values * 257).astype(">u2")
        rows = np.ascontiguousarray(wide).view(np.uint8).reshape(16, -1)
        data = np.hstack([np.zeros((16, 1), np.uint8), rows]).tobytes()
        scaled = [(name, make(1 if bits == 8 else 257)) for name, make in chunks]
        path.write_bytes(png_of(16, 16, bits, colour, data, scaled))

    return write


def png_of(width, height, bits, colour, data, chunks=()):
    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    parts = ((b"IHDR", header), *chunks, (b"IDAT", zlib.compress(data)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(content))
        + name
        + content
        + struct.pack(">I", zlib.crc32(name + content))
        for name, content in parts
    )


def transparent(*colour):
    return (b"tRNS", lambda scale: b"".join(struct.pack(">H", v * scale) for v in colour))


def gamma(value):
    return (b"gAMA", lambda scale: struct.pack(">I", round(value * 1e5)))


SEPARATED = {"photometric": "separated"}
RGB = {"photometric": "rgb"}
# A writer of 8 or 16 bits, what both mean in sRGB, and a word that is said of it.
KINDS = {
    "RGB": (tiff(CYAN, **RGB), CYAN, ""),
    "grey": (tiff([199], photometric="minisblack"), GREY, ""),
    "white is zero": (tiff([56], photometric="miniswhite"), GREY, ""),
    "CMYK": (tiff(INKS, **SEPARATED), CYAN, "inks"),
    "CMYK, white paper": (tiff(0 * INKS, **SEPARATED), (255,) * 3, "inks"),
    "CMYK, by planes": (tiff(INKS, **SEPARATED, compression="zlib"), CYAN, "inks"),
    "alpha": (tiff(ALPHA, **RGB, extrasamples=["unassalpha"]), COVERED, ""),
    "premultiplied": (tiff(TIMES_ALPHA, **RGB, extrasamples=["assocalpha"]), COVERED, ""),
    "a fourth sample": (tiff([*GREY, 0], **RGB, extrasamples=["unspecified"]), GREY, "left out"),
    "PNG": (png(CYAN, 2), CYAN, ""),
    "PNG, grey and alpha": (png([199, 128], 4), COVERED, ""),
    "PNG, transparent colour": (png((10, 20, 30), 2, transparent(10, 20, 30)), (0, 0, 0), ""),
    "PNG, transparent grey": (png([100], 0, transparent(100)), (0, 0, 0), ""),
    "PNG, another transparent colour": (png(CYAN, 2, transparent(1, 2, 3)), CYAN, ""),
    "PNG, linear": (png([128] * 3, 2, gamma(1.0)), (188,) * 3, "power 1"),
    "PNG, gamma of sRGB": (png(GREY, 2, gamma(0.45455)), GREY, ""),
    "PNG, sRGB before gamma": (
        png(GREY, 2, (b"sRGB", lambda scale: b"\0"), gamma(1.0)), GREY, "",
    ),
    "PNG, linear by cICP": (
        png([128] * 3, 2, (b"cICP", lambda scale: bytes([1, 8, 0, 1]))), (188,) * 3, "cICP",
    ),
}  # fmt: skip


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("kind", KINDS)
def test_a_picture_is_read_as_its_file_means_it(tmp_path, kind, bits):
    """Colours are known, and 16 bits mean what 8 bits do."""
    write, colour, word = KINDS[kind]
    write(tmp_path / "a.tif", bits)  # by its content, whatever its name
    pixels = read_pixels(tmp_path / "a.tif")
    assert pixels.bits == bits and probe_picture(tmp_path / "a.tif") is None
    assert pixels.encoded()[:, 3, 5].tolist() == list(colour)
    assert bool(word) == bool(pixels.notes) and word in " ".join(pixels.notes)


def test_twelve_bits_in_sixteen_are_scaled_where_the_file_says_so(tmp_path):
    values = np.full((16, 16, 3), 4095, np.uint16)
    said = [(281, "H", 3, (4095,) * 3, True)]  # MaxSampleValue
    tifffile.imwrite(tmp_path / "said.tif", values, photometric="rgb", extratags=said)
    tifffile.imwrite(tmp_path / "unsaid.tif", values, photometric="rgb")
    found = read_pixels(tmp_path / "said.tif")
    assert (found.linear() == 1.0).all() and "4095" in found.notes[0]
    assert "12 bits" in read_pixels(tmp_path / "unsaid.tif").notes[0]


@pytest.mark.parametrize("depth", [1, 2, 4])
def test_the_transparent_grey_of_few_bits_is_the_file_s(tmp_path, depth):
    width = 8 // depth
    data = b"".join(b"\0" + bytes([1 << (8 - depth)]) for _ in range(4))
    chunk = (b"tRNS", struct.pack(">H", 1))
    (tmp_path / "a.png").write_bytes(png_of(width, 4, depth, 0, data, [chunk]))
    alpha = read_pixels(tmp_path / "a.png").alpha[0, :, 0]
    assert alpha.tolist() == [0, *[255] * (width - 1)]


def test_frames_and_profiles_are_told(tmp_path):
    frames = [Image.new("RGB", (16, 16), c) for c in ("red", "lime")]
    for name in ("a.gif", "a.png", "a.webp", "a.tif"):
        options = {"lossless": True} if name == "a.webp" else {}
        frames[0].save(tmp_path / name, save_all=True, append_images=frames[1:], **options)
        found = read_pixels(tmp_path / name)
        assert found.encoded()[:, 0, 0].tolist() == [255, 0, 0]
        assert any("first is taken" in note for note in found.notes), name


def bomb(path):
    path.write_bytes(png_of(60_000, 60_000, 16, 2, b"\0" * 1000))


def tiff_bomb(path):
    """A header of 40000×40000 pixels of 16 bits without any."""
    tiff(CYAN, **RGB)(path, 16)
    data = bytearray(path.read_bytes())
    for tag in (256, 257):
        at = data.index(
            struct.pack("<HH", tag, 4)
            if struct.pack("<HH", tag, 4) in data
            else struct.pack("<HH", tag, 3)
        )
        data[at : at + 12] = struct.pack("<HHII", tag, 4, 1, 40_000)
    path.write_bytes(data)


def deflate_bomb(path):
    """A strip of 16×16 pixels that unpacks to 200 MB."""
    tiff(CYAN, **RGB, compression="zlib")(path, 16)
    data = bytearray(path.read_bytes())
    strip = zlib.compress(bytes(200_000_000), 9)
    for tag, value in ((273, len(data)), (279, len(strip))):
        at = next(
            n
            for n in range(len(data))
            if data[n : n + 4] in (struct.pack("<HH", tag, k) for k in (3, 4))
        )
        data[at : at + 12] = struct.pack("<HHII", tag, 4, 1, value)
    path.write_bytes(bytes(data) + strip)


def cut_tiff(path):
    tiff(CYAN, **RGB)(path, 16)
    path.write_bytes(path.read_bytes()[:-200])


def without_strips(path):
    tiff(CYAN, **RGB)(path, 16)
    data = bytearray(path.read_bytes())
    at = next(
        n for n in range(len(data)) if data[n : n + 4] in (b"\x17\x01\x04\0", b"\x17\x01\x03\0")
    )
    data[at : at + 12] = struct.pack("<HHII", 279, 4, 1, 0)
    path.write_bytes(data)


LAB = np.full((16, 16, 3), 65535, np.uint16)
POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n"
SIGNED, FLOATS = LAB.astype(np.int8), LAB.astype(np.float32)
MAP = np.zeros((3, 65536), np.uint16)
REFUSED = {
    "PostScript": (lambda p: p.write_bytes(POSTSCRIPT), "no image"),
    "CIELab": (lambda p: tifffile.imwrite(p, LAB, photometric="cielab"), "CIELAB of 16 bits"),
    "ICCLab": (lambda p: tifffile.imwrite(p, LAB, photometric="icclab"), "ICCLAB of 16 bits"),
    "YCbCr": (lambda p: tifffile.imwrite(p, LAB, photometric="ycbcr"), "YCbCr|YCBCR"),
    "palette": (
        lambda p: tifffile.imwrite(p, LAB[..., 0], photometric="palette", colormap=MAP),
        "PALETTE of 16 bits",
    ),
    "signed": (lambda p: tifffile.imwrite(p, SIGNED, photometric="rgb"), "RGB of 8 bits"),
    "floats": (lambda p: tifffile.imwrite(p, FLOATS, photometric="rgb"), "floating"),
    "PQ": (png(CYAN, 2, (b"cICP", lambda scale: bytes([9, 16, 0, 1]))), "cICP"),
    "no gamma": (png(CYAN, 2, gamma(0.0)), "gAMA of 0"),
    "PNG bomb": (bomb, "3600 million pixels; allowed: up to 64, the setting megapixels"),
    "TIFF bomb": (tiff_bomb, "1600 million pixels"),
    "Deflate bomb": (deflate_bomb, "unpacks to more"),
    "cut TIFF": (cut_tiff, "cannot be decoded"),
    "TIFF without strips": (without_strips, "missing|cannot be decoded"),
    "pipe": (os.mkfifo, "is no file"),
    "device": (lambda p: p.symlink_to("/dev/zero"), "is no file"),
    "folder": (os.mkdir, "is no file"),
    "nothing": (lambda p: None, "no such file"),
    "a link into a circle": (lambda p: p.symlink_to(p), "cannot be read"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_read_is_one_line(tmp_path, case):
    write, message = REFUSED[case]
    path = tmp_path / "a.png"
    write(path, 16) if write.__qualname__.startswith("png.") else write(path)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=message) as caught:
        read_pixels(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    if case != "Deflate bomb":  # written here
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


@pytest.mark.parametrize("name", ["x" * 300, "a\0b", "a\ud800b"])
def test_names_that_no_file_can_have_are_one_line(tmp_path, name):
    for read in (read_pixels, read_numbers):
        with pytest.raises(InputError, match=r"no such file|cannot be read") as caught:
            read(tmp_path / name)
        str(caught.value).encode()  # can be printed


NUMBERS = {
    "palette": (lambda p: Image.new("P", (16, 16)).save(p, "PNG"), "a palette's colours"),
    "few bits": (lambda p: Image.new("1", (16, 16)).save(p, "PNG"), "1 bits"),
    "palette of TIFF": (lambda p: Image.new("P", (16, 16)).save(p, "TIFF"), "PALETTE"),
    "white is zero": (lambda p: tiff([9], photometric="miniswhite")(p, 16), "MINISWHITE"),
    "CMYK": (lambda p: tiff(INKS, **SEPARATED)(p, 16), "SEPARATED"),
    "JPEG": (lambda p: Image.new("L", (16, 16)).save(p, "JPEG"), "from JPEG"),
    "array of objects": (lambda p: np.save(p.open("wb"), np.array([[p]], object)), "decoded"),
    "array of a header": (
        lambda p: np.lib.format.write_array_header_1_0(
            p.open("wb"), {"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**6)}
        ),
        "cannot be decoded",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", NUMBERS)
def test_numbers_are_those_of_the_file_or_refused(tmp_path, case):
    write, message = NUMBERS[case]
    write(tmp_path / "a.png")
    with pytest.raises(InputError, match=message):
        read_numbers(tmp_path / "a.png")


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_numbers_are_not_scaled(tmp_path, kind):
    numbers = np.arange(256).reshape(16, 16).astype(kind)
    np.save(tmp_path / "a.npy", numbers)
    tifffile.imwrite(tmp_path / "a.tif", numbers, photometric="minisblack")
    names = ["a.npy", "a.tif"]
    if kind != np.float32:
        Image.fromarray(numbers).save(tmp_path / "a.png")
        names.append("a.png")
    for name in names:
        found = read_numbers(tmp_path / name)
        assert np.array_equal(found, numbers) and found.dtype == kind
    with pytest.raises(InputError, match=r"up to 0\.0001, the setting megapixels"):
        read_numbers(tmp_path / "a.tif", megapixels=1e-4)
