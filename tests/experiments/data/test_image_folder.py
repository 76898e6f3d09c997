import logging

import numpy as np
import pytest
import torch
from PIL import Image

from dolens.errors import InputError
from dolens.experiments.data.image_folder import ImageFolderDataModule
from dolens.experiments.data.photographs import FolderPhotographs


def _image(path, value=0):
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(value).integers(0, 256, (12, 14, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path)


def _cut_off(path):
    """An image whose header is sound and whose pixels end too early."""
    _image(path)
    path.write_bytes(path.read_bytes()[:400])


def _folder(root, count=20):
    for number in range(count):
        _image(root / f"group {number % 3}" / f"{number:03}.png", number)
    return root


def _data(root, **changes):
    arguments = {"crop_size": 8, "batch_size": 2, "steps_per_epoch": 3}
    return ImageFolderDataModule(root, **{**arguments, **changes})


def _split_of(data):
    return {path: split for split, paths in data.paths.items() for path in paths}


def test_files_are_split_and_every_split_has_some(tmp_path):
    data = _data(_folder(tmp_path))
    data.setup()
    assert all(data.paths.values())
    assert sum(map(len, data.paths.values())) == len(_split_of(data)) == 20
    assert next(iter(data.train_dataloader())).shape == (2, 3, 8, 8)
    assert _split_of(_data(tmp_path)) == _split_of(data)
    assert _split_of(_data(tmp_path, seed=1)) != _split_of(data)


def test_the_split_depends_on_the_path_below_the_root_alone(tmp_path):
    fractions = {"validation_fraction": 0.3, "test_fraction": 0.3}
    here = _data(_folder(tmp_path / "here"), **fractions)
    there = _data(_folder(tmp_path / "elsewhere" / "there"), **fractions)
    assert {path.relative_to(here.root): split for path, split in _split_of(here).items()} == {
        path.relative_to(there.root): split for path, split in _split_of(there).items()
    }
    _image(here.root / "new.png")
    grown = _split_of(_data(here.root, **fractions))
    assert all(grown[path] == split for path, split in _split_of(here).items())


def test_three_files_are_enough_and_two_are_not(tmp_path):
    data = _data(_folder(tmp_path, 3))
    assert [len(paths) for paths in data.paths.values()] == [1, 1, 1]
    next(tmp_path.rglob("*.png")).unlink()
    with pytest.raises(InputError, match="2 readable images for 3 splits"):
        _data(tmp_path).setup()


def test_subfolders_are_the_splits(tmp_path):
    for number in range(6):
        _image(tmp_path / "train" / f"n{number}" / "a.JPEG")
    for number in range(4):
        _image(tmp_path / "val" / f"n{number}" / "b.JPEG")
    data = _data(tmp_path)
    assert all("train" in path.parts for path in data.paths["train"])
    assert [len(paths) for paths in data.paths.values()] == [6, 2, 2]
    evaluation = {*data.paths["validation"], *data.paths["test"]}
    assert evaluation == set((tmp_path / "val").rglob("*.JPEG"))
    _image(tmp_path / "test" / "c.png")
    data = _data(tmp_path, evaluation_limit=3)
    assert [len(paths) for paths in data.paths.values()] == [6, 3, 1]


def test_unreadable_headers_are_left_out_and_counted(tmp_path, caplog):
    _folder(tmp_path)
    for name in ("x.png", "y.jpg"):
        (tmp_path / name).write_bytes(b"no image")
    data = _data(tmp_path)
    with caplog.at_level(logging.WARNING):
        data.setup("fit")
    assert data.skipped_files == [tmp_path / "x.png", tmp_path / "y.jpg"]
    assert not set(data.skipped_files) & set(_split_of(data))
    assert sum("x.png" in text for text in caplog.messages) == 1
    assert caplog.messages[-1] == f"skipped 2 unreadable files of 22 in {tmp_path}"


@pytest.mark.parametrize("workers", [0, 2])
def test_files_that_fail_to_decode_are_replaced_and_counted(tmp_path, caplog, workers):
    for number in range(3):
        _image(tmp_path / "train" / f"{2 * number}.png", number)
    _cut_off(tmp_path / "train" / "3.png")
    _image(tmp_path / "val" / "a.png")
    _image(tmp_path / "test" / "a.png")
    data = _data(tmp_path, steps_per_epoch=8, num_workers=workers)
    with caplog.at_level(logging.WARNING):
        data.setup("fit")
        batches = torch.cat(list(data.train_dataloader()))
        again = torch.cat(list(_data(tmp_path, steps_per_epoch=8).train_dataloader()))
        data.teardown("fit")
    assert torch.equal(batches, again)
    assert data.skipped_files == [tmp_path / "train" / "3.png"]
    assert caplog.messages[-1] == f"skipped 1 unreadable files of 6 in {tmp_path}"


def test_the_next_readable_file_takes_the_place(tmp_path, caplog):
    paths = [tmp_path / f"{number}.png" for number in range(4)]
    for number in (0, 1):
        _image(paths[number], number)
    for number in (2, 3):
        _cut_off(paths[number])
    photographs = FolderPhotographs(tmp_path, paths, cache_bytes=0, unreadable="skip")
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            names = [photographs[number].name for number in range(4)]
            assert names == [str(paths[number]) for number in (0, 1, 0, 0)]
    assert len(caplog.messages) == 2
    assert caplog.messages[-1].endswith("skipped 2 unreadable files of 4")
    assert photographs.unreadable == paths[2:]


def test_memory_is_bounded(tmp_path):
    paths = [tmp_path / f"{number}.png" for number in range(4)]
    for path in paths:
        _image(path)
    size = 3 * 12 * 14
    photographs = FolderPhotographs(tmp_path, paths, cache_bytes=2 * size)
    first = photographs[0]
    assert photographs[0] is first
    for photograph in photographs:
        assert photograph.encoded.numel() == size
    assert sum(p.encoded.numel() for p in photographs._cache.values()) == 2 * size
    assert photographs[0] is not first


def test_without_verification_no_header_is_read(tmp_path):
    _folder(tmp_path)
    (tmp_path / "x.png").write_bytes(b"no image")
    data = _data(tmp_path, verify=False)
    data.setup()
    assert data.skipped_files == []
    assert tmp_path / "x.png" in _split_of(data)


def test_hopeless_folders_are_named(tmp_path):
    with pytest.raises(InputError, match=r"none: does not exist; allowed: .*\.jpg"):
        _data(tmp_path / "none").setup()
    with pytest.raises(InputError, match=r"no images in this folder; allowed: .*\.jpg"):
        _data(tmp_path).setup()
    _image(tmp_path / "alone.png")
    with pytest.raises(InputError, match="is not a folder"):
        _data(tmp_path / "alone.png").setup()
    (tmp_path / "alone.png").unlink()
    for number in range(4):
        (tmp_path / f"{number}.png").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"none of 4 files is a readable image; allowed: .*\.jpg"):
        _data(tmp_path).setup()
    data = _data(tmp_path, verify=False, unreadable="skip")
    with pytest.raises(InputError, match=r"none of 2 files can be decoded"):
        next(iter(data.train_dataloader()))


@pytest.mark.parametrize(
    ("arguments", "key"),
    [
        ({"validation_fraction": 0.0}, "validation_fraction"),
        ({"test_fraction": 1.0}, "test_fraction"),
        ({"validation_fraction": 0.5, "test_fraction": 0.5}, "test_fraction"),
        ({"evaluation_limit": 0}, "evaluation_limit"),
        ({"extensions": []}, "extensions"),
        ({"unreadable": "ignore"}, "unreadable"),
    ],
)
def test_bad_arguments_are_named(tmp_path, arguments, key):
    with pytest.raises(InputError, match=rf"data\.{key}: "):
        _data(tmp_path, **arguments)
