"""An index on disk gives what looking at the whole folder would give."""

import hashlib
import logging
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dolens.errors import InputError
from dolens.experiments.data import folder_index
from dolens.experiments.data.folder_index import IndexFile, PackedNames
from dolens.experiments.data.image_folder import ImageFolderDataModule

PIXELS = np.random.default_rng(0).integers(0, 256, (12, 14, 3), dtype=np.uint8)
# Names whose order as text differs from that of their parts, and one that is no UTF-8.
NAMES = [
    *("a-c/1.png", "a/b/1.png", "a/2.png", "é/3.png", "a b.JPEG", os.fsdecode(b"\xff.png")),
    *(f"n{number % 3}/{number:02}.jpg" for number in range(20)),
]


@pytest.fixture
def settled(monkeypatch, tmp_path):
    """Every index is kept, in a folder of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(folder_index, "user_cache_folder", lambda: tmp_path / "cache")
    monkeypatch.setattr(folder_index, "LEAST", 1)


def image(path: Path, pixels: np.ndarray = PIXELS) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)
    return path


def folder(root: Path) -> Path:
    for name in NAMES:
        image(root / name)
    return root


def data(root: Path, **changes) -> ImageFolderDataModule:
    return ImageFolderDataModule(root, **{"crop_size": 8, "batch_size": 2, **changes})


def split(module: ImageFolderDataModule) -> dict[str, list[Path]]:
    return {name: list(paths) for name, paths in module.paths.items()}


def plain_split(root: Path, seed: int, limit: int) -> dict[str, list[Path]]:
    """The rule as the first version of this module wrote it, with lists of paths."""

    def value(path: Path) -> float:
        text = f"{seed}:{path.relative_to(root).as_posix()}".encode("utf-8", "surrogateescape")
        return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "big") / 2**64

    hashed = sorted((value(path), path) for path in map(root.joinpath, NAMES))
    test = max(sum(v < 0.2 for v, _ in hashed), 1)
    both = max(sum(v < 0.5 for v, _ in hashed), test + 1)
    parts = {
        "train": hashed[both:],
        "validation": hashed[test:both][:limit],
        "test": hashed[:test][:limit],
    }
    return {name: sorted(path for _, path in part) for name, part in parts.items()}


@pytest.mark.parametrize("seed", [0, 3])
def test_the_split_is_the_one_by_plain_lists(settled, tmp_path, seed):
    root = folder(tmp_path / "root")
    settings = dict(validation_fraction=0.3, test_fraction=0.2, evaluation_limit=3, seed=seed)
    for _ in range(2):  # from the folder, and from the index
        assert split(data(root, **settings)) == plain_split(root, seed, 3)


def test_a_second_start_opens_no_file(settled, tmp_path, monkeypatch, caplog):
    root = folder(tmp_path / "root")
    (root / "broken.png").write_bytes(b"no image")
    first = split(data(root))
    opened = []
    monkeypatch.setattr(
        folder_index, "probe_picture", lambda path, _: opened.append(path) or "broken"
    )
    with caplog.at_level(logging.INFO):
        again = data(root)
        assert split(again) == first
    assert opened == again.skipped_files == [root / "broken.png"]  # it may have been mended
    assert f"{len(NAMES) + 1} of them known from the index in the cache" in caplog.text


def test_files_that_come_and_go_are_noticed(settled, tmp_path, monkeypatch, caplog):
    root = folder(tmp_path / "root")
    split(data(root))
    image(root / "n1" / "new.png")
    (root / NAMES[0]).unlink()
    image(root / "deep" / "er" / "new.png")
    opened, probe = [], folder_index.probe_picture
    monkeypatch.setattr(
        folder_index, "probe_picture", lambda path, _: opened.append(path) or probe(path, 64)
    )
    with caplog.at_level(logging.INFO):
        found = split(data(root))
    assert sorted(opened) == [root / "deep/er/new.png", root / "n1/new.png"]
    assert f"{len(NAMES) - 1} of them known" in caplog.text
    assert found == split(data(root, index=False))


@pytest.mark.parametrize("damage", ["cut", "flipped", "other", "empty"])
def test_a_damaged_index_is_made_anew(settled, tmp_path, caplog, damage):
    root = folder(tmp_path / "root")
    first = split(data(root))
    (kept,) = (tmp_path / "cache").rglob("*.npz")
    whole = bytearray(kept.read_bytes())
    if damage == "flipped":
        whole[len(whole) // 2] ^= 1
    if damage == "other":
        np.savez(kept, names=PackedNames.of(["x.png"]).text)
    else:
        kept.write_bytes({"cut": whole[:300], "flipped": whole, "empty": b""}[damage])
    assert split(data(root)) == first
    assert "the index is damaged" in caplog.text
    caplog.clear()
    assert split(data(root)) == first
    assert not caplog.records


def test_an_index_that_cannot_be_kept_costs_time_only(settled, tmp_path, monkeypatch, caplog):
    (tmp_path / "file").touch()
    monkeypatch.setattr(folder_index, "user_cache_folder", lambda: tmp_path / "file")
    assert split(data(folder(tmp_path / "root")))
    assert "cannot be kept for the next start" in caplog.text


def test_links_in_circles_and_to_nowhere(settled, tmp_path):
    root, elsewhere = folder(tmp_path / "root"), tmp_path / "elsewhere"
    (root / "n0" / "up").symlink_to(root)
    (root / "itself.png").symlink_to(root / "itself.png")
    (root / "linked").symlink_to(elsewhere)
    before = data(root)
    assert sum(map(len, before.paths.values())) == len(NAMES)
    assert before.skipped_files == [root / "itself.png"]
    image(elsewhere / "1.png")  # the folder with the link does not change
    assert sum(map(len, data(root).paths.values())) == len(NAMES) + 1


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="no folder is closed to root")
def test_a_folder_that_cannot_be_read_is_named(settled, tmp_path, caplog):
    root = folder(tmp_path / "root")
    (root / "a").chmod(0)
    try:
        assert split(data(root))
        assert f"{root / 'a'}: cannot be read (Permission denied)" in caplog.text
    finally:
        (root / "a").chmod(0o700)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names")
def test_a_pipe_is_not_waited_for(settled, tmp_path, caplog):
    root = folder(tmp_path / "root")
    os.mkfifo(root / "pipe.png")
    assert data(root).paths and data(root).skipped_files == []
    assert f"{root / 'pipe.png'}: not a readable image (is no file" in caplog.text


def test_an_interrupted_start_goes_on_where_it_was(settled, tmp_path, monkeypatch):
    root = folder(tmp_path / "root")
    probe, opened = folder_index.probe_picture, []

    def until_interrupted(path, megapixels):
        opened.append(path)
        if len(opened) == 10:
            raise KeyboardInterrupt
        return probe(path, megapixels)

    monkeypatch.setattr(folder_index, "probe_picture", until_interrupted)
    with pytest.raises(KeyboardInterrupt):
        split(data(root))
    split(data(root))
    assert len(opened) == len(NAMES) + 1  # the tenth twice


def test_a_picture_that_changed_is_noticed_when_it_is_opened(settled, tmp_path, caplog):
    root = folder(tmp_path / "root")
    split(data(root))
    module = data(root, verify=False)
    changed = module.paths["train"][0]
    image(changed, PIXELS[:10])
    photographs = module.photographs("train")
    for _ in range(2):
        assert photographs[0].height == 10
    assert sum("changed since its header was read" in text for text in caplog.messages) == 1
    assert caplog.messages[-1].startswith(str(changed))
    module.teardown("fit")
    caplog.clear()
    module = data(root)
    assert module.photographs("train")[0].height == 10
    assert not caplog.records


def test_small_folders_leave_nothing_in_the_cache(settled, tmp_path, monkeypatch):
    monkeypatch.setattr(folder_index, "LEAST", 2000)
    split(data(folder(tmp_path / "root")))
    assert not (tmp_path / "cache").exists()


def test_folders_and_endings_have_indices_of_their_own(tmp_path):
    paths = {
        IndexFile(tmp_path / name, endings).path
        for name in ("a", "b")
        for endings in ((".png",), (".jpg", ".png"))
    }
    assert len(paths) == 4


def test_an_image_bomb_is_one_line_and_no_memory(settled, tmp_path, caplog):
    root = folder(tmp_path / "root")
    (root / "bomb.png").write_bytes(bomb())
    module = data(root)
    assert module.paths and module.skipped_files == [root / "bomb.png"]
    assert "bomb.png: not a readable image (60000×60000 are 3600 million pixels" in caplog.text
    module = data(root, verify=False, validation_fraction=0.01, test_fraction=0.01)
    number = [path.name for path in module.paths["train"]].index("bomb.png")
    with pytest.raises(InputError, match=r"bomb.png: 60000×60000 are .*unreadable=skip"):
        module.photographs("train")[number]


def bomb() -> bytes:
    """A PNG of 60000×60000 pixels, as its header says."""

    def chunk(name: bytes, content: bytes) -> bytes:
        checked = name + content
        return struct.pack(">I", len(content)) + checked + struct.pack(">I", zlib.crc32(checked))

    header = struct.pack(">IIBBBBB", 60000, 60000, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b"\0" * 1000))
        + chunk(b"IEND", b"")
    )
