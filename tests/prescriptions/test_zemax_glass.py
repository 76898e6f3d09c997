"""A `.zmx` file's glasses: the catalogue that it names, or a refusal, and never another maker's.

Indices are those that the makers print: Schott's F2 1.62004/36.37 and SF6 1.80518/25.43, Schott's
old F6 1.63636/35.34, CDGM's F6 1.62495/35.58 and F2 1.61293/36.99, Hikari's F2 1.62004/36.33.
"""

import pytest
import torch

from dolens import InputError, load_lens, save_lens
from dolens.optics.materials import abbe_number, index_d, index_model, parse_material
from dolens.prescriptions import lens_from_prescription, prescription_of
from dolens.prescriptions.zemax_reader import prescription_from_zemax
from dolens.prescriptions.zemax_writer import zemax_of
from tests.prescriptions.zemax_samples import singlet

NOTHING = "0 0 1.5 40 0 0 0 0 0 0"  # what Zemax writes beside a name


def material(glas, catalogues=None):
    head = "FLOA\n" if catalogues is None else f"GCAT {catalogues}\nFLOA\n"
    text = singlet("CURV 0.02", "DIAM 5", f"GLAS {glas}", head=head)
    return prescription_from_zemax(text, "lens.zmx")["surfaces"]["1"]["material"]


@pytest.mark.parametrize(
    ("catalogues", "nd", "vd"),
    [
        ("SCHOTT", 1.62004, 36.37),
        ("SCHOTT_2000 CDGM", 1.62004, 36.37),
        ("CDGM SCHOTT", 1.61293, 36.99),
        ("cdgm-zemax", 1.61293, 36.99),
        ("HIKARI SCHOTT CDGM", 1.62004, 36.33),
        ("OHARA NIKON-HIKARI", 1.62004, 36.33),
    ],
)
def test_the_first_catalogue_that_has_the_name(catalogues, nd, vd):
    found = parse_material(material(f"F2 {NOTHING}", catalogues), index_model("dfc"))
    assert index_d(found) == pytest.approx(nd, abs=6e-6)
    assert abbe_number(found) == pytest.approx(vd, abs=6e-3)


@pytest.mark.parametrize("name", ["F4", "F6", "F7", "F13", "BAF2", "BAF3", "BAF8"])
def test_a_glass_that_schott_no_longer_prints_is_no_other_maker_s(name):
    with pytest.raises(InputError) as error:
        material(f"{name} {NOTHING}", "SCHOTT")
    said = str(error.value)
    assert said.startswith(f"lens.zmx: surface 1: GLAS {name} is in none of the file's catalogues")
    assert "(GCAT SCHOTT)" in said and "\n" not in said


def test_a_refusal_says_what_could_be_written_instead():
    with pytest.raises(InputError) as error:
        material("F6 0 0 1.63636 35.34 0 0 0 0 0 0", "SCHOTT")
    instead = str(error.value).rpartition("write GLAS ")[2]
    assert material(instead, "SCHOTT") == "1.63636/35.34"


