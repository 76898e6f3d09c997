"""Raw numbers of a real sensor become the signal that a camera takes."""

import logging
import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.sensor.readout import Readout

logger = logging.getLogger(__name__)


def signal_of(
    array: np.ndarray,
    readout: Readout,
    file: Path,
    black_level: float | None = None,
    white_level: float | None = None,
) -> Tensor:
    """Return raw numbers as a readout gives them: 0 without light and 1 at full scale.

        signal = (number - black) / (white - black)

    Args:
        array: (height, width), or (height, width, 3).
        readout: of the run: its colour filters, bits and black level.
        file: named in messages.
        black_level: the number of no light; None: that of the readout's codes, and 0 for numbers
            with a fraction.
        white_level: the number at full scale; None: the last of the readout's codes, without bits
            that of the file, and 1 for numbers with a fraction.

    Returns:
        (1, 1 or 3, height, width), float32.

    Raises:
        InputError: other channels than the sensor has, or levels that are not in order.
    """
    if readout.pattern is not None and array.ndim != 2:
        raise InputError(
            f"{file}: {array.shape[-1]} channels; the run's sensor has {readout.pattern} filters: "
            "give one number a pixel, as the sensor has it"
        )
    if readout.pattern is None and (array.ndim != 3 or array.shape[-1] != 3):
        raise InputError(
            f"{file}: of shape {array.shape}; the run's sensor sees all colours in each pixel: "
            "give (height, width, 3)"
        )
    fraction = array.dtype.kind == "f"
    top = 1.0 if fraction else float(np.iinfo(array.dtype).max)
    codes = top if fraction or readout.bits is None else 2.0**readout.bits - 1.0
    no_light = 0.0 if fraction or readout.bits is None else readout.black_level * codes
    black = no_light if black_level is None else black_level
    white = codes if white_level is None else white_level
    if not (math.isfinite(black) and math.isfinite(white) and black < white):
        raise InputError(
            f"--black-level {black:g} and --white-level {white:g}: black must be below white"
        )
    numbers = torch.from_numpy(array.astype(np.float32))
    numbers = numbers[None] if numbers.ndim == 2 else numbers.permute(2, 0, 1)
    signal = ((numbers - black) / (white - black))[None]
    if float(signal.max()) > 1.001:
        logger.warning(
            "%s: numbers up to %g lie above white, %g; is --white-level right?",
            file,
            float(numbers.max()),
            white,
        )
    return signal
