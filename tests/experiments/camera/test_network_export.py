"""A camera's network in a file gives the numbers of the network, on sizes that it was not traced
with.
"""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from dolens.cli.app import app
from dolens.errors import InputError
from dolens.experiments.camera import network_export
from dolens.experiments.camera.network_export import export_onnx, export_torch, exportable
from dolens.experiments.camera.reconstruction import restoration_of
from dolens.reconstruction import (
    FeaturePyramidRestoration,
    FeatureWienerRestoration,
    GeneralRestoration,
    NAFNetRestoration,
    UNetRestoration,
    WienerNAFNetRestoration,
    WienerUNetRestoration,
)


def camera_of(network, size=(24, 20), functions=None):
    """A camera as the export sees it, whose network has left its starting point."""
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    sensor = SimpleNamespace(height=size[0], width=size[1])
    return SimpleNamespace(
        network=network.eval(),
        views=SimpleNamespace(
            sensor=sensor, readouts=None, point_spread_functions=lambda lens: functions
        ),
        lens=SimpleNamespace(with_values=lambda values: None),
        variables=dict,
        noise=lambda: network.noise_arguments((0.01, 0.0009)),
        knows_places=False,
    )


@pytest.fixture(scope="module")
def blur():
    """Two depths' point spread functions, unlike in their colours."""
    u = torch.arange(9.0) - 4.0
    widths = torch.tensor([[0.7, 0.9, 1.2], [1.0, 1.1, 0.8]])[..., None, None]
    found = torch.exp(-(u[:, None] ** 2 + u**2) / (2.0 * widths**2))
    return found / found.sum((-1, -2), keepdim=True)


def test_a_u_net_takes_any_multiple_of_its_strides_in_both_formats(tmp_path):
    network = UNetRestoration(width=2, depth=1, field_coordinates=True)
    found = exportable(camera_of(network))
    assert found.multiple == 2 and list(found.inputs) == ["raw", "field"]
    onnx = export_onnx(found, tmp_path / "network.onnx")
    pt2 = export_torch(found, tmp_path / "network.pt2")
    assert onnx.facts["largest_error"] < 1e-5 and pt2.facts["largest_error"] < 1e-6
    assert "multiples of 2" in onnx.facts["sizes"] and "over half" in onnx.facts["inputs"]["field"]
    # And once more here, on a size that the export has not tried, alone.
    import onnxruntime

    raw, field = torch.rand(2, 3, 38, 10), torch.rand(2, 2, 38, 10)
    session = onnxruntime.InferenceSession(str(tmp_path / "network.onnx"))
    (restored,) = session.run(None, {"raw": raw.numpy(), "field": field.numpy()})
    with torch.no_grad():
        expected = network(raw, None, field)
    assert np.abs(restored - expected.numpy()).max() < 1e-5
    loaded = torch.export.load(tmp_path / "network.pt2").module()
    assert torch.equal(loaded(raw, field), expected)


def test_a_large_sensor_is_not_what_a_network_of_any_size_is_traced_with(blur):
    free = camera_of(UNetRestoration(width=2, depth=2), (1142, 100))
    assert exportable(free).shapes_to_check()[0] == (1, 256, 100)
    assert exportable(free, (512, 300)).size == (512, 300)  # but for those who ask
    bound = camera_of(WienerUNetRestoration(width=2, depth=1, margin=4), (300, 40), blur)
    assert exportable(bound).size == (300, 40)


def test_a_deconvolving_network_has_its_lens_built_in(blur, tmp_path):
    network = WienerUNetRestoration(width=2, depth=1, margin=4, noise_to_signal=0.02)
    found = exportable(camera_of(network, (21, 16), blur))
    onnx = export_onnx(found, tmp_path / "network.onnx")
    assert onnx.facts["largest_error"] < 1e-4
    assert onnx.facts["sizes"] == "21 rows and 16 columns only; any batch"
    assert list(onnx.facts["inputs"]) == ["raw"]


