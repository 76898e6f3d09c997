import pytest
import torch

from dolens.errors import InputError
from dolens.experiments.data import package_photographs
from dolens.experiments.data.package_photographs import PhotosDataModule


def test_default_splits_are_disjoint_and_installed():
    data = PhotosDataModule(crop_size=32)
    data.setup()
    names = {
        split: {photo.name for photo in data.photographs(split)}
        for split in ("train", "validation", "test")
    }
    assert [len(of_split) for of_split in names.values()] == [10, 2, 3]
    assert len(set.union(*names.values())) == 15
    assert all(photo.encoded.dtype == torch.uint8 for photo in data.photographs("train"))


def test_batches():
    data = PhotosDataModule(
        train=["coins.png"],
        test=["coffee.png"],
        crop_size=32,
        margin=2,
        batch_size=3,
        steps_per_epoch=2,
    )
    assert next(iter(data.train_dataloader())).shape == (3, 3, 36, 36)
    assert len(list(data.test_dataloader())) == 2


def test_a_photograph_in_two_splits_is_an_error():
    with pytest.raises(InputError, match=r"data\.test: 'moon\.png' stands in train already"):
        PhotosDataModule(test=["moon.png"])


def test_the_stereo_pair_stays_together():
    with pytest.raises(InputError, match=r"both in one split"):
        PhotosDataModule(train=["motorcycle_left.png"], test=["motorcycle_right.png"])
    PhotosDataModule(train=["motorcycle_left.png"])


def test_an_unknown_name_suggests_the_nearest():
    with pytest.raises(InputError, match=r"did you mean 'astronaut\.png'\?"):
        PhotosDataModule(train=["astronaute.png"])


def test_an_empty_split_is_an_error():
    with pytest.raises(InputError, match=r"data\.validation: \[\]"):
        PhotosDataModule(validation=[])


def test_a_missing_file_names_the_version(tmp_path, monkeypatch):
    monkeypatch.setattr(package_photographs, "photographs_folder", lambda: tmp_path)
    with pytest.raises(InputError, match=r"rocket\.jpg: missing from scikit-image \d"):
        PhotosDataModule().setup("validate")
