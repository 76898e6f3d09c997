"""Lenses that come with dolens are loaded by name."""

import pytest

from dolens import load_lens
from dolens.errors import InputError
from dolens.prescriptions import lens_names


def test_a_bare_name_means_a_lens_of_the_package(root, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    lens = load_lens("cooke_triplet")
    assert lens.name == "Cooke triplet" and len(lens.surfaces) == 6
    names = lens_names()
    assert names == sorted(path.stem for path in (root / "conf/lens").glob("*.yaml"))


def test_an_unknown_name_is_answered_with_near_ones(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"did you mean 'cooke_triplet'.*nikon"):
        load_lens("cook_triplet")


def test_a_path_is_never_taken_for_a_name(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for path in ("conf/nikon", "nikon.yaml"):
        with pytest.raises(InputError, match=r"end in|cannot be read"):
            load_lens(path)
    (tmp_path / "nikon").write_text("no lens")
    with pytest.raises(InputError, match="end in"):
        load_lens("nikon")