def test_deconvolution_by_matrices_is_that_by_fourier_transforms(blur):
    network = WienerUNetRestoration(width=2, depth=1, margin=5, noise_to_signal=1e-3).double()
    found = exportable(camera_of(network, (13, 18), blur.double()))
    raw = torch.rand(2, 3, 13, 18, dtype=torch.float64)
    with torch.no_grad():
        assert (found.real_module(raw) - found.module(raw)).abs().max() < 1e-11


@pytest.mark.parametrize("kind", ["features", "nafnet", "general"])
def test_filters_that_mix_colours_are_exported_with_the_lens_built_in(kind, blur, tmp_path):
    nafnet = {"width": 2, "down": (1,), "up": (1,)}
    network = {
        "features": lambda: FeatureWienerRestoration(2, 1, 4, depths=2, features=2, scales=2),
        "nafnet": lambda: WienerNAFNetRestoration(**nafnet, margin=4),
        "general": lambda: GeneralRestoration("none", width=4, down=(1,), middle=1, up=(1,)),
    }[kind]()
    found = exportable(camera_of(network.double(), (21, 16), blur.double()))
    raw = torch.rand(2, 3, 21, 16, dtype=torch.float64)
    with torch.no_grad():
        assert (found.real_module(raw) - found.module(raw)).abs().max() < 1e-11
    found = exportable(camera_of(network.float(), (21, 16), blur))
    onnx = export_onnx(found, tmp_path / "network.onnx")
    assert onnx.facts["largest_error"] < 1e-4
    assert onnx.facts["sizes"] == "21 rows and 16 columns only; any batch"


def test_a_nafnet_takes_multiples_of_its_groups_and_halvings(tmp_path):
    found = exportable(camera_of(NAFNetRestoration(2, (1,), 1, (1,))))
    assert found.multiple == 4 and found.size == (24, 20)
    assert export_torch(found, tmp_path / "network.pt2").facts["largest_error"] < 1e-6
    assert export_onnx(found, tmp_path / "network.onnx").facts["largest_error"] < 1e-5


def test_a_feature_pyramid_takes_multiples_of_its_backbone_s_stride(tmp_path):
    network = FeaturePyramidRestoration(
        stages=2, width_multiplier=0.25, pyramid_channels=4, weights="none"
    )
    found = exportable(camera_of(network))
    assert found.multiple == 4 and found.size == (24, 20)
    assert export_torch(found, tmp_path / "network.pt2").facts["largest_error"] < 1e-6


def test_a_network_of_one_s_own_takes_one_size_or_the_multiple_that_is_given(tmp_path):
    own = torch.nn.Conv2d(3, 3, 3, padding=1)
    camera = camera_of(restoration_of(own))
    assert exportable(camera).facts()["sizes"] == "24 rows and 20 columns only; any batch"
    found = exportable(camera, multiple=1)
    assert found.facts()["sizes"] == "any rows and columns; any batch"
    assert export_torch(found, tmp_path / "network.pt2").facts["largest_error"] < 1e-6


def test_a_file_whose_numbers_differ_is_removed(monkeypatch, tmp_path):
    found = exportable(camera_of(restoration_of(torch.nn.Conv2d(3, 3, 1))))
    load = torch.export.load

    def wrong(path):
        program = load(path)
        return SimpleNamespace(module=lambda: lambda raw: program.module()(raw) + 1e-3)

    monkeypatch.setattr(network_export.torch.export, "load", wrong)
    with pytest.raises(InputError, match="differ from the network's"):
        export_torch(found, tmp_path / "network.pt2")
    assert not (tmp_path / "network.pt2").exists()


def test_the_command_exports_the_lens_and_the_network_of_a_run(tiny_run, tmp_path):
    only = ["--only", "yaml,torch"]
    done = CliRunner().invoke(app, ["export", str(tiny_run), "--out", str(tmp_path), *only])
    assert done.exit_code == 0, done.output
    record = json.loads((tmp_path / "export.json").read_text())
    assert list(record["files"]) == ["lens.yaml", "network.pt2"]
    assert record["source"]["checkpoint"] == "last.ckpt" and record["source"]["step"] == 2
    assert record["files"]["network.pt2"]["largest_error"] < 1e-4
