"""Coatings that a Zemax file names are those of its coating file, on the right side of the glass.

Stacks are compared with characteristic matrices in Zemax's own sign, n - ik (Macleod, *Thin-Film
Optical Filters*, 2.3), at angles, with absorbing films.
"""

import cmath
import math

import pytest
import torch

from dolens import InputError, load_lens, save_lens
from dolens.prescriptions.files import read_lens_file
from dolens.prescriptions.zemax.coatings import coating_files, ideal_share
from tests.prescriptions.zemax.samples import singlet

PRIMARY = 0.6
HEAD = f"FLOA\nFTYP 0 0 1 2 0 0 0\nWAVM 1 0.5 1\nWAVM 2 {PRIMARY} 1\nPWAV 2\n"
GLASS = "GLAS ___BLANK 1 0 1.5 0"
FILE = """! materials come first
MATE LOW
0.5 1.40 0
0.7 1.36
MATE Film
0.55 2.10 -0.002   ! absorbs
0.65 2.00 -0.004
MATE METAL
0.55 0.7 -7.0

COAT QUARTER
LOW 0.25
COAT TWO
LOW 0.3 0
film 0.05 1 0
COAT LOOPS
LOW 0.25 0 0
FILM 0.25 0 3
LOW 0.25 0 3
FILM 0.1 1
COAT PROTECTED
LOW 0.5
METAL 1 1
IDEAL Half 0.5 0.4
IDEAL2 AMPS 0 0.6 0.8 0 0.1 0 0 0.9 1
TABLE MEASURED
ANGL 0
WAVE 0.5 0.01 0.01 0.99 0.99
WAVE 0.7 0.03 0.03 0.97 0.97
ANGL 60
WAVE 0.5 0.21 0.05 0.79 0.95
WAVE 0.7 0.23 0.07 0.77 0.93 10 0 0 0
ENCRYPTED SECRET
COAT GAINS
GAIN 0.25
MATE GAIN
0.5 1.5 0.1
COAT TAPERED
LOW 0.25 0 0 EDGE
COAT OPEN
LOW 0.25 0 2
COAT NOWHERE
GOLD 0.1 1
COAT TWICE
LOW 0.25
COAT TWICE
LOW 0.5
COAT WORDS
LOW thick
TABLE EMPTY
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "coating.dat").write_text(FILE)
    return tmp_path


def text(first="", second="", glass=GLASS):
    """A lens with one coating on its front and one on its back."""
    lines = ("CURV 0.02", "DISZ 4", glass, "DIAM 5", f"COAT {first}")
    return singlet(*lines, head=HEAD, last=f"DIAM 5\n  COAT {second}")


def coatings_of(folder, *given, **more):
    """The coatings of the lens's surfaces, as its trace sees them."""
    path = folder / "lens.zmx"
    path.write_text(text(*given, **more))
    lens = load_lens(path, coatings=folder / "coating.dat")
    return [surface.coating for surface in lens.system().surfaces]


def shares(coating, front, behind, degrees, nm=1e3 * PRIMARY):
    cosine = torch.tensor(math.cos(math.radians(degrees)), dtype=torch.float64)
    return [float(share.detach()) for share in coating.shares(front, behind, cosine, nm)]


def by_matrices(front, films, behind, degrees, um=PRIMARY):
    """R_s, R_p, T_s, T_p of films (n - ik, µm) between two media."""
    invariant = front * math.sin(math.radians(degrees))
    found = []
    for p in (False, True):

        def admittance(n, p=p):
            cosine = cmath.sqrt(1.0 - (invariant / n) ** 2)
            return n / cosine if p else n * cosine

        b, c = 1.0, admittance(behind)
        for n, thickness in reversed(films):
            delta = 2.0 * math.pi * n * thickness / um * cmath.sqrt(1.0 - (invariant / n) ** 2)
            eta, (cos, sin) = admittance(n), (cmath.cos(delta), 1j * cmath.sin(delta))
            b, c = cos * b + sin / eta * c, eta * sin * b + cos * c
        first, last = admittance(front), admittance(behind)
        found += [
            abs((first * b - c) / (first * b + c)) ** 2,
            4.0 * complex(first).real * complex(last).real / abs(first * b + c) ** 2,
        ]
    return [found[0], found[2], found[1], found[3]]


LOW, FILM = 1.38, 2.05 - 0.003j


