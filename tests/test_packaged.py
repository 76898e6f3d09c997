"""The configuration that comes with dolens is found in a checkout and in an installed package."""

import pytest

from dolens import files
from dolens.errors import InputError
from dolens.files import packaged_configuration


def test_a_checkout_uses_its_own_conf(root):
    assert packaged_configuration() == root / "conf"


def test_an_installed_package_uses_the_folder_within_it(tmp_path, monkeypatch):
    """A folder `conf` beside the packages of a Python installation belongs to someone else."""
    for folder in ("dolens/conf", "conf"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "train.yaml").touch()
    monkeypatch.setattr(files, "__file__", str(tmp_path / "dolens/files.py"))
    assert packaged_configuration() == tmp_path / "dolens/conf"


def test_an_incomplete_installation_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "__file__", str(tmp_path / "dolens/files.py"))
    with pytest.raises(InputError, match=r"no train.yaml in .*install dolens again"):
        packaged_configuration()
