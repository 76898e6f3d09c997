"""Photographs inside other files: found by their place, known by their hashes."""

import gzip
import hashlib
import io
import zipfile

import numpy as np
import pytest
import torch
from PIL import Image

from dolens.errors import InputError
from dolens.experiments.data.package_photographs import MANIFEST, read_manifest
from dolens.experiments.data.pretraining_photographs import (
    PRETRAINING_MANIFEST,
    pretraining_photographs,
    read_members,
)
from tests.experiments.data.test_package_photographs import manifest

COLUMNS = (
    *("package", "version", "path", "member", "offset", "length"),
    *("sha256", "licence", "shrink", "weight"),
)


def _picture(seed):
    pixels = np.random.default_rng(seed).integers(0, 256, (24, 36, 3), dtype=np.uint8)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return pixels, file.getvalue()


def _row(path, content, member="", offset="", length="", shrink=1, weight=1):
    digest = hashlib.sha256(content).hexdigest()
    return ["a-package", "1.0-1", path, member, offset, length, digest, "MIT", shrink, weight]


def _install(share):
    """One picture in a file of its own, one in an archive, two in documents; rows list them."""
    share.mkdir()
    pictures = [_picture(seed) for seed in range(4)]
    alone, zipped, resource, squeezed = (content for _, content in pictures)
    (share / "alone.png").write_bytes(alone)
    with zipfile.ZipFile(share / "game.pk3", "w") as archive:
        archive.writestr("walls/brick.png", zipped)
    (share / "theme.edj").write_bytes(b"header" + resource + b"the rest")
    (share / "manual.pdf.gz").write_bytes(gzip.compress(b"%PDF stream " + squeezed + b" end"))
    rows = [
        _row("alone.png", alone),
        _row("game.pk3", zipped, member="walls/brick.png", weight=0.3),
        _row("theme.edj", resource, offset=6, length=len(resource)),
        _row("manual.pdf.gz", squeezed, offset=12, length=len(squeezed)),
    ]
    return [pixels for pixels, _ in pictures], rows


def _listed(folder, rows):
    return manifest(folder, rows, COLUMNS)


def test_photographs_are_taken_out_of_what_holds_them(tmp_path):
    pictures, rows = _install(tmp_path / "share")
    found = pretraining_photographs([tmp_path, tmp_path / "share"], _listed(tmp_path, rows))
    for (photograph, _), pixels in zip(found, pictures, strict=True):
        assert torch.equal(photograph.encoded, torch.from_numpy(pixels).permute(2, 0, 1))
    assert [weight for _, weight in found] == [1.0, 0.3, 1.0, 1.0]
    assert [photograph.name for photograph, _ in found] == [
        "alone.png",
        "game.pk3!walls/brick.png",
        "theme.edj@6",
        "manual.pdf.gz@12",
    ]


def test_the_list_says_how_far_each_is_shrunk(tmp_path):
    pictures, rows = _install(tmp_path / "share")
    rows[0][COLUMNS.index("shrink")] = 12
    (photograph, _), *_ = pretraining_photographs([tmp_path / "share"], _listed(tmp_path, rows))
    encoded = pictures[0][:12, :12].astype(float) / 255.0
    light = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    mean = light.mean((0, 1))  # of noise: far above the straight part of the curve
    np.testing.assert_allclose(
        photograph.encoded[:, 0, 0], 255.0 * (1.055 * mean ** (1 / 2.4) - 0.055), atol=0.51
    )
    assert photograph.encoded.shape == (3, 2, 3)


@pytest.mark.parametrize("path", ["alone.png", "game.pk3", "theme.edj", "manual.pdf.gz"])
@pytest.mark.parametrize("content", [b"", b"of another version"])
def test_an_altered_file_is_refused(tmp_path, path, content):
    _, rows = _install(tmp_path / "share")
    (tmp_path / "share" / path).write_bytes(content)
    with pytest.raises(InputError, match=rf"{path}: not the file .* a-package, version 1\.0-1"):
        pretraining_photographs([tmp_path / "share"], _listed(tmp_path, rows))


def test_a_missing_file_names_itself_and_the_package(tmp_path):
    _, rows = _install(tmp_path / "share")
    (tmp_path / "share/theme.edj").unlink()
    with pytest.raises(InputError, match=r"theme\.edj: missing .* packages a-package"):
        pretraining_photographs([tmp_path / "share"], _listed(tmp_path, rows))


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("path", "../game.pk3", "line 3: path"),
        ("offset", "-1", "line 3: allowed"),
        ("length", "long", "line 3: allowed"),
        ("shrink", "0", "line 3: allowed"),
        ("weight", "nan", "line 3: allowed"),
    ],
)
def test_a_wrong_list_names_its_line(tmp_path, column, value, words):
    _, rows = _install(tmp_path / "share")
    rows[1][COLUMNS.index(column)] = value
    with pytest.raises(InputError, match=words):
        read_members(_listed(tmp_path, rows))


def test_the_projects_list_keeps_out_what_is_validated_and_tested_on():
    members = read_members(PRETRAINING_MANIFEST)
    judged = {entry.sha256 for entry in read_manifest(MANIFEST)}
    hashes = {member.sha256 for member in members}
    assert len(hashes) == len(members) >= 500
    assert not hashes & judged
    assert all(member.package and member.version and member.licence for member in members)
