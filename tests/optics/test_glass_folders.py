"""The user's own glass catalogues: where they are looked for, and what they are called."""

import pytest

from dolens import InputError, load_lens, save_lens
from dolens.optics.glass_catalog import catalogues, find_glass, glass_folders

# A glass of constant index, and another by a maker's name with the maker's own coefficients.
OWN = "NM GLASS1 5 0 1.7 0\nED 12.5 0 0 0 0\nCD 1.7 0 0\nTD 1E-6 0 0 0 0 0 20\nLD 0.4 0.7\n"
MELT = "NM N-BK7 5 0 1.6 0\nCD 1.6 0 0\nLD 0.4 0.7\n"


@pytest.fixture
def folder(tmp_path):
    place = tmp_path / "glass"
    place.mkdir()
    (place / "special.agf").write_text(OWN)
    (place / "Notes.txt").write_text("no catalogue")
    return place


def test_the_environment_names_folders(folder, tmp_path, monkeypatch):
    with pytest.raises(InputError, match="no maker 'SPECIAL'"):
        find_glass("SPECIAL:GLASS1")
    monkeypatch.setenv("DOLENS_GLASS", f"{tmp_path}:{folder}")
    for name in ("SPECIAL:GLASS1", "special:glass1", "GLASS1"):
        glass = find_glass(name)
        assert glass.name == "SPECIAL:GLASS1" and glass.index(550.0) == 1.7
    assert glass.expansion == pytest.approx(12.5e-6) and glass.thermal.d0 == 1e-6
    assert "SPECIAL" in catalogues() and "NOTES" not in catalogues()


def test_a_file_of_a_maker_s_name_is_asked_first(folder):
    (folder / "Schott.AGF").write_text(MELT)
    with glass_folders(folder):
        assert find_glass("N-BK7").index(550.0) == find_glass("SCHOTT:N-BK7").index(550.0) == 1.6
        assert find_glass("BK7").name == "SCHOTT:BK7"
    assert find_glass("N-BK7").index(550.0) == pytest.approx(1.5185, abs=1e-4)


def test_an_edited_catalogue_is_read_again(folder):
    with glass_folders(folder):
        assert find_glass("GLASS1").index(550.0) == 1.7
        (folder / "special.agf").write_text(OWN.replace("CD 1.7 0 0", "CD 1.75 0 0"))
        assert find_glass("GLASS1").index(550.0) == 1.75


LENS = """name: Own glass
surfaces:
  '1': {radius: 50, semi_diameter: 5, thickness: 4, material: 'SPECIAL:GLASS1'}
  '2': {radius: -50, semi_diameter: 5, material: air}
sensor: {distance: 40}
"""


@pytest.mark.parametrize("suffix", [".yaml", ".zmx"])
def test_a_lens_of_such_glass_is_read_and_written(folder, tmp_path, suffix):
    (tmp_path / "first.yaml").write_text(LENS)
    with pytest.raises(InputError, match="surface 1: unknown material 'SPECIAL:GLASS1'"):
        load_lens(tmp_path / "first.yaml")
    lens = load_lens(tmp_path / "first.yaml", glass_catalogues=folder)
    path = tmp_path / f"second{suffix}"
    save_lens(lens, path, glass_catalogues=[folder / "special.agf"])
    again = load_lens(path, glass_catalogues=[folder])
    assert again.materials == lens.materials
    if suffix == ".zmx":
        assert "GCAT SPECIAL" in path.read_text()


def test_what_is_wrong_is_said_in_one_line(folder, tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"glass catalogues: '.*nowhere' is no folder"):
        load_lens("cooke_triplet", glass_catalogues=tmp_path / "nowhere")
    (folder / "broken.agf").write_bytes(b"NM\0" + bytes(range(256)))
    with glass_folders(folder), pytest.raises(InputError, match=r"broken\.agf: is no text") as e:
        find_glass("GLASS1")
    assert "\n" not in str(e.value)
    monkeypatch.setenv("DOLENS_GLASS", str(tmp_path / "nowhere"))
    with pytest.raises(InputError, match=r"DOLENS_GLASS: '.*nowhere' is no folder and no file"):
        find_glass("N-BK7")
