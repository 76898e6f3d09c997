"""Pictures are read as the light that they mean, or refused."""

import io
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageCms, ImageOps
from torch import Tensor

from dolens.errors import InputError
from dolens.sensor.colour import linear_to_srgb, srgb_to_linear
from dolens.sensor.image_files import (
    MEGAPIXELS,
    PLAIN,
    deep_png,
    format_of,
    opened_image,
    png_meaning,
    tiff_page,
    tiff_samples,
    tiff_words,
)

# Colour samples by TIFF's photometric interpretation: white is zero, black is zero, RGB, CMYK.
_COLOURS = {0: 1, 1: 1, 2: 3, 5: 4}
_WHITE_IS_ZERO, _CMYK, _YCBCR = 0, 5, 6
# Interpretations that Pillow reads in up to 8 bits: palettes, masks, YCbCr and CIELab besides.
_SHALLOW = (0, 1, 2, 3, 4, 5, 6, 8)
_JPEG = (6, 7)
_ASSOCIATED, _UNASSOCIATED = 1, 2
# Transfer functions of PNG's cICP, by ITU-T H.273: BT.709's and sRGB's; linear.
_SRGB_LIKE, _LINEAR = (1, 6, 13, 14), 8
_ORIENTATION = 274
# What Pillow does for each EXIF orientation; 1 is upright.
_TURNS: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: a.swapaxes(0, 1)[:, ::-1],
    7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
    8: lambda a: a.swapaxes(0, 1)[::-1],
}
# Pixels that are converted at once.
_BAND = 1 << 20
_FRAMES = "it holds several frames: the first is taken"
_INKS = "its inks are taken as ideal: light is (1 - ink) (1 - black)"
_DARK = "none of its 16-bit values is above 4095: where 12 bits are meant, they are read too dark"


@dataclass(frozen=True)
class Pixels:
    """Pixels of a picture, upright, as integers, and what they mean.

    Attributes:
        values: (height, width, 1 or 3) uint8 or uint16, grey or RGB, not multiplied by alpha; full
            light is the largest value of the dtype.
        alpha: (height, width, 1), of the same dtype; None: opaque.
        gamma: values are light to this power; None: they are sRGB-encoded.
        notes: what of the file was not taken as it stands, a sentence each.
    """

    values: np.ndarray
    alpha: np.ndarray | None = None
    gamma: float | None = None
    notes: tuple[str, ...] = ()

    @property
    def bits(self) -> int:
        """Return the bits of each value, 8 or 16."""
        return 8 * self.values.dtype.itemsize

    def linear(self) -> Tensor:
        """Return (3, height, width) float32, linear light in [0, 1], over black."""
        table = self._light_of_values().astype(np.float32)
        if self.alpha is None:
            return _channels_first(table[self.values])
        full = np.float32(2**self.bits - 1)
        return _channels_first(_banded(lambda v, a: table[v] * (a / full), self.values, self.alpha))

    def encoded(self) -> Tensor:
        """Return (3, height, width) uint8, sRGB-encoded, over black.

        Transparency is composited in linear light: black sends none.
        """
        table = self._light_of_values()
        opaque = self.alpha is None or bool((self.alpha == 2**self.bits - 1).all())
        if not opaque:
            full = 2**self.bits - 1.0
            covered = _banded(
                lambda v, a: _eight_bits(table[v] * (a / full)), self.values, self.alpha
            )
            return _channels_first(covered)
        if self.bits == 8 and self.gamma is None:
            return _channels_first(self.values)
        return _channels_first(_eight_bits(table)[self.values])

    def _light_of_values(self) -> np.ndarray:
        """Return the light of each value that there can be, float64."""
        encoded = torch.linspace(0.0, 1.0, 2**self.bits, dtype=torch.float64)
        if self.gamma is None:
            return srgb_to_linear(encoded).numpy()
        return (encoded ** (1.0 / self.gamma)).numpy()


