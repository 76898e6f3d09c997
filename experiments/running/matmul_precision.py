"""The precision of float32 matrix products on a GPU is set, without a word of PyTorch."""

import warnings

import torch


def set_matmul_precision(precision: str) -> None:
    """Set how float32 matrix products are rounded on the device, for all of the process.

    PyTorch 2.9 warns of a newer interface, which later versions prefer without a warning.

    Args:
        precision: `highest`, `high` (TensorFloat32) or `medium` (bfloat16).
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Please use the new API settings", UserWarning)
        torch.set_float32_matmul_precision(precision)
