import pytest
import torch

from dolens.errors import InputError
from dolens.experiments.data.camera_data import CropDataModule
from dolens.experiments.data.photographs import Photograph


class _Data(CropDataModule):
    def load_split(self, split):
        generator = torch.Generator().manual_seed(len(split))
        encoded = torch.randint(0, 256, (3, 40, 50), generator=generator, dtype=torch.uint8)
        return [Photograph(split, encoded)] * 3


def test_batches_hold_crop_and_margin():
    data = _Data(crop_size=(8, 12), margin=3, batch_size=2, steps_per_epoch=4)
    data.setup("fit")
    batches = list(data.train_dataloader())
    assert data.item_size == (14, 18)
    assert len(batches) == len(data.train_dataloader()) == 4
    for batch in batches:
        assert batch.shape == (2, 3, 14, 18)
        assert batch.dtype == torch.float32
        assert batch.min() >= 0 and batch.max() <= 1


def test_evaluation_batches_are_always_the_same():
    data = _Data(crop_size=8, batch_size=4, evaluation_crops_per_photograph=2)
    first, second = (torch.cat(list(data.val_dataloader())) for _ in range(2))
    assert first.shape == (6, 3, 8, 8)
    assert torch.equal(first, second)
    assert not torch.equal(torch.cat(list(data.test_dataloader())), first)


def test_the_most_detailed_crop_is_the_one_whose_texels_differ_most():
    class Striped(_Data):
        def load_split(self, split):
            flat = torch.full((3, 12, 12), 90, dtype=torch.uint8)
            striped = flat.clone()
            striped[..., ::2] = 200
            return [Photograph("flat", flat), Photograph("striped", striped)]

    found = Striped(crop_size=8, margin=2).most_detailed()
    assert found.shape == (1, 3, 12, 12)
    assert float(found.diff(dim=-1).abs().mean()) > 0.1


def test_a_stage_loads_only_what_it_needs():
    class Recording(_Data):
        loaded: list[str]

        def load_split(self, split):
            self.loaded.append(split)
            return super().load_split(split)

    data = Recording()
    data.loaded = []
    data.setup("test")
    assert data.loaded == ["test"]
    data.setup()
    assert sorted(data.loaded) == ["test", "train", "validation"]


@pytest.mark.parametrize(
    "arguments",
    [
        {"crop_size": 0},
        {"crop_size": (4,)},
        {"crop_size": "4x4"},
        {"margin": -1},
        {"batch_size": 0},
        {"batch_size": 2.5},
        {"steps_per_epoch": 0},
        {"scale_range": (2.0, 1.0)},
        {"scale_range": 2.0},
        {"evaluation_crops_per_photograph": 0},
        {"evaluation_scale": 0.0},
        {"num_workers": -1},
        {"num_workers": 10**12},
        {"prefetch": 10**12},
        {"seed": -1},
    ],
)
def test_bad_arguments_are_named(arguments):
    (name,) = arguments
    with pytest.raises(InputError, match=rf"data\.{name}: .*; allowed: "):
        _Data(**arguments)