REFUSED = {
    "numbers of another glass": ("F6 0 0 1.63636 35.34", "CDGM",
                                 "nd 1.63636 and Vd 35.34 of its line are not those of CDGM:F6"),
    "an earlier catalogue that may have it": (f"F6 {NOTHING}", "SCHOTT CDGM",
                                              "SCHOTT, which GCAT names before CDGM, may have"),
    # Lanthanum fluoride and barium fluoride in Zemax's own catalogues.
    "an earlier mixed catalogue": (f"LAF3 {NOTHING}", "MISC HOYA", "MISC, which GCAT names before"),
    "an earlier unknown catalogue": (f"BAF2 {NOTHING}", "INFRARED CDGM", "INFRARED, which GCAT"),
    "no catalogue, several makers": (f"F2 {NOTHING}", None, "the file has no GCAT, and several"),
    "no catalogue, an old name": (f"F6 {NOTHING}", None, "the file has no GCAT, and several"),
    "no catalogue, numbers of nobody here": ("F6 0 0 1.63636 35.34", None, "has no GCAT"),
    "no catalogue, numbers of two makers": ("SF6 0 0 1.80518 25.43", None,
                                            "(here: SCHOTT, HIKARI)"),
    "nobody's": (f"N-BK77 {NOTHING}", None, "did you mean 'N-BK7'"),
    "nobody's in that catalogue": (f"N-BK7 {NOTHING}", "OHARA", "SCHOTT has another"),
    "a plastic of another index": ("PMMA 0 0 1.49176 57.44", "MISC", "not those of PLASTIC:PMMA"),
    "a plastic of an unknown maker": ("OKP4 0 0 1.607 27.6", "OSAKA", "in none of the file's"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_read_as_meant(case):
    glas, catalogues, said = REFUSED[case]
    with pytest.raises(InputError) as error:
        material(glas, catalogues)
    message = str(error.value)
    assert message.startswith(f"lens.zmx: surface 1: GLAS {glas.split()[0]}")
    assert said in message and "\n" not in message


@pytest.mark.parametrize(
    ("glas", "catalogues", "name"),
    [
        # As Zemax prints them: with every digit, with a partial dispersion, with a pick-up.
        ("N-SK2 0 0 1.6073809697000001 56.650107819989998 -0.0008 1 1 1 0 0", "SCHOTT", "N-SK2"),
        ("F5 2 5 1.6034202574700001 38.029919148890002 -0.0003 0 0 0 0 0", "SCHOTT", "F5"),
        ("N-BK7 0 0 1.517 64.2", "SCHOTT", "N-BK7"),
        # Nothing but nd and Vd says whose it is.
        ("F2 0 0 1.62004 36.37", None, "F2"),
        (f"N-BK7 {NOTHING}", None, "N-BK7"),
        ("N-BK7", "MISC OHARA SCHOTT", "N-BK7"),
        ("F2 0 0 1.62004 36.37", "INFRARED SCHOTT", "F2"),
    ],
)
def test_what_can_be(glas, catalogues, name):
    assert material(glas, catalogues) == f"SCHOTT:{name}"


def lens_of(first, second="air", **keys):
    rows = {
        "1": {"radius": 50.0, "semi_diameter": 5.0, "thickness": 6.0, "material": first},
        "2": {"radius": -80.0, "semi_diameter": 5.0, "thickness": 2.0, "material": second},
        "3": {"radius": -90.0, "semi_diameter": 5.0, "material": "air"},
    }
    return lens_from_prescription(
        {"name": "Doublet", "surfaces": rows, "sensor": {"distance": 50.0}, **keys}
    )


KINDS = ["air", "occluder", "1.5", "2", "1.51680/64.17", "N-BK7", "SCHOTT:F2", "CDGM:F6",
         "HIKARI:SF6", "SCHOTT:SF6", "HIKARI:5165", "K-PG325(M)", "SCHOTT:IRG22", "PMMA",
         "ZEONEX-E48R", "POLYCARB"]  # fmt: skip


@pytest.mark.parametrize("suffix", [".yaml", ".zmx", ".txt"])
@pytest.mark.parametrize("where", ["surface", "object"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_lens_of_every_kind_of_material_comes_back(kind, where, suffix, tmp_path):
    lens = lens_of("1.6/40", object_material=kind) if where == "object" else lens_of(kind)
    path = tmp_path / f"lens{suffix}"
    # The diffoptics format has nd and Vd alone.
    if suffix == ".txt" and kind not in ("air", "occluder", "1.51680/64.17"):
        place = "object" if where == "object" else "surface 1"
        with pytest.raises(InputError, match=rf"{place}: a \.txt file cannot hold material"):
            save_lens(lens, path)
        assert not path.exists()
        return
    save_lens(lens, path)
    found = load_lens(path)
    for before, after in zip(lens.materials, found.materials, strict=True):
        # In a .zmx file an occluder is air, of the same index.
        assert before.name == after.name or (kind, suffix) == ("occluder", ".zmx")
        wavelength = 5000.0 if "IRG22" in before.name else 550.0
        assert before.index(wavelength) == after.index(wavelength)
    if kind != "occluder":
        for key, value in prescription_of(lens)["surfaces"].items():
            assert prescription_of(found)["surfaces"][key] == value


@pytest.mark.parametrize(
    "first", ["SCHOTT:N-BK7", "CDGM:H-K9L", "HIKARI:J-BK7A", "HOYA:FCD1", "PMMA"]
)
@pytest.mark.parametrize("second", ["SCHOTT:F2", "CDGM:F6", "HIKARI:SF6", "OHARA:S-BSL7"])
def test_glasses_of_two_makers_each_by_its_catalogue(first, second):
    """The order of GCAT alone must say it: Zemax does not look at nd and Vd."""
    lens = lens_of(first, second)
    text = zemax_of(prescription_of(lens))
    bare = [
        " ".join(line.split()[:2]) if line.startswith("  GLAS") else line
        for line in text.splitlines()
    ]
    rows = prescription_from_zemax("\n".join(bare))["surfaces"]
    assert [rows[n]["material"] for n in "12"] == [m.name for m in lens.materials[1:3]]


@pytest.mark.parametrize(
    ("first", "second"),
    # Zemax's own SCHOTT has another F6.
    [("CDGM:F2", "SCHOTT:F2"), ("HIKARI:SF6", "SCHOTT:F2"), ("CDGM:F6", "SCHOTT:F2")],
)
def test_two_glasses_that_no_order_of_catalogues_can_tell_apart(first, second, tmp_path):
    with pytest.raises(InputError, match=rf"cannot hold {first}, {second} together"):
        save_lens(lens_of(first, second), tmp_path / "lens.zmx")
    assert not (tmp_path / "lens.zmx").exists()


def test_a_file_traces_by_the_glass_it_means(tmp_path):
    """A plano-convex lens of F2: 1/f = (n - 1)/R with Schott's nd, 1.62004."""
    text = singlet(
        "CURV 0.02", "DISZ 0", "DIAM 5", f"GLAS F2 {NOTHING}", head="GCAT SCHOTT\nFLOA\n"
    )
    path = tmp_path / "lens.zmx"
    path.write_text(text.replace("CURV -0.02", "CURV 0.0"))
    efl = load_lens(path, torch.float64).first_order(587.5618).efl.item()
    assert efl == pytest.approx(50.0 / 0.62004, rel=2e-5)
