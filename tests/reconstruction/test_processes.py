"""Processes that share a batch compute what one process does."""

import multiprocessing
import traceback

import pytest
import torch
from torch import distributed, nn

from dolens.experiments.camera.training import Adversary
from dolens.reconstruction.adversarial import (
    PatchDiscriminator,
    RelativisticDiscriminators,
    relativistic_discriminator_loss,
)
from dolens.reconstruction.processes import (
    average_gradients,
    gathered,
    mean_over_processes,
    own_batch_statistics,
    share_batch_statistics,
)


def network():
    torch.manual_seed(0)
    layers = nn.Sequential(
        nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4), nn.ReLU(), nn.Conv2d(4, 2, 3), nn.BatchNorm2d(2)
    )
    return layers.double()


def images():
    return torch.rand(4, 3, 9, 8, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def step(layers, batch):
    """Gradients by a loss that is no mean over images, and statistics."""
    scores = layers(batch)
    loss = relativistic_discriminator_loss(scores[:, 0], scores[:, 1]) + mean_over_processes(
        scores.square().mean()
    ).pow(2)
    loss.backward()
    average_gradients(layers)
    found = {name: p.grad for name, p in layers.named_parameters()}
    return found | {name: buffer.double() for name, buffer in layers.named_buffers()}


def judged(real, fake):
    torch.manual_seed(0)
    judges = RelativisticDiscriminators({"local": PatchDiscriminator(4, 1)}, weight=1.0).double()
    fake = fake.clone().requires_grad_(True)
    # Adam's large step before the term: in single precision it would show the gradients' rounding.
    term, numbers = Adversary(judges, learning_rate=0.02)(real, fake)
    term.backward()
    return [*(p.grad for p in judges.parameters()), *numbers.values()], fake.grad


def work(rank, store, results):
    torch.set_num_threads(1)
    try:
        distributed.init_process_group("gloo", f"file://{store}", rank=rank, world_size=2)
        own = slice(2 * rank, 2 * rank + 2)
        layers = share_batch_statistics(network())
        found = step(layers, images()[own])
        layers = share_batch_statistics(network())
        # As `compile_network`, without the minute in which a C++ compiler makes kernels.
        layers.compile(backend="aot_eager")
        compiled = step(layers, images()[own])
        found |= {f"compiled.{name}": value for name, value in compiled.items()}
        judges, restored = judged(images()[own], images().flip(0)[own])
        numbers = gathered({"rank": rank})
        # Lists: a tensor's memory would go with its process.
        plain = {name: value.tolist() for name, value in found.items()}
        results.put((rank, plain, [g.tolist() for g in judges], restored.tolist(), numbers))
    except Exception:
        results.put((rank, traceback.format_exc(), None, None, None))


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """What each of two processes has found."""
    store = tmp_path_factory.mktemp("store") / "file"
    # Both are copies of a process that has imported all this, which takes longer than the work.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["dolens.experiments.camera.training"])
    results = context.Queue()
    started = [context.Process(target=work, args=(rank, store, results)) for rank in range(2)]
    for process in started:
        process.start()
    found = sorted([results.get(timeout=300) for _ in started], key=lambda entry: entry[0])
    for process in started:
        process.join()
    for _, values, *_ in found:
        assert isinstance(values, dict), values
    return found


def test_gradients_and_statistics_are_those_of_the_whole_batch(two):
    alone = step(network(), images())
    for _, found, *_ in two:
        assert found.keys() == {*alone, *(f"compiled.{name}" for name in alone)}
        for name, value in found.items():
            torch.testing.assert_close(
                torch.tensor(value, dtype=torch.float64),
                alone[name.removeprefix("compiled.")],
                rtol=1e-10,
                atol=1e-12,
            )


def test_discriminators_learn_from_the_whole_batch(two):
    parameters, restored = judged(images(), images().flip(0))
    for rank, _, judges, own, _ in two:
        for mine, whole in zip(judges, parameters, strict=True):
            assert torch.allclose(torch.tensor(mine, dtype=torch.float64), whole, rtol=1e-9)
        # A strategy averages what follows from these gradients over the two processes.
        own = torch.tensor(own, dtype=torch.float64) / 2
        assert torch.allclose(own, restored[2 * rank : 2 * rank + 2], rtol=1e-9)


def test_what_processes_have_is_gathered_in_order(two):
    for *_, numbers in two:
        assert numbers == [{"rank": 0}, {"rank": 1}]


def test_one_process_computes_as_without_any():
    value = torch.rand(3)
    assert mean_over_processes(value) is value
    assert gathered(5) == [5]
    layers, shared = network(), share_batch_statistics(network())
    assert list(shared.state_dict()) == list(layers.state_dict())
    assert torch.equal(shared(images()), layers(images()))
    again = own_batch_statistics(shared)
    assert [type(part) for part in again] == [type(part) for part in layers]
