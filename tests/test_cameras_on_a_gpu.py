"""Cameras on a GPU, which is pretended: no operation mixes its tensors with the CPU's."""

import pytest
import torch

from dolens import load_lens
from dolens.experiments.camera.views.base import Shot
from dolens.experiments.camera.views.fields import FieldViews
from dolens.optics import ray_tracing
from dolens.reconstruction.general import GeneralRestoration
from dolens.reconstruction.untrained import WienerTVRestoration
from dolens.reconstruction.whole_pictures import restore
from dolens.rendering.auto.auto_renderer import AutoRenderer
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor
from dolens.sensor.readout import Readout
from tests.pretended_gpu import PretendedGpu
from tests.reconstruction.scenes import blur, raw_image
from tests.reconstruction.test_restoration import RESTORERS

LINES = (656.2725, 587.5618, 486.1327)
SENSOR = Sensor(12, 16, 0.02)
RENDERERS = {
    "rays": RayRenderer(SENSOR, 2),
    "functions": PsfRenderer(
        SENSOR, (2, 2), 4, diffraction="limit", illumination="map", registration="chief_rays"
    ),
    "functions by waves": PsfRenderer(SENSOR, (1, 1), 4, diffraction="wave"),
}


@pytest.fixture
def pretended(monkeypatch):
    """A GPU for which no kernels can be compiled."""
    monkeypatch.setattr(ray_tracing, "without_triton", lambda: "the GPU is pretended")
    return PretendedGpu()


@pytest.fixture
def gpu(pretended):
    with pretended:
        yield


there = pytest.mark.usefixtures("gpu")


@pytest.fixture
def lens(gpu):
    return load_lens("cooke_triplet", dtype=torch.float32).to("cuda")


@there
def test_tensors_of_both_devices_do_not_mix():
    on_it, beside = torch.ones(3, device="cuda"), torch.ones(3)
    with pytest.raises(RuntimeError, match="same device"):
        on_it + beside
    with pytest.raises(TypeError, match="NumPy"):
        on_it.numpy()
    assert (on_it + beside.to(on_it)).device.type == "cuda"
    assert (on_it.cpu() + beside).device.type == "cpu"


@pytest.mark.parametrize("name", RENDERERS)
def test_images_and_gradients_are_there_and_those_of_the_cpu(name, pretended):
    # Of waves, a lens that has little aberration; else the one that has fewest surfaces.
    name_of_lens = "cooke_triplet" if name == "functions by waves" else "la1131"
    scene = PlanarScene((8000.0, 4500.0), LINES)
    texture = torch.rand(1, 3, 12, 16)

    def rendered(device, backend):
        lens = load_lens(name_of_lens, dtype=torch.float32).to(device)
        lens.backend = backend
        image = RENDERERS[name].render(lens, scene, texture.to(device), 3)
        (gradient,) = torch.autograd.grad(image.square().sum(), [lens.surfaces["1"].curvature])
        assert image.device.type == gradient.device.type == device
        return image.detach().cpu(), gradient.cpu()

    cpu = rendered("cpu", "reference")
    with pretended:
        gpu = rendered("cuda", "auto")
    for expected, found in zip(cpu, gpu, strict=True):
        assert torch.equal(expected, found)


def test_a_renderer_is_planned_there(lens):
    plan = AutoRenderer(SENSOR, 4.0).make_plan(lens, PlanarScene((8000.0,), LINES[1:2]))
    assert plan.renderer.sensor == SENSOR


@there
def test_a_field_is_seen_and_read_out_there():
    lens = load_lens("large_fov_doublet", dtype=torch.float32).to("cuda")
    views = FieldViews(
        PlanarScene((1e5,), LINES),
        Sensor(96, 120, 0.08),
        PsfRenderer(Sensor(12, 16, 0.08), (2, 2), 4),
        Readout(),
        truth="chief_rays",
    )
    views.prepare(lens)
    taken = views.take(lens, Shot(torch.rand(2, 3, 48, 48, device="cuda"), "train", 0))
    assert taken.raw.device.type == taken.truth.device.type == "cuda"


@there
@pytest.mark.parametrize("kind", RESTORERS)
def test_networks_restore_and_learn_there(kind):
    network = RESTORERS[kind]().to("cuda")
    raw = raw_image().float().to("cuda").requires_grad_()
    restored = network(raw, blur().float().to("cuda"))
    gradients = torch.autograd.grad(restored.sum(), [raw, *network.parameters()])
    assert {g.device.type for g in gradients} == {"cuda"}


@there
@pytest.mark.parametrize("kind", [GeneralRestoration, WienerTVRestoration])
def test_restorers_of_any_lens_are_told_the_noise(kind):
    """As numbers on the CPU, as they come from a readout."""
    restorer = kind().to("cuda")
    functions = blur().float().to("cuda")
    noise = torch.tensor([0.01, 1e-4])
    restored = restorer(raw_image().float().to("cuda"), functions, None, noise)
    assert restored.device.type == "cuda"


def test_a_photograph_is_taken_and_restored_there(lens):
    photo = lens.photograph(torch.rand(3, 32, 48), light=1000)
    restored = restore(photo)
    assert photo.image.device.type == restored.image.device.type == "cuda"
