"""Photographs of installed packages: found in folders of shared data, known by their hashes."""

import csv
import hashlib
from collections import Counter

import pytest
import torch
from PIL import Image

from dolens.errors import InputError
from dolens.experiments.data import package_photographs
from dolens.experiments.data.package_photographs import (
    MANIFEST,
    PackagePhotographsDataModule,
    PhotosDataModule,
    data_folders,
    read_manifest,
    shrunk,
)
from dolens.experiments.data.photographs import Photograph
from dolens.sensor.colour import linear_to_srgb

COLUMNS = ("split", "package", "version", "path", "sha256", "title")
FILES = (("train", "a.png"), ("validation", "b.png"), ("test", "deep/c.png"), ("test", "d.png"))


def _install(share):
    """Photographs in a folder, and the rows that list them."""
    rows = []
    for number, (split, path) in enumerate(FILES):
        file = share / path
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (40, 30), (10 * number, 0, 0)).save(file)
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        rows.append([split, "some-package", "1.0-1", path, digest, path])
    return rows


def manifest(folder, rows, columns=COLUMNS):
    path = folder / "list.csv"
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([columns, *rows])
    return path


def _data(manifest, **settings):
    settings = {"crop_size": 10, "scikit_image": (), **settings}
    return PackagePhotographsDataModule(manifest=str(manifest), **settings)


def test_the_projects_list_has_forty_photographs_that_nothing_trains_on():
    entries = read_manifest(MANIFEST)
    counts = Counter(entry.split for entry in entries)
    assert counts["test"] >= 40
    assert len({entry.sha256 for entry in entries}) == len(entries)
    assert all(len(entry.sha256) == 64 for entry in entries)
    assert all(entry.package and entry.version and entry.title for entry in entries)


def test_files_are_found_in_the_first_folder_that_has_them(tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    rows = _install(second)
    (first / "deep").mkdir(parents=True)
    (second / "deep/c.png").rename(first / "deep/c.png")
    data = _data(manifest(tmp_path, rows), folders=[str(first), str(second)])
    data.setup()
    assert [photo.name for photo in data.photographs("test")] == ["deep/c.png", "d.png"]
    assert [int(photo.encoded[0, 0, 0]) for photo in data.photographs("test")] == [20, 30]


def test_the_environment_names_the_folders(tmp_path, monkeypatch):
    rows = _install(tmp_path / "share")
    monkeypatch.setenv("XDG_DATA_DIRS", f"{tmp_path / 'nothing'}:{tmp_path / 'share'}")
    assert data_folders() == [tmp_path / "nothing", tmp_path / "share"]
    assert len(_data(manifest(tmp_path, rows)).photographs("test")) == 2


def test_a_missing_file_names_itself_and_the_packages(tmp_path):
    rows = _install(tmp_path / "share")
    (tmp_path / "share/d.png").unlink()
    data = _data(manifest(tmp_path, rows), folders=[str(tmp_path / "share")])
    with pytest.raises(InputError, match=r"d\.png: missing .* packages some-package"):
        data.setup("test")


def test_an_altered_file_is_refused(tmp_path):
    rows = _install(tmp_path / "share")
    Image.new("RGB", (40, 30), (99, 0, 0)).save(tmp_path / "share/d.png")
    data = _data(manifest(tmp_path, rows), folders=[str(tmp_path / "share")])
    data.setup("fit")  # another split's files are as listed
    with pytest.raises(InputError, match=r"d\.png: not the file .* some-package, version 1\.0-1"):
        data.setup("test")


def test_training_sees_scikit_images_photographs_besides(tmp_path):
    rows = _install(tmp_path / "share")
    folders = [str(tmp_path / "share")]
    data = _data(manifest(tmp_path, rows), folders=folders, scikit_image=["moon.png"])
    assert [photo.name for photo in data.photographs("train")] == ["a.png", "moon.png"]
    assert [photo.name for photo in data.photographs("validation")] == ["b.png"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda rows: rows[0].__setitem__(0, "tests"), "line 2: split 'tests'"),
        (lambda rows: rows[1].__setitem__(3, "../b.png"), "line 3: path"),
        (lambda rows: rows[3].__setitem__(3, "deep/c.png"), "line 5: path deep/c.png stands twice"),
        (lambda rows: rows[3].__setitem__(4, rows[0][4]), "line 5: sha256 .* stands twice"),
        (lambda rows: rows.pop(1), "no photographs to validation"),
        (lambda rows: rows[2].pop(), "line 4: 6 values"),
    ],
)
def test_a_wrong_list_names_its_line(tmp_path, change, words):
    rows = _install(tmp_path / "share")
    change(rows)
    with pytest.raises(InputError, match=words):
        _data(manifest(tmp_path, rows))


def test_other_columns_and_a_missing_list_are_errors(tmp_path):
    with pytest.raises(InputError, match="columns"):
        read_manifest(manifest(tmp_path, [], COLUMNS[1:]))
    with pytest.raises(InputError, match="does not exist"):
        read_manifest(tmp_path / "none.csv")


def test_large_photographs_are_averaged_in_linear_light():
    # Columns of black and white: half the light, which 188 encodes; the ninth column is left off.
    encoded = torch.zeros(3, 6, 9, dtype=torch.uint8)
    encoded[:, :, ::2] = 255
    small = shrunk(Photograph("lines", encoded), 4)
    assert (small.height, small.width) == (3, 4)
    half = round(float(linear_to_srgb(torch.tensor(0.5))) * 255)
    assert torch.equal(small.encoded, torch.full((3, 3, 4), half, dtype=torch.uint8))


def test_small_photographs_keep_their_pixels():
    photo = Photograph("small", torch.zeros(3, 6, 9, dtype=torch.uint8))
    assert shrunk(photo, 5) is photo


# ---------------------------------------------------------------- of scikit-image


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


def test_batches_of_scikit_image_s_photographs():
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


def test_a_missing_photograph_of_scikit_image_names_its_version(tmp_path, monkeypatch):
    monkeypatch.setattr(package_photographs, "photographs_folder", lambda: tmp_path)
    with pytest.raises(InputError, match=r"rocket\.jpg: missing from scikit-image \d"):
        PhotosDataModule().setup("validate")