def read_pixels(path: str | Path, megapixels: float = MEGAPIXELS) -> Pixels:
    """Read a picture, as its file means it.

    EXIF's orientation is applied, palettes are looked up, CMYK becomes RGB by (1 - ink) (1 - black)
    and CIELab of 8 bits by LittleCMS; premultiplied colours are divided by alpha, and white that is
    zero is inverted.  A PNG's gAMA and transparent colour hold.  16 bits are kept (colour in a TIFF
    whose compression Pillow alone undoes has 8 of them).  Of several frames the first is read, a
    colour profile is ignored: `notes` say so.

    Args:
        path: BMP, GIF, JPEG, PNG, PPM, TIFF or WebP.
        megapixels: the largest that is read, millions of pixels.

    Raises:
        InputError: the file is missing, broken, too large, or holds what has no meaning here, such
            as floating-point pixels or CIELab of 16 bits.
    """
    kind = format_of(path)
    if kind == "TIFF":
        return _tiff_pixels(path, megapixels)
    meaning = png_meaning(path) if kind == "PNG" else {}
    deep = kind == "PNG" and meaning[b"IHDR"][8] == 16
    with opened_image(path, megapixels) as image:
        profile = _profile_notes(image.info.get("icc_profile"))
        gamma, of_gamma = _png_gamma(path, meaning, bool(profile))
        notes = profile + of_gamma + _image_notes(image)
        turn = image.getexif().get(_ORIENTATION, 1) if deep else 1
        values = deep_png(path, image) if deep else _as_pillow_reads(path, image)
    values, alpha = _apart(values)
    if kind == "PNG" and meaning[b"IHDR"][9] in (0, 2) and b"tRNS" in meaning:
        alpha = _but_for_one_colour(values, meaning)
    return _pixels(values, alpha, turn, gamma, notes)


def probe_picture(path: str | Path, megapixels: float = MEGAPIXELS) -> str | None:
    """Read a picture's header without decoding its pixels.

    Returns:
        Why the file cannot be read, in one line, or None when the header is sound.  A file that is
        cut off after its header passes, and fails in `read_pixels`.
    """
    try:
        if format_of(path) == "TIFF":
            with tiff_page(path, megapixels) as page:
                _check_tiff(path, page)
        else:
            with opened_image(path, megapixels) as image:
                image.verify()
    except InputError as error:
        return error.whole.removeprefix(f"{path}: ")
    return None


def _pixels(
    values: np.ndarray,
    alpha: np.ndarray | None,
    turn: Any,
    gamma: float | None,
    notes: tuple[str, ...],
) -> Pixels:
    if values.dtype == np.uint16 and 0 < values.max() <= 4095:
        notes = (*notes, _DARK)
    turned = _TURNS.get(turn if isinstance(turn, int) else 1, lambda a: a)
    values = np.ascontiguousarray(turned(values))
    alpha = None if alpha is None else np.ascontiguousarray(turned(alpha))
    return Pixels(values, alpha, gamma, notes)


def _as_pillow_reads(path: str | Path, image: Image.Image) -> np.ndarray:
    """Return an image's pixels as Pillow converts them, upright.

    They are grey of 8 or 16 bits, or RGB or RGBA of 8, (height, width, channels).
    """
    if image.mode == "F":
        raise InputError(f"{path}: floating-point pixels; allowed: 8-bit or 16-bit integers")
    upright = ImageOps.exif_transpose(image)
    if upright.mode.startswith("I"):
        grey = np.asarray(upright)
        if grey.min() < 0 or grey.max() > 65535:
            raise InputError(f"{path}: pixels beyond 0 to 65535; allowed: 8-bit or 16-bit integers")
        return grey.astype(np.uint16)[..., None]
    if upright.mode in ("1", "L"):
        return np.array(upright.convert("L"))[..., None]
    # One transparent colour of a PNG is looked at by its own values.
    transparent = upright.mode != "RGB" and upright.has_transparency_data
    if upright.mode == "La":
        return _straight(np.array(upright))
    return np.array(upright.convert("RGBA" if transparent else "RGB"))


def _profile_notes(profile: bytes | None) -> tuple[str, ...]:
    """A sentence where an embedded colour profile is none of sRGB."""
    if not profile:
        return ()
    try:
        name = ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(profile))).strip()
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError):
        name = ""
    if "srgb" in name.lower():
        return ()
    return (f"its colour profile, {name or 'unnamed'}, is ignored: values are taken as sRGB",)


