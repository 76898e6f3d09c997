"""Workers give the batches of one process, and what goes wrong in them is one line."""

import numpy as np
import pytest
import torch
from PIL import Image
from torch.utils.data import DataLoader

from dolens.errors import InputError
from dolens.experiments.data.crop_loading import CropLoader, LostWorkerError, Waiting
from dolens.experiments.data.image_folder import ImageFolderDataModule
from dolens.experiments.running.main import machine_fault


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("photographs")
    for number in range(12):
        pixels = np.random.default_rng(number).integers(0, 256, (20, 24, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(root / f"{number}.png")
    return root


def data(root, **changes):
    settings = {"crop_size": 8, "batch_size": 2, "steps_per_epoch": 4}
    return ImageFolderDataModule(root, **{**settings, **changes})


def epochs(module: ImageFolderDataModule, count: int = 2) -> list[torch.Tensor]:
    loader = module.train_dataloader()
    return [torch.cat(list(loader)) for _ in range(count)]


@pytest.mark.parametrize("settings", [{"num_workers": 1}, {"num_workers": 2, "prefetch": 3}])
def test_workers_give_the_same_batches(folder, settings):
    """In the second epoch too, which the same workers cut."""
    alone, together = data(folder), data(folder, **settings)
    assert all(map(torch.equal, epochs(alone), epochs(together)))
    for split in ("val_dataloader", "test_dataloader"):
        assert all(map(torch.equal, getattr(alone, split)(), getattr(together, split)()))


@pytest.mark.parametrize("workers", [0, 2])
def test_cutting_crops_draws_no_random_number_of_the_training(folder, workers):
    before = torch.get_rng_state()
    epochs(data(folder, num_workers=workers))
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("workers", [0, 1])
def test_a_photograph_that_turns_unreadable_is_one_line(folder, tmp_path, workers):
    root = tmp_path / "copy"
    root.mkdir()
    for path in folder.iterdir():
        (root / path.name).write_bytes(path.read_bytes())
    module = data(root, num_workers=workers, cache_bytes=0)
    batches = iter(module.train_dataloader())
    next(batches)
    for path in module.paths["train"]:
        path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(InputError) as caught:
        list(batches)
        next(iter(module.train_dataloader()))
    message = str(caught.value)
    assert message.startswith(str(root)) and message.endswith("=skip goes on without it")
    assert "\n" not in message


def test_waiting_for_batches_is_measured(folder):
    module = data(folder)
    epochs(module)
    assert module.waiting.batches == 2 * 3  # workers start in the first of an epoch
    assert 0.0 < module.waiting.latest <= module.waiting.seconds
    assert module.waiting.mean() == module.waiting.seconds / 6
    assert Waiting().mean() is None


def test_a_loader_of_workers_keeps_them(folder):
    loader = data(folder, num_workers=1).train_dataloader()
    assert isinstance(loader, DataLoader)
    workers = []
    for _ in range(2):
        list(loader)
        workers.append([worker.pid for worker in loader._iterator._workers])
    assert workers[0] == workers[1]


@pytest.mark.parametrize("fault", [ConnectionResetError, EOFError])
def test_a_worker_that_hangs_up_is_told_from_other_errors(fault):
    """It hangs up when it is killed, a moment before PyTorch finds it dead."""

    def watched(message, workers):
        def fail():
            yield torch.zeros(1)
            raise fault(message)

        return list(CropLoader([torch.zeros(1)], num_workers=workers)._watched(fail()))

    with pytest.raises(LostWorkerError) as caught:
        watched("reset by peer", 1)
    assert "reads photographs has ended" in machine_fault(caught.value)
    for message, workers in (("Caught it in DataLoader worker process 0.", 1), ("reset", 0)):
        with pytest.raises(fault):
            watched(message, workers)
