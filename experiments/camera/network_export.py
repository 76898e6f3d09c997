"""The network of a camera is exported as `torch.export` or ONNX, and the file is checked.

It is loaded and run on images of other sizes than the one it was traced with, against the
network itself.
"""

import importlib
import json
import logging
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.export import Dim

from dolens.errors import InputError, one_line
from dolens.experiments.camera.base import Camera
from dolens.experiments.camera.reconstruction import ImageNetwork, evaluating
from dolens.reconstruction import (
    GeneralRestoration,
    Restoration,
    UntrainedRestoration,
    WienerUNetRestoration,
)
from dolens.reconstruction.feature_pyramid import FeaturePyramid
from dolens.reconstruction.feature_wiener import DeconvolvedRestoration
from dolens.reconstruction.nafnet import NAFNet
from dolens.reconstruction.unet import UNet
from dolens.reconstruction.wiener_matrices import FixedGeneral, FixedWienerUNet, with_fixed_filters

_RAW = (
    "the sensor image in linear light, (batch, 3, rows, columns), red, green and blue, the "
    "exposure divided out: 1 is a white plane on the axis, 0 no light"
)
_FIELD = (
    "where each pixel lies on the sensor, (batch, 2, rows, columns): x to the right and y as the "
    "rows run, from the sensor's centre, over half of its diagonal"
)
_RESTORED = (
    "the restored picture, (batch, 3, rows, columns), sRGB-encoded; clamp it to 0 and 1 to show it"
)
# No picture is larger than this, in multiples of what the network needs.
_MOST = 4096
_MOST_PIXELS = 64_000_000
# Rows and columns that a network of any size is traced and checked with: a sensor's million pixels
# would take minutes and gigabytes, and show no more.
_TRACED = 256


class _WithFunctions(nn.Module):
    """A restoring network of the raw image alone: functions and noise are part of it."""

    def __init__(
        self, network: Restoration, functions: Tensor | None, noise: Sequence[Tensor] = ()
    ) -> None:
        super().__init__()
        self.network = network
        self.functions: Tensor | None
        self.register_buffer("functions", functions)
        self.noise = list(noise)

    def forward(self, raw: Tensor) -> Tensor:
        return self.network(raw, self.functions, None, *self.noise)


class _WithField(nn.Module):
    """A restoring network of the raw image and the field; point spread functions are part of it."""

    def __init__(self, network: Restoration, functions: Tensor | None) -> None:
        super().__init__()
        self.network = network
        self.functions: Tensor | None
        self.register_buffer("functions", functions)

    def forward(self, raw: Tensor, field: Tensor) -> Tensor:
        return self.network(raw, self.functions, field)


@dataclass(frozen=True)
class Exportable:
    """A network that can be exported.

    Attributes:
        module: of the inputs, in their order.
        real_module: the same for programs without complex numbers and Fourier transforms.
        inputs: name → what it is.
        multiple: rows and columns are multiples of it; None: only `size` is possible.
        least: multiples that a side has at least.
        size: rows and columns that the network is traced with.
        dtype: of inputs and output.
    """

    module: nn.Module
    real_module: nn.Module
    inputs: dict[str, str]
    multiple: int | None
    least: int
    size: tuple[int, int]
    dtype: torch.dtype

    def facts(self) -> dict[str, Any]:
        """Return what the network takes and gives, in words."""
        if self.multiple is None:
            sizes = f"{self.size[0]} rows and {self.size[1]} columns only; any batch"
        elif self.multiple == 1:
            sizes = "any rows and columns; any batch"
        else:
            sizes = (
                f"rows and columns: multiples of {self.multiple}, at least "
                f"{self.least * self.multiple}; any batch.  Extend other pictures by repeating "
                "their last row and column, and crop the result"
            )
        return {
            "inputs": self.inputs,
            "output": {"restored": _RESTORED},
            "sizes": sizes,
            "dtype": str(self.dtype).removeprefix("torch."),
        }

    def images(self, batch: int, rows: int, columns: int) -> tuple[Tensor, ...]:
        """Return inputs of random numbers, the same each time."""
        generator = torch.Generator().manual_seed(0)
        made = []
        for name in self.inputs:
            channels = 2 if name == "field" else 3
            values = torch.rand(batch, channels, rows, columns, generator=generator)
            made.append((2.0 * values - 1.0 if name == "field" else values).to(self.dtype))
        return tuple(made)

    def example(self) -> tuple[Tensor, ...]:
        """Return the inputs that the network is traced with."""
        return self.images(2, *self.size)

    def dynamic_shapes(self) -> tuple[dict[int, Any], ...]:
        """Return the free dimensions of every input, as `torch.export` takes them."""
        free: dict[int, Any] = {0: Dim("batch", min=1, max=_MOST)}
        if self.multiple is not None:
            for axis, name in ((2, "rows"), (3, "columns")):
                side = Dim(name, min=self.least, max=_MOST)
                free[axis] = side if self.multiple == 1 else self.multiple * side
        return (free,) * len(self.inputs)

    def shapes_to_check(self) -> list[tuple[int, int, int]]:
        """Return batches and sizes that the exported network is tried with."""
        rows, columns = self.size
        if self.multiple is None:
            return [(1, rows, columns), (3, rows, columns)]
        low, step = self.least * self.multiple, self.multiple
        return [(1, rows, columns), (3, low + step, low + 3 * step), (1, columns + step, low)]


