"""Replayed gradients: the plain gradient, with the memory of one piece."""

import pytest
import torch

from dolens.optics.autograd import replay
from dolens.rendering.ray_renderer import RayRenderer
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor

DEPTHS, LINES = (8000.0, 4500.0), (656.2725, 587.5618, 486.1327)


def test_replay_gives_the_value_and_gradient_of_the_pieces_joined():
    a = torch.tensor([0.3, -1.2], dtype=torch.float64, requires_grad=True)
    b = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)

    def piece(i, a, b):
        return torch.sin(a[:, None] * torch.arange(1.0 + i, 3.0 + i, dtype=torch.float64)) * b

    whole = torch.cat([piece(i, a, b) for i in range(3)], -1)
    weight = torch.linspace(-1, 1, whole.numel(), dtype=torch.float64).reshape(whole.shape)
    expected = torch.autograd.grad((whole * weight).sum(), (a, b))
    joined = replay(piece, [2, 2, 2], [a, b])
    assert torch.equal(joined, whole)
    found = torch.autograd.grad((joined * weight).sum(), (a, b))
    for one, two in zip(expected, found, strict=True):
        assert torch.allclose(one, two, rtol=1e-14, atol=0)


def test_the_mean_over_replayed_subsets_is_the_whole_gradient():
    a = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)

    def piece(i, a):
        return torch.sin((i + 1.0) * a)[None]

    def gradient(chosen):
        return torch.autograd.grad(replay(piece, [1] * 4, [a], chosen).sum(), a)[0]

    subsets = [(i, j) for i in range(4) for j in range(i)]
    mean = sum(gradient(s) for s in subsets) / len(subsets)
    assert float(mean) == pytest.approx(float(gradient(range(4))), rel=1e-14)


def test_the_render_s_replayed_gradient_is_plain_back_propagation(wavefront_coding):
    lens = wavefront_coding(1.3e-5)
    scene, sensor = PlanarScene(DEPTHS, LINES), Sensor(9, 10, 0.0069)
    generator = torch.Generator().manual_seed(0)
    texture = torch.rand(2, 3, 29, 30, generator=generator, dtype=torch.float64)
    weight = torch.randn(2, 2, 3, 9, 10, generator=generator, dtype=torch.float64)
    names = ["surfaces.5.x3", "surfaces.5.x2y", "surfaces.1.curvature", "thicknesses.3"]
    results = []
    for replayed in (True, False):
        tensors = [dict(lens.named_parameters())[n].clone().requires_grad_() for n in names]
        textures = texture.clone().requires_grad_()
        renderer = RayRenderer(sensor, 4, chunk_rays=300, replay=replayed)
        image = renderer.render(
            lens.with_values(dict(zip(names, tensors, strict=True))), scene, textures, 5
        )
        grads = torch.autograd.grad((image * weight).sum(), [textures, *tensors])
        results.append((image.detach(), grads))
    assert torch.equal(results[0][0], results[1][0])
    for one, two in zip(results[0][1], results[1][1], strict=True):
        assert float(two.abs().max()) > 0
        assert float((one - two).abs().max()) <= 1e-6 * float(two.abs().max())


def test_the_backward_pass_needs_the_memory_of_one_chunk(wavefront_coding):
    # Bytes that autograd keeps between the passes: the inputs alone, however many rays there are.
    lens, scene = wavefront_coding(1.3e-5), PlanarScene(DEPTHS, LINES)
    texture = torch.rand(1, 3, 40, 40, dtype=torch.float64)
    saved = []
    for size in (6, 24):
        x3 = torch.tensor(1e-5, dtype=torch.float64, requires_grad=True)
        kept = 0

        def count(tensor):
            nonlocal kept
            kept += tensor.numel()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(count, lambda t: t):
            renderer = RayRenderer(Sensor(size, size, 0.0069), 4, chunk_rays=1024)
            renderer.render(lens.with_values({"surfaces.5.x3": x3}), scene, texture, 1)
        saved.append(kept)
    assert saved[0] == saved[1] < 2 * texture.numel()


def test_a_fraction_of_the_chunks_estimates_the_gradient_without_bias(wavefront_coding):
    lens, scene = wavefront_coding(1.3e-5), PlanarScene((8000.0,), LINES[:1])
    texture = torch.rand(
        1, 1, 32, 32, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )

    def gradient(fraction, seed):
        x3 = torch.tensor(1.3e-5, dtype=torch.float64, requires_grad=True)
        renderer = RayRenderer(Sensor(8, 8, 0.0069), 3, 9 * 16, gradient_fraction=fraction)
        image = renderer.render(lens.with_values({"surfaces.5.x3": x3}), scene, texture, seed)
        return float(torch.autograd.grad(image.square().sum(), x3)[0])

    pairs = [(gradient(0.5, seed), gradient(1.0, seed)) for seed in range(20)]
    difference = torch.tensor([a - b for a, b in pairs])
    standard_error = float(difference.std()) / len(pairs) ** 0.5
    assert standard_error > 0
    assert abs(float(difference.mean())) < 4 * standard_error
