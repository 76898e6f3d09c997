"""Pictures of answers, as PNG of bounded size, and lenses of prescriptions."""

import io
from typing import TYPE_CHECKING, Any

import torch
from PIL import Image
from torch import Tensor

from dolens.mcp.answer import Prescription
from dolens.plotting.export import figure_to_image
from dolens.prescriptions import lens_from_prescription

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Of a picture: bytes of its PNG, and pixels of its sides.
MOST_PICTURE_BYTES = 400_000
_WIDEST, _HIGHEST = 900, 900
_COLOURS = 128


def lens_of(prescription: Prescription) -> Any:
    """Return the lens of a prescription, which was read before, in double precision.

    Its type is open: mypy knows none of the methods that are found when they are called.
    """
    lens = lens_from_prescription(prescription, where=str(prescription.get("name", "lens")))
    return lens.requires_grad_(True)


def png_of_figure(figure: "Figure") -> bytes:
    """Return a figure as a PNG of bounded size, its colours reduced."""
    width, height = figure.get_size_inches()
    dpi = min(100.0, _WIDEST / width, _HIGHEST / height)
    pixels = figure_to_image(figure, dpi).permute(1, 2, 0).numpy()
    return png_of_pixels(Image.fromarray(pixels), _COLOURS)


def png_of_sensor(image: Tensor) -> bytes:
    """Return a sensor image (3, H, W), sRGB from 0 to 1, as a PNG of bounded size."""
    values = (255.0 * image.clamp(0.0, 1.0)).round().to(torch.uint8)
    return png_of_pixels(Image.fromarray(values.permute(1, 2, 0).cpu().numpy()))


def png_of_pixels(image: Image.Image, colours: int | None = None) -> bytes:
    """Return an image as a PNG of bounded size: it becomes smaller until it fits.

    Args:
        image: RGB.
        colours: that it is reduced to; None: all stay.
    """
    image.thumbnail((_WIDEST, _HIGHEST))
    while True:
        buffer = io.BytesIO()
        kept = image if colours is None else image.quantize(colours, dither=Image.Dither.NONE)
        kept.save(buffer, "PNG", optimize=True)
        if buffer.tell() <= MOST_PICTURE_BYTES:
            return buffer.getvalue()
        image = image.resize((max(1, image.width * 3 // 4), max(1, image.height * 3 // 4)))
