"""Pictures within the page."""

import base64
import io
from pathlib import Path

from PIL import Image

from dolens.sensor.image_files import opened_image

# Twice what the page is wide, for sharp screens and for enlarging.
_WIDEST = 1600
_QUALITY = 90


def embedded(path: Path) -> str:
    """Return a picture as an address that holds its bytes.

    A picture wider than 1600 pixels is reduced.  Of WebP without loss and with quality 90 the
    smaller is taken: drawings are smaller without loss, photographs with it.

    Args:
        path: BMP, GIF, JPEG, PNG, PPM, TIFF or WebP.
    """
    with opened_image(path) as image:
        picture = image.convert("RGB")
    if picture.width > _WIDEST:
        height = round(picture.height * _WIDEST / picture.width)
        picture = picture.resize((_WIDEST, height), Image.Resampling.LANCZOS)
    written = []
    for options in ({"lossless": True}, {"quality": _QUALITY}):
        stream = io.BytesIO()
        picture.save(stream, "WEBP", **options)
        written.append(stream.getvalue())
    return "data:image/webp;base64," + base64.b64encode(min(written, key=len)).decode("ascii")


def size_of(path: Path) -> tuple[int, int]:
    """Return width and height of a picture in pixels."""
    with opened_image(path) as image:
        return image.size