def exportable(
    camera: Camera, size: tuple[int, int] | None = None, multiple: int | None = None
) -> Exportable:
    """Return a camera's network, in evaluation mode, as what can be exported.

    A network that deconvolves has the lens's point spread functions built in, as the checkpoint's
    lens has them, and takes images of one size only.

    Args:
        camera: as trained.
        size: rows and columns; None: the camera's sensor, or at most 256 pixels of it where the
            network takes any size.
        multiple: that the sides of images must be of; None: what is known of the network.  Of a
            network of one's own nothing is known, and it takes images of one size only.

    Raises:
        InputError: a size or a multiple that is not positive, or a multiple for a network that
            deconvolves.
    """
    if min(size or (1, 1)) < 1 or (multiple is not None and multiple < 1):
        raise InputError(f"image size {size}, multiple of {multiple}: must be positive numbers")
    if size is not None and size[0] * size[1] > _MOST_PIXELS:
        raise InputError(f"image size {size}: allowed: {_MOST_PIXELS:.3g} pixels at most")
    if multiple is not None and multiple > _MOST:
        raise InputError(f"multiple of {multiple}: allowed: {_MOST} at most")
    if camera.views.readouts:
        raise InputError("exposures.readouts: each; allowed in an exported network: one")
    if isinstance(camera.network, UntrainedRestoration) or camera.knows_places:
        raise InputError(
            f"network: {type(camera.network).__name__} is no network of tensors alone, or is "
            "told the place of each image, and is not exported"
        )
    if getattr(camera.network, "by_depth", False):
        raise InputError("network.by_depth: true; allowed in an exported network: false")
    network = camera.network.eval().requires_grad_(False).cpu()
    sensor = camera.views.sensor
    rows, columns = size or (sensor.height, sensor.width)
    known, least = _sizes(network)
    if multiple is not None and network.needs_point_spread_function:
        raise InputError("a network that deconvolves takes images of one size: no multiple is free")
    multiple = multiple or known
    functions = None
    if network.needs_point_spread_function:
        with torch.no_grad():
            functions = camera.views.point_spread_functions(
                camera.lens.with_values(camera.variables())
            )
        functions = functions.detach().cpu().to(network.dtype)
    if multiple is not None:
        if size is None:
            rows, columns = min(rows, _TRACED), min(columns, _TRACED)
        # Traced with a size that the network's own padding leaves alone.
        rows, columns = (max(least, -(-side // multiple)) * multiple for side in (rows, columns))
    inputs = {"raw": _RAW, **({"field": _FIELD} if network.needs_field else {})}
    wrapper = _WithField if network.needs_field else _WithFunctions
    noise = camera.noise()
    module = real = wrapper(network, functions, *([noise] if noise else []))
    if isinstance(network, GeneralRestoration):
        assert functions is not None  # it needs them
        real = FixedGeneral(network, functions, *noise, rows, columns)
    elif isinstance(network, WienerUNetRestoration):
        real = FixedWienerUNet(network, functions, rows, columns)
    elif isinstance(network, DeconvolvedRestoration):
        assert functions is not None  # it needs them
        real = wrapper(with_fixed_filters(network, functions, rows, columns), functions)
    return Exportable(module, real, inputs, multiple, least, (rows, columns), network.dtype)


def _sizes(network: Restoration) -> tuple[int | None, int]:
    """Return what sides must be a multiple of, None for one size only, and how many at least."""
    if network.needs_point_spread_function:
        return None, 2
    inner = network.network if isinstance(network, ImageNetwork) else network
    for part in inner.modules():
        if isinstance(part, UNet):
            return 2**part.depth, 2
        if isinstance(part, NAFNet):
            return part.multiple, 2
        if isinstance(part, FeaturePyramid):
            return part.backbone.stride, 2
    return None, 2


# The largest difference that is accepted, as a share of the range of the output.
TOLERANCE = 1e-4
FORMATS = ("torch", "onnx")
_OUTPUT = "restored"


@dataclass(frozen=True)
class ExportedNetwork:
    """A network in a file.

    Attributes:
        path: of the file.
        facts: what it takes and gives, plain values for export.json.
    """

    path: Path
    facts: dict[str, Any]


def export_torch(network: Exportable, path: Path) -> ExportedNetwork:
    """Write a network as a program of `torch.export` (.pt2), and check the file.

    Raises:
        InputError: torch cannot export it, or the file's network gives other numbers.
    """
    with _quiet():
        program = _program(network, network.module)
        extra = {"dolens.json": json.dumps(network.facts())}
        torch.export.save(program, path, extra_files=extra)
        loaded = torch.export.load(path).module()
        worst = _checked(network, lambda inputs: loaded(*inputs), path)
    return ExportedNetwork(path, {**network.facts(), **_said(worst, "torch.export.load")})


def export_onnx(network: Exportable, path: Path) -> ExportedNetwork:
    """Write a network as ONNX, and check the file by onnxruntime.

    Raises:
        InputError: the packages of the extra `onnx` are missing, the network cannot be exported,
            or the file's network gives other numbers.
    """
    onnxruntime = _needed("onnxruntime")
    for name in ("onnx", "onnxscript"):
        _needed(name)
    with _quiet():
        try:
            program = torch.onnx.export(
                _program(network, network.real_module),
                dynamo=True,
                verbose=False,
                input_names=list(network.inputs),
                output_names=[_OUTPUT],
            )
        except torch.onnx.errors.OnnxExporterError as error:
            reason = one_line(error.__cause__ or error)[:200]
            raise InputError(f"{path.name}: ONNX cannot hold the network ({reason})") from None
        program.model.metadata_props["dolens"] = json.dumps(network.facts())
        program.save(path)
        session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])

        def run(inputs: Sequence[Tensor]) -> Tensor:
            given = {name: v.numpy() for name, v in zip(network.inputs, inputs, strict=True)}
            return torch.from_numpy(session.run([_OUTPUT], given)[0])

        worst = _checked(network, run, path)
    opset = next((version for name, version in program.model.opset_imports.items() if not name), 0)
    return ExportedNetwork(
        path, {**network.facts(), "opset": opset, **_said(worst, "onnxruntime on the CPU")}
    )


def _program(network: Exportable, module: nn.Module) -> torch.export.ExportedProgram:
    """Trace a module with the free sizes that it allows.

    Raises:
        InputError: torch cannot export it.
    """
    try:
        with torch.no_grad(), evaluating(module):
            return torch.export.export(
                module, network.example(), dynamic_shapes=network.dynamic_shapes()
            )
    except (RuntimeError, torch._dynamo.exc.TorchDynamoException, ValueError) as error:
        reason = one_line(error)[:200]
        raise InputError(f"torch.export cannot trace the network ({reason})") from None


def _checked(
    network: Exportable, run: Callable[[Sequence[Tensor]], Tensor], path: Path
) -> dict[str, float]:
    """Return the largest differences by the images' shapes, as shares of the output's range.

    Raises:
        InputError: one is beyond `TOLERANCE`; the file is removed.
    """
    found = {}
    for shape in network.shapes_to_check():
        inputs = network.images(*shape)
        with torch.no_grad(), evaluating(network.module):
            expected = network.module(*inputs)
        extent = float(expected.max() - expected.min())
        with torch.no_grad():
            difference = float((run(inputs) - expected).abs().max())
        found["×".join(map(str, shape))] = difference / max(extent, 1e-12)
    worst = max(found.values())
    if not worst <= TOLERANCE:
        path.unlink()
        raise InputError(
            f"{path.name}: its numbers differ from the network's by {worst:.2g} of the range, and "
            f"{TOLERANCE:g} is allowed; no file is left"
        )
    return found


def _said(found: dict[str, float], program: str) -> dict[str, Any]:
    worst = max(found.values())
    size = f"at most {worst:.1g} of the output's range" if worst else "none"
    return {
        "error": f"{size}, by {program}, on images of {', '.join(found)}",
        "largest_error": worst,
    }


def _needed(name: str) -> Any:
    """Import a package of the extra `onnx`.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        raise InputError(
            f"ONNX needs the package '{name}', which is not installed; "
            "install it by: pip install 'dolens[onnx]'"
        ) from None


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the exporters' remarks about their own versions off the terminal."""
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript", "torch.export")]
    before = [one.level for one in loggers]
    for one in loggers:
        one.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for one, level in zip(loggers, before, strict=True):
            one.setLevel(level)