def test_a_quarter_wave_of_the_primary_wavelength_reflects_as_in_closed_form(folder):
    first, second = coatings_of(folder, "quarter", "")
    known = ((1.5 - LOW**2) / (1.5 + LOW**2)) ** 2
    assert shares(first, 1.0, 1.5, 0.0)[:2] == pytest.approx([known, known], rel=1e-12)
    # The other surface names no coating, and is bare as in Zemax.
    assert shares(second, 1.5, 1.0, 0.0)[:2] == pytest.approx([0.04, 0.04], rel=1e-12)


@pytest.mark.parametrize("degrees", [0.0, 35.0])
def test_a_stack_is_turned_round_from_glass_to_air(folder, degrees):
    first, second = coatings_of(folder, "TWO", "TWO")
    films = [(LOW, 0.3 * PRIMARY / LOW), (FILM, 0.05)]
    assert shares(first, 1.0, 1.5, degrees) == pytest.approx(
        by_matrices(1.0, films, 1.5, degrees), rel=1e-11
    )
    assert shares(second, 1.5, 1.0, degrees) == pytest.approx(
        by_matrices(1.5, films[::-1], 1.0, degrees), rel=1e-11
    )


def test_between_the_rows_of_a_material_its_index_is_linear(folder):
    first, _ = coatings_of(folder, "TWO", "")
    # At 560 nm, of 1.40 to 1.36 over 200 nm and of 2.10 - 0.002i to 2.00 - 0.004i over 100 nm.
    films = [(1.388, 0.3 * PRIMARY / LOW), (2.09 - 0.0022j, 0.05)]
    known = by_matrices(1.0, films, 1.5, 20.0, um=0.56)
    assert shares(first, 1.0, 1.5, 20.0, 560.0) == pytest.approx(known, rel=1e-11)


def test_layers_between_two_loop_numbers_are_repeated(folder):
    first, _ = coatings_of(folder, "LOOPS", "")
    low, film = (LOW, 0.25 * PRIMARY / LOW), (FILM, 0.25 * PRIMARY / FILM.real)
    known = by_matrices(1.0, [low, *3 * [film, low], (FILM, 0.1)], 1.5, 10.0)
    assert shares(first, 1.0, 1.5, 10.0) == pytest.approx(known, rel=1e-11)


def test_the_last_layer_of_a_mirror_is_its_substrate(folder):
    mirror, behind = coatings_of(folder, "PROTECTED", "", glass="GLAS MIRROR 0 0 1.5 40")
    known = by_matrices(1.0, [(LOW, 0.5 * PRIMARY / LOW)], 0.7 - 7.0j, 25.0)
    assert shares(mirror, 1.0, 1.0, 25.0)[:2] == pytest.approx(known[:2], rel=1e-11)
    assert behind is None  # a plane of air in air


def test_a_mirror_without_a_coating_is_thick_aluminium(folder):
    mirror, _ = coatings_of(folder, "", "QUARTER", glass="GLAS MIRROR 0 0 1.5 40")
    known = abs((1.0 - (0.7 - 7.0j)) / (1.0 + (0.7 - 7.0j))) ** 2
    assert shares(mirror, 1.0, 1.0, 0.0)[0] == pytest.approx(known, rel=1e-12)


def test_ideal_coatings_have_their_shares_at_any_angle_and_wavelength(folder):
    half, amplitudes = coatings_of(folder, "HALF", "AMPS")
    for degrees, nm in ((0.0, 500.0), (30.0, 640.0)):
        assert shares(half, 1.0, 1.5, degrees, nm) == pytest.approx([0.4, 0.4, 0.5, 0.5])
        known = [0.36, 0.01, 0.64, 0.81]
        assert shares(amplitudes, 1.5, 1.0, degrees, nm) == pytest.approx(known)


def test_angles_of_a_table_are_those_on_the_side_of_the_lower_index(folder):
    first, second = coatings_of(folder, "MEASURED", "MEASURED")
    known = [0.12, 0.04, 0.88, 0.96]  # at 30° in air and 600 nm, halfway
    assert shares(first, 1.0, 1.5, 30.0) == pytest.approx(known, rel=1e-9)
    inside = math.degrees(math.asin(0.5 / 1.5))
    assert shares(second, 1.5, 1.0, inside) == pytest.approx(known, rel=1e-9)


def test_a_table_whose_angles_are_behind_is_written_and_read_again(folder):
    coatings_of(folder, "", "MEASURED")
    lens = load_lens(folder / "lens.zmx", coatings=folder)
    save_lens(lens, folder / "lens.yaml")
    again = load_lens(folder / "lens.yaml").system().surfaces[1].coating
    assert again == lens.system().surfaces[1].coating and again.turned
    with pytest.raises(InputError, match=r"a \.zmx file cannot hold 'coating'"):
        save_lens(lens, folder / "again.zmx")


