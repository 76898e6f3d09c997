"""Photographs of point sources are read from image files."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dolens.alignment.measurement import Measurement
from dolens.errors import InputError
from dolens.sensor.image_files import MEGAPIXELS, read_numbers
from dolens.sensor.pixels import Sensor
from dolens.typed_values import call_with_settings, check_type


def read_measurements(
    settings: Mapping[str, Any] | Sequence[Mapping[str, Any]], count: int
) -> Measurement:
    """Read one photograph, or several, of each source on each plane, by one sensor.

    Args:
        settings: of `read_measurement`, or a list of such.
        count: of photographs that are wanted.

    Raises:
        InputError: another count, or photographs whose pixels or read noise differ.
    """
    check_type(settings, Mapping[str, Any] | Sequence[Mapping[str, Any]], "measurement")
    entries = [settings] if isinstance(settings, Mapping) else list(settings)
    if len(entries) != count:
        raise InputError(
            f"measurement: {len(entries)} photographs; allowed: {count}, one of each source on "
            "each plane"
        )
    read = [call_with_settings(read_measurement, entry, "measurement") for entry in entries]
    if any((each.sensor, each.read_noise) != (read[0].sensor, read[0].read_noise) for each in read):
        raise InputError("measurement: photographs differ in their pixels or in their read noise")
    return replace(
        read[0],
        images=torch.cat([each.images for each in read]),
        mask=torch.cat([each.mask for each in read]),
    )


def read_measurement(
    path: str | Path,
    pixel_pitch: float,
    dark_level: float = 0.0,
    region: tuple[int, int, int, int] | None = None,
    downsample: int = 1,
    saturation: float | None = None,
    electrons_per_count: float = 1.0,
    read_noise: float = 1.0,
    megapixels: float = MEGAPIXELS,
) -> Measurement:
    """Read a photograph of a source, 16 bits or 8, of one channel.

    Args:
        path: TIFF or PNG.
        pixel_pitch: of the photograph, mm.
        dark_level: counts that the sensor gives in the dark.

    Rarely needed:
        region: top, left, height and width that are used, pixels; None: all.  The optical axis is
            taken to meet the middle of the photograph.
        downsample: pixels along each side that are averaged to one; those that are left over at the
            right and at the bottom are cut off.
        saturation: counts from which a pixel is not trusted; None: the largest that the file's
            integers can hold.
        electrons_per_count: of the sensor.
        read_noise: RMS of one pixel, electrons.
        megapixels: the largest photograph that is read, millions of pixels.

    Raises:
        InputError: the file cannot be read, is not grey integers, or a number is out of range.
    """
    try:
        values = read_numbers(Path(path).expanduser(), ("PNG", "TIFF"), megapixels)
    except InputError as error:
        raise InputError(f"measurement: {error.whole}") from error
    if values.ndim != 2 or values.dtype.kind not in "ui":
        raise InputError(
            f"measurement: {path} has {values.dtype} of shape {values.shape}; allowed: one "
            "channel of integers"
        )
    if downsample < 1 or not 0.0 < pixel_pitch < math.inf:
        raise InputError(
            f"measurement: downsample {downsample} and pixel_pitch {pixel_pitch}; allowed: 1 or "
            "more, and above 0 (mm)"
        )
    if not 0.0 <= read_noise < math.inf:
        raise InputError(f"measurement.read_noise: {read_noise}; allowed: 0 or more")
    if not 0.0 < electrons_per_count < math.inf:
        raise InputError(
            f"measurement.electrons_per_count: {electrons_per_count}; allowed: above 0"
        )
    if saturation is None:
        saturation = float(np.iinfo(values.dtype).max)
    counts = torch.from_numpy(values.astype(np.float64))
    whole = Sensor(counts.shape[0], counts.shape[1], pixel_pitch)
    top, left, height, width = region or (0, 0, whole.height, whole.width)
    height, width = height - height % downsample, width - width % downsample
    window = whole.window(top, left, height, width)
    counts = counts[top : top + height, left : left + width]

    def blocks(t: Tensor) -> Tensor:
        return t.unflatten(1, (-1, downsample)).unflatten(0, (-1, downsample))

    trusted = blocks(counts < saturation).all(-1).all(1)
    electrons = blocks((counts - dark_level) * electrons_per_count).sum((1, 3))
    sensor = Sensor(
        height // downsample,
        width // downsample,
        pixel_pitch * downsample,
        window.centre_row / downsample,
        window.centre_column / downsample,
    )
    return Measurement(electrons[None], trusted[None], read_noise * downsample, sensor)
