"""A page of photographs is one file that needs nothing else, and opens without a server."""

import base64
import io
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from dolens.errors import InputError, readable
from dolens.files import installed_version, written_whole

logger = logging.getLogger(__name__)

_TEMPLATE = Path(__file__).with_name("page.html")
PAGE = "photographs.html"
"""The name of a page in a folder of results."""

# Pixels of each kind of picture on a page, all photographs together: three kinds take some 24 MB.
_MOST_PIXELS = 3_200_000
# Pixels along each side of the detail that stands beside a photograph that is reduced.
_DETAIL = 512


@dataclass(frozen=True)
class ShownPhotograph:
    """A photograph on a page.

    Attributes:
        name: of it.
        pictures: label, as `truth`, `sensor` and `restored`, → (3, H, W), sRGB values from 0 to 1,
            all of one size.
        metrics: name with its unit → number.
        note: a sentence about it.
    """

    name: str
    pictures: Mapping[str, Tensor]
    metrics: Mapping[str, float] = field(default_factory=dict)
    note: str = ""


@dataclass(frozen=True)
class _Embedded:
    """A photograph as the template takes it."""

    name: str
    addresses: Mapping[str, str]
    metrics: Mapping[str, float]
    note: str


class PhotographPage:
    """Collects photographs for a page on which a slider and a magnifier compare them.

    Pixels stand in it without loss.  Where photographs are many or large, those that do not fit
    into some 24 MB are reduced by a whole number, and a detail of each is added at full size; the
    page and the log say so.

    Args:
        count: of the photographs that will be added.
    """

    def __init__(self, count: int) -> None:
        self._room = _MOST_PIXELS // max(count, 1)
        self._photographs: list[_Embedded] = []

    def add(self, photograph: ShownPhotograph) -> None:
        """Add a photograph; its tensors are not kept."""
        parts = _parts(photograph, self._room)
        if len(parts) > 1:
            logger.info("%s: on the page %s", readable(photograph.name), parts[0].note)
        for part in parts:
            pictures = {label: address_of(image) for label, image in part.pictures.items()}
            self._photographs.append(_Embedded(part.name, pictures, part.metrics, part.note))

    def write(self, path: str | Path, title: str, notes: Sequence[str] = ()) -> None:
        """Write the page, whole or not at all.

        Args:
            path: of the file; its folder exists.
            title: of the page.
            notes: sentences about all photographs.

        Raises:
            InputError: nothing was added.
        """
        if not self._photographs:
            raise InputError(f"{path}: there are no photographs to show")
        from dolens.html import rendered  # loads jinja2, which pictures do without

        page = rendered(
            _TEMPLATE,
            filters={"number": number_text},
            title=title,
            notes=notes,
            photographs=self._photographs,
            metrics=list(dict.fromkeys(name for p in self._photographs for name in p.metrics)),
            version=installed_version("dolens") or "",
        )
        with written_whole(Path(path)) as aside:
            aside.write_text(page, encoding="utf-8")


def _parts(photograph: ShownPhotograph, room: int) -> list[ShownPhotograph]:
    """Return a photograph, or where it is too large a reduced one and a detail of full size."""
    height, width = next(iter(photograph.pictures.values())).shape[-2:]
    if height * width <= room:
        return [photograph]
    side = min(_DETAIL, int(math.sqrt(room / 4.0)), height, width)
    times = math.ceil(math.sqrt(height * width / (room - side * side)))
    small = {label: reduced(image, times) for label, image in photograph.pictures.items()}
    top, left = most_detailed(next(iter(photograph.pictures.values())), side)
    part = (slice(None), slice(top, top + side), slice(left, left + side))
    place = f"rows {top} to {top + side}, columns {left} to {left + side}"
    notes = (
        f"{width}×{height} pixels are shown as means of {times}×{times}; numbers are those of all.",
        f"{side}×{side} of {width}×{height} pixels at full size: {place}.",
    )
    named = [" ".join(filter(None, (photograph.note, note))) for note in notes]
    detail = {label: image[part] for label, image in photograph.pictures.items()}
    return [
        ShownPhotograph(photograph.name, small, photograph.metrics, named[0]),
        ShownPhotograph(f"{photograph.name}, detail", detail, {}, named[1]),
    ]


def reduced(image: Tensor, times: int) -> Tensor:
    """Return an image (3, H, W) whose pixels are means of `times`×`times` of its own."""
    found = image.detach()[None].float()
    return torch.nn.functional.avg_pool2d(found, times, ceil_mode=True, count_include_pad=False)[0]


def most_detailed(image: Tensor, side: int) -> tuple[int, int]:
    """Return the first row and column of the square whose neighbouring pixels differ most.

    Args:
        image: (3, H, W).
        side: of the square, pixels; squares are tried in steps of a quarter of it.
    """
    grey = image.detach().float().mean(dim=0, keepdim=True)
    detail = grey.diff(dim=-1)[:, :-1].square() + grey.diff(dim=-2)[..., :-1].square()
    step = max(1, side // 4)
    size = min(side, *detail.shape[-2:])
    sums = torch.nn.functional.avg_pool2d(detail[None], size, stride=step)[0, 0]
    row, column = divmod(int(sums.argmax()), sums.shape[1])
    return row * step, column * step


def picture_bytes(image: Tensor, lossless: bool = True) -> bytes:
    """Return an image (3, H, W), sRGB values from 0 to 1, as WebP.

    Args:
        image: values outside are clipped.
        lossless: at eight bits; else of quality 90.
    """
    pixels = (image.detach().cpu().float().clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
    buffer = io.BytesIO()
    # The quickest: less effort makes the file a tenth larger.
    options = {"lossless": True, "quality": 0} if lossless else {"quality": 90}
    array = np.ascontiguousarray(pixels.permute(1, 2, 0).numpy())
    Image.fromarray(array).save(buffer, "WEBP", method=0, **options)
    return buffer.getvalue()


def address_of(image: Tensor) -> str:
    """Return an image (3, H, W), sRGB values from 0 to 1, as an address that holds it, lossless."""
    return "data:image/webp;base64," + base64.b64encode(picture_bytes(image)).decode("ascii")


def number_text(value: float) -> str:
    """Return a number of a table: decibels to a hundredth, what is at most one to a thousandth."""
    if not math.isfinite(value):
        return "∞" if value > 0.0 else "–"
    return f"{value:.3f}" if abs(value) <= 1.0 else f"{value:.2f}"


def shown_scores(metrics: Mapping[str, float]) -> dict[str, float]:
    """Return the scores of a photograph by their names on a page.

    Args:
        metrics: `raw_psnr_db`, `raw_ssim`, `psnr_db` and `ssim`.
    """
    return {
        "sensor PSNR, dB": metrics["raw_psnr_db"],
        "sensor SSIM": metrics["raw_ssim"],
        "restored PSNR, dB": metrics["psnr_db"],
        "restored SSIM": metrics["ssim"],
    }