def test_some_names_say_which_share_passes(tmp_path):
    named = {"I.95": 0.95, "i.0": 0.0, "I.0.5": 0.5, "I.1.0": 1.0, "I.995": 0.995}
    for name, share in named.items():
        assert ideal_share(name) == pytest.approx(share)
    for name in ("I", "I.", "INF", "I.2.0", "AR", "I95"):
        assert ideal_share(name) is None
    path = tmp_path / "lens.zmx"
    path.write_text(text("I.95", ""))
    first, second = [surface.coating for surface in load_lens(path).system().surfaces]
    assert shares(first, 1.0, 1.5, 40.0) == pytest.approx([0.05, 0.05, 0.95, 0.95])
    assert second is None
    assert "COAT" not in "; ".join(read_lens_file(path).passed_over)


def said(folder, first, second="", files=()):
    path = folder / "lens.zmx"
    path.write_text(text(first, second))
    with coating_files(files):
        return "; ".join(read_lens_file(path).passed_over)


def test_without_a_file_coatings_are_listed_by_name_and_the_lens_is_ideal(folder):
    words = said(folder, "TWO", "WAR")
    assert "coatings (COAT): TWO, WAR, which need a coating file, such as coating.dat" in words
    lens = load_lens(folder / "lens.zmx")
    assert all(surface.coating is None for surface in lens.surfaces.values())


def test_what_of_coatings_is_not_read_is_listed(folder):
    file = folder / "coating.dat"
    assert f"coatings (COAT): WAR, which {file} does not have" in said(folder, "WAR", files=file)
    assert "phases of the coating MEASURED" in said(folder, "MEASURED", files=file)
    assert "phases of the coating AMPS" in said(folder, "AMPS", files=file)
    # The lens has light of 500 nm.
    words = said(folder, "TWO", files=file)
    assert "the material film beyond its 550 to 650 nm, where its ends hold" in words
    assert "surfaces without COAT: as in Zemax, glass is bare" in words
    assert "the material LOW" not in words


def test_the_environment_names_files_and_folders(folder, monkeypatch):
    coatings_of(folder, "QUARTER", "")
    monkeypatch.setenv("DOLENS_COATINGS", str(folder))
    assert load_lens(folder / "lens.zmx").surfaces["1"].coating is not None
    # Of a folder it is the file that the lens names.
    path = folder / "lens.zmx"
    path.write_text('COFN QF "C:\\own\\SPECIAL.DAT" "SCATTER_PROFILE.DAT"\n' + path.read_text())
    assert load_lens(path).surfaces["1"].coating is None
    (folder / "Special.dat").write_text(FILE)
    assert load_lens(path).surfaces["1"].coating is not None
    monkeypatch.setenv("DOLENS_COATINGS", str(folder / "nowhere"))
    with pytest.raises(InputError, match=r"DOLENS_COATINGS: '.*nowhere' is no folder and no file"):
        load_lens(path)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("SECRET", "coating SECRET of .* is encrypted; ask its maker"),
        ("GAINS", r"material GAIN, line \d+: the imaginary part 0.1 amplifies light"),
        ("TAPERED", r"line \d+: a layer that tapers \(EDGE\) is not held"),
        ("OPEN", "the loop of 2 is not closed"),
        ("NOWHERE", r"there is no material GOLD \(MATE\)"),
        ("TWICE", r"is there twice, in lines \d+ and \d+"),
        ("WORDS", "must be a number, not 'thick'"),
        ("EMPTY", "the table is empty"),
    ],
)
def test_a_coating_that_cannot_be_held_is_refused_in_one_line(folder, name, message):
    path = folder / "lens.zmx"
    path.write_text(text(name, ""))
    with pytest.raises(InputError, match=message) as caught:
        load_lens(path, coatings=folder)
    assert str(caught.value).startswith(f"{path}: surface 1: coating {name} of") or (
        "material" in str(caught.value)
    )
    assert "\n" not in str(caught.value)
    load_lens(path)  # ideal without the coating file


def test_what_is_no_coating_file_is_refused(folder):
    coatings_of(folder, "QUARTER", "")
    (folder / "own.dat").write_text("1 2 3\n")
    with pytest.raises(InputError, match=r"own\.dat: is no coating file"):
        load_lens(folder / "lens.zmx", coatings=folder / "own.dat")
    with pytest.raises(InputError, match=r"coatings: '.*none\.dat' is no folder and no file"):
        load_lens(folder / "lens.zmx", coatings=folder / "none.dat")
