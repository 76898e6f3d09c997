"""The network of a camera is exported, for programs that know neither dolens nor PyTorch.

What is exported is checked: it is loaded from its file, and run on images of other sizes than the
one it was traced with, against the network itself.
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

from dolens.errors import InputError, one_line
from dolens.experiments.camera.exportable import Exportable
from dolens.experiments.camera.reconstruction import evaluating

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
