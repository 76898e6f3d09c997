"""Pictures of runs for the cards of the documentation."""

import pytest
import yaml
from PIL import Image

from scripts import gallery


@pytest.fixture
def pictures(tmp_path, monkeypatch):
    folder = tmp_path / "pictures"
    monkeypatch.setattr(gallery, "PICTURES", folder)
    monkeypatch.setattr(gallery, "SETTINGS", folder / "settings.yaml")
    return folder


def run_of(folder, *overrides, size=(1440, 1260)):
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra/overrides.yaml").write_text(yaml.safe_dump(list(overrides)))
    (folder / "figures").mkdir()
    Image.effect_noise(size, 60).save(folder / "figures/layout.png")
    return folder


def test_a_figure_becomes_a_small_picture_whatever_it_shows(pictures, tmp_path):
    assert gallery.take(run_of(tmp_path / "run", "experiment=nikon"), None) == "nikon"
    with Image.open(pictures / "nikon.webp") as card:
        assert card.size == gallery.SIZE
    assert (pictures / "nikon.webp").stat().st_size <= gallery.MOST_BYTES


def test_what_a_shorter_run_changed_is_kept_and_the_next_whole_run_forgets_it(pictures, tmp_path):
    short = run_of(tmp_path / "short", "experiment=zoom", "trainer.max_epochs=2")
    gallery.take(short, "layout")
    assert yaml.safe_load(gallery.SETTINGS.read_text()) == {"zoom": "trainer.max_epochs=2"}
    assert "picture of a shorter run" in gallery.experiment_card("zoom", "states.md")
    gallery.take(run_of(tmp_path / "whole", "experiment=zoom"), "layout")
    assert not yaml.safe_load(gallery.SETTINGS.read_text())


def test_a_run_without_the_figure_is_named(pictures, tmp_path):
    with pytest.raises(SystemExit, match=r"run has none of .*figures/spots\.png"):
        gallery.take(run_of(tmp_path / "run", "experiment=nikon"), "spots")