def _image_notes(image: Image.Image) -> tuple[str, ...]:
    notes = (_FRAMES,) if getattr(image, "is_animated", False) else ()
    return (*notes, _INKS) if image.mode == "CMYK" else notes


def _apart(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Return colour and alpha, which is the last of two or four channels."""
    if samples.shape[-1] in (2, 4):
        return samples[..., :-1], samples[..., -1:]
    return samples, None


# ---------------------------------------------------------------- arithmetic


def _banded(function: Callable[..., np.ndarray], *arrays: Any) -> np.ndarray:
    """Apply a function of pixels to bands of rows, one after another, to save memory."""
    rows = max(1, _BAND // arrays[0].shape[1])
    begins = range(0, len(arrays[0]), rows)
    return np.concatenate([function(*(a[b : b + rows] for a in arrays)) for b in begins])


def _channels_first(pixels: np.ndarray) -> Tensor:
    return torch.from_numpy(pixels).permute(2, 0, 1).expand(3, -1, -1).contiguous()


def _eight_bits(light: np.ndarray) -> np.ndarray:
    return (linear_to_srgb(torch.from_numpy(light)) * 255.0).round().to(torch.uint8).numpy()


def _straight(samples: np.ndarray) -> np.ndarray:
    """Divide colours by the alpha that they were multiplied by; the last channel is alpha."""
    top = np.iinfo(samples.dtype).max

    def divided(part: np.ndarray) -> np.ndarray:
        alpha = part[..., -1:].astype(np.uint32)
        colour = (part[..., :-1] * np.uint32(top) + alpha // 2) // np.maximum(alpha, 1)
        return np.concatenate([np.minimum(colour, top), alpha], -1).astype(samples.dtype)

    return _banded(divided, samples)


def _of_inks(samples: np.ndarray) -> np.ndarray:
    """Return RGB of 16 bits: (1 - ink) (1 - black)."""

    def light(part: np.ndarray) -> np.ndarray:
        left = np.uint32(65535) - part
        return ((left[..., :3] * left[..., 3:] + 32767) // 65535).astype(np.uint16)

    return _banded(light, samples)


# ---------------------------------------------------------------- PNG


def _png_gamma(
    path: str | Path, meaning: dict[bytes, bytes], other_profile: bool
) -> tuple[float | None, tuple[str, ...]]:
    """Return the power that values are of light, None for sRGB, and a sentence where it is used.

    Of what a PNG says cICP comes first, then iCCP, sRGB and gAMA, as its specification has it; a
    profile other than sRGB's is passed over.
    """
    transfer = meaning.get(b"cICP", b"")[1:2]
    if transfer and transfer[0] == _LINEAR:
        return 1.0, ("its cICP says that values are linear light, and so they are taken",)
    if transfer and transfer[0] not in _SRGB_LIKE:
        raise InputError(
            f"{path}: transfer function {transfer[0]} of its cICP is not read; allowed: those of "
            "sRGB, BT.709 and linear light"
        )
    profiled = b"iCCP" in meaning and not other_profile
    if transfer or profiled or b"sRGB" in meaning or b"gAMA" not in meaning:
        return None, ()
    gamma = int.from_bytes(meaning[b"gAMA"], "big") / 1e5
    if not 0.05 <= gamma <= 20.0:
        raise InputError(f"{path}: gAMA of {gamma:g}; allowed: 0.05 to 20")
    if abs(gamma - 1.0 / 2.2) < 0.01:  # what writers give for sRGB
        return None, ()
    return gamma, (f"its gAMA says that values are light to the power {gamma:g}: so it is read",)


def _but_for_one_colour(values: np.ndarray, meaning: dict[bytes, bytes]) -> np.ndarray:
    """Return alpha: none where a pixel has the transparent colour of tRNS, and full elsewhere."""
    named = np.frombuffer(meaning[b"tRNS"][: 2 * values.shape[-1]], ">u2").astype(np.int64)
    top = np.iinfo(values.dtype).max
    named = named * top // (2 ** meaning[b"IHDR"][8] - 1)  # grey of 1, 2 and 4 bits is read as 8
    return _banded(lambda v: (v != named).any(-1, keepdims=True) * values.dtype.type(top), values)


# ---------------------------------------------------------------- TIFF


def _check_tiff(path: str | Path, page: Any) -> int | None:
    """Return the colour samples of 16 bits that a page has; None: Pillow reads the page.

    Raises:
        InputError: it holds what is not read.
    """
    kind, bits = int(page.photometric), page.bitspersample
    allowed = "allowed: grey, RGB or CMYK of 8 or 16 bits; palettes, CIELab and YCbCr of 8"
    if page.sampleformat == 3:
        raise InputError(f"{path}: floating-point pixels; {allowed}")
    if kind == _CMYK and page.tags.valueof("InkSet", default=1) != 1:
        raise InputError(f"{path}: inks other than CMYK; {allowed}")
    if kind == _YCBCR and int(page.compression) not in _JPEG:
        numbers = page.tags.valueof("ReferenceBlackWhite", default=(0, 1, 255, 1, 128, 1) * 2)
        # (0, 255, 128, 255, 128, 255), as fractions
        levels = [
            a / b if b else math.nan for a, b in zip(numbers[::2], numbers[1::2], strict=True)
        ]
        if page.subsampling != (1, 1) or levels[:2] != [0.0, 255.0]:
            raise InputError(f"{path}: YCbCr that is subsampled or of another range; {allowed}")
    if page.sampleformat == 1 and bits in (1, 2, 4, 8) and kind in _SHALLOW:
        return None
    colours = _COLOURS.get(kind, math.inf)
    if page.dtype != np.uint16 or bits != 16 or page.samplesperpixel < colours:
        raise InputError(f"{path}: {tiff_words(page)}; {allowed}")
    return int(colours)


def _tiff_pixels(path: str | Path, megapixels: float) -> Pixels:
    with tiff_page(path, megapixels) as page:
        colours = _check_tiff(path, page)
        extra = [int(kind) for kind in page.extrasamples]
        has_alpha = bool({_ASSOCIATED, _UNASSOCIATED} & set(extra))
        notes = _profile_notes(page.tags.valueof("InterColorProfile"))
        if page.parent.pages.is_multipage:
            notes += (_FRAMES,)
        if int(page.photometric) == _CMYK:
            notes += (_INKS,)
        if page.samplesperpixel - _COLOURS.get(int(page.photometric), math.inf) > has_alpha:
            notes += ("a sample beside its colours has no stated meaning, and is left out",)
        largest = int(np.max(page.tags.valueof("MaxSampleValue", default=65535)))
        white = largest if largest in [2**n - 1 for n in range(9, 16)] else 65535
        inverted = int(page.photometric) == _WHITE_IS_ZERO
        if colours and int(page.compression) in PLAIN:
            samples = tiff_samples(path, page)
            turn = page.tags.valueof("Orientation", default=1)
        else:
            name = getattr(page.compression, "name", page.compression)
            with opened_image(path, megapixels) as image:
                samples = _as_pillow_reads(path, image)
            if colours and samples.dtype == np.uint8:
                notes += (f"of its 16 bits 8 are read, for its compression is {name}",)
            # Pillow takes a fourth sample that nothing names for alpha, and leaves I;16 as it is.
            values, alpha = _apart(samples)
            if inverted and values.dtype == np.uint16:
                values = 65535 - values
            return _pixels(values, alpha if has_alpha else None, 1, None, notes)
    if white != 65535 and samples[..., :colours].max() <= white:
        samples = _banded(lambda s: np.minimum(s * 65535.0 / white + 0.5, 65535), samples)
        samples = samples.astype(np.uint16)
        notes += (f"its largest value is said to be {white}, which is taken for white",)
    values, alpha = samples[..., :colours], None
    for kind, sample in zip(extra, np.moveaxis(samples[..., colours:], -1, 0), strict=False):
        if kind in (_ASSOCIATED, _UNASSOCIATED):
            alpha = sample[..., None]
            if kind == _ASSOCIATED:
                values = _straight(np.concatenate([values, alpha], -1))[..., :-1]
            break
    if colours == 4:
        values = _of_inks(values)
    return _pixels(65535 - values if inverted else values, alpha, turn, None, notes)
