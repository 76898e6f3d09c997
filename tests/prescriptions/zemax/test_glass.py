"""A `.zmx` file's glasses: the catalogue that it names, or a refusal, and never another maker's.

Indices are those that the makers print: Schott's F2 1.62004/36.37 and SF6 1.80518/25.43, Schott's
old F6 1.63636/35.34, CDGM's F6 1.62495/35.58 and F2 1.61293/36.99, Hikari's F2 1.62004/36.33.
"""

import pytest
import torch

from dolens import InputError, load_lens, save_lens
from dolens.optics.glass import Environment
from dolens.optics.glass_catalog import find_glass
from dolens.optics.materials import abbe_number, index_d, index_model, parse_material
from dolens.prescriptions import lens_from_prescription, prescription_of
from dolens.prescriptions.zemax.glass import read_glass
from dolens.prescriptions.zemax.reader import prescription_from_zemax, read_zemax
from dolens.prescriptions.zemax.writer import zemax_of
from tests.lenses import lens_of_rows
from tests.prescriptions.zemax.samples import singlet, surface

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


# Schott's old glasses as Robb and Mercado (1983) print them, and its current ones.
@pytest.mark.parametrize(
    ("name", "nd"),
    [("F6", 1.63636), ("BK7", 1.51680), ("SK16", 1.62041), ("F4", 1.61659), ("BAF4", 1.60562),
     ("N-BK7", 1.51680), ("K5", 1.52249), ("SSK4A", 1.61765)],
)  # fmt: skip
@pytest.mark.parametrize("catalogues", ["SCHOTT", "SCHOTT CDGM HIKARI", "INFRARED MISC SCHOTT"])
def test_glasses_that_schott_no_longer_makes(name, nd, catalogues):
    found = parse_material(material(f"{name} {NOTHING}", catalogues), index_model("dfc"))
    assert found.name == f"SCHOTT:{name}"
    assert index_d(found) == pytest.approx(nd, abs=1.2e-5)


@pytest.mark.parametrize(
    ("name", "catalogues", "found"),
    [("F_SILICA", "MISC", "MISC:F_SILICA"), ("WATER", "SCHOTT MISC", "MISC:WATER"),
     ("GERMANIUM", "SCHOTT INFRARED", "INFRARED:GERMANIUM"), ("LAF3", "MISC HOYA", "MISC:LAF3"),
     ("LAF3", "HOYA MISC", "HOYA:LAF3"), ("BAF2", "INFRARED CDGM", "INFRARED:BAF2"),
     ("PMMA", "MISC", "MISC:PMMA"), ("CORNEA", "SCHOTT EYE", "EYE:CORNEA"),
     ("LZ_K8", "SCHOTT LZOS", "LZOS:LZ_K8"), ("VACUUM", "SCHOTT MISC", "MISC:VACUUM"),
     ("J-KZFH9", "SCHOTT LACROIX HOYA NIKON", "HIKARI:J-KZFH9"),
     ("N-BK7", "SPECIAL SCHOTT", "SCHOTT:N-BK7"), ("N-BK7", "SPECIAL", "SCHOTT:N-BK7"),
     ("N-LAF2", "SCHOTT2016-T993 OHARA", "SCHOTT:N-LAF2"), ("IG2", "SCHOTT_IRG", "SCHOTT_IG:IG2"),
     ("C79-80", "SPECIAL", "CORNING:C79-80"), ("SSK4", "SCHOTT SUMITA", "SUMITA:SSK4"),
     ("SCHOTT-BK|N-BK7", "SCHOTT OHARA", "SCHOTT:N-BK7")],
)  # fmt: skip
def test_media_of_other_catalogues(name, catalogues, found):
    assert material(f"{name} {NOTHING}", catalogues) == found


def test_the_name_decides_and_the_log_says_where_its_numbers_differ(caplog):
    """Zemax leaves nd and Vd as they were when a glass is exchanged."""
    assert material("F6 0 0 1.63636 35.34", "CDGM") == "CDGM:F6"
    assert "GLAS F6: nd 1.63636 and Vd 35.34 of its line are not those of CDGM:F6" in caplog.text
    caplog.clear()
    assert material("F6 0 0 1.63636 35.34", "SCHOTT") == "SCHOTT:F6"
    assert not caplog.text


def test_fused_silica_by_another_name(caplog):
    assert material("FusedSilica 0 0 0 0 0", "SCHOTT CORNING") == "MISC:F_SILICA"
    assert "is read as MISC:F_SILICA" in caplog.text


MODELS = {
    "AIR": "air",
    "___BLANK 1 0 1.5168 64.17 0 0 0 0 0 0": "1.5168/64.17/0",
    "___BLANK 1 0 1.5168E+000 6.417E+1": "1.5168/64.17/0",
    "___BLANK 1 0 1.51680 64.170 0": "1.51680/64.170/0",
    # ΔPgF of the two terms of the index model.
    "___BLANK 1 0 1.51680 64.170 0.005098803673": "1.51680/64.170",
    "___BLANK 1 0 1.5 6.41673E+1 -9.E-4 0 0 0 0 0": "1.5/64.1673/-0.0009",
    "N-BK7 1 0 1.52 60 0": "1.52/60/0",
    "___BLANK 1 0 1.5 0 0": "1.5",
    "___BLANK 1 0 0.99971200000000005 0 0": "0.99971200000000005",
    "517642 0 0 1.517 64.2": "1.517/64.2/0",
    "648338 0 0 7734.33 17972.8": "1.648/33.8/0",
}


@pytest.mark.parametrize("glas", MODELS)
def test_models_and_codes(glas):
    assert material(glas, "SCHOTT") == MODELS[glas]


def test_a_model_glass_is_near_the_normal_line():
    """Schott's N-SF6 by nd and Vd: the two-term formula misses ng by 1.6e-3."""
    glass = parse_material("N-SF6", index_model("dfc"))
    nd, vd = index_d(glass), abbe_number(glass)
    found = parse_material(material(f"___BLANK 1 0 {nd} {vd} 0.0092"), index_model("dfc"))
    assert found.index(435.8343) == pytest.approx(glass.index(435.8343), abs=2e-4)
    two_terms = parse_material(f"{nd}/{vd}", index_model("dfc"))
    assert abs(two_terms.index(435.8343) - glass.index(435.8343)) > 1.5e-3


def pickup(*surfaces):
    words = [surface.split() for surface in surfaces]
    return read_glass(words[-1], ["SCHOTT"], "lens.zmx: surface 3", words)


@pytest.mark.parametrize(
    ("surfaces", "found"),
    [
        (["", "N-SK4 0 0 1.5 40", "", "N-SK4 2 1 1.5 40"], "SCHOTT:N-SK4"),
        (["", "___BLANK 1 0 1.489 57.4 0", "", "___BLANK 2 1 1.489 57.4 0"], "1.489/57.4/0"),
        (["", "", "", "___BLANK 2 2 1.5 40 0"], "air"),
        (["", "F2", "___BLANK 2 1", "___BLANK 2 2 1.5 40 0"], "SCHOTT:F2"),
    ],
)
def test_pick_ups(surfaces, found):
    assert pickup(*surfaces) == found


@pytest.mark.parametrize(
    "surfaces", [["___BLANK 2 9"], ["___BLANK 2 0"], ["", "F2 2 1 0 0"], ["___BLANK 2 -1"]]
)
def test_a_pick_up_from_nowhere(surfaces):
    with pytest.raises(InputError, match="GLAS picks up from surface"):
        pickup(*surfaces)


def test_a_refusal_says_what_could_be_written_instead():
    with pytest.raises(InputError) as error:
        material("ZK99 0 0 1.63636 35.34 0 0 0 0 0 0", "SCHOTT")
    instead = str(error.value).rpartition("write GLAS ")[2]
    assert material(instead, "SCHOTT") == "1.63636/35.34/0"


def test_a_file_s_temperature_and_its_pick_ups():
    """ENVD with 1 as third number: indices are those at 60 °C and 0.5 atm."""
    head = "GCAT SCHOTT\nFLOA\nENVD 60 0.5 1\n"
    text = singlet("CURV 0.02", "DIAM 5 1", "GLAS SF6", head=head, last="GLAS ___BLANK 2 1 1.5 40")
    found = prescription_from_zemax(text, "lens.zmx")
    assert (found["temperature"], found["pressure"]) == (60.0, 0.5)
    assert [row["material"] for row in found["surfaces"].values()] == ["SCHOTT:SF6"] * 2
    lens = lens_from_prescription(found)
    warm = find_glass("SCHOTT:SF6").at(Environment(60.0, 0.5))
    assert lens.materials[1] == warm
    assert abs(warm.index(550.0) - find_glass("SCHOTT:SF6").index(550.0)) > 1e-4
    written = prescription_from_zemax(zemax_of(prescription_of(lens)), "lens.zmx")
    assert lens_from_prescription(written).materials == lens.materials
    catalogue = prescription_from_zemax(text.replace("0.5 1", "0.5 0"), "lens.zmx")
    assert not {"temperature", "pressure"} & catalogue.keys()


REFUSED = {
    # Schott once had a BAF7, which its table lacks.
    "an old glass of Schott": (f"BAF7 {NOTHING}", "SCHOTT CDGM",
                               "SCHOTT, which GCAT names before CDGM, may have another"),
    "an old glass of Schott alone": (f"SK19 {NOTHING}", "SCHOTT", "is in none of the file's"),
    "what Schott has instead": (f"SSK4 {NOTHING}", "SCHOTT MISC", "SUMITA has another of that"),
    "an earlier unknown catalogue": (f"BAF2 {NOTHING}", "SPECIAL CDGM", "SPECIAL, which GCAT"),
    "no catalogue, several makers": (f"F2 {NOTHING}", None, "the file has no GCAT, and several"),
    "no catalogue, an old name": (f"F6 {NOTHING}", None, "the file has no GCAT, and several"),
    "no catalogue, numbers of nobody here": ("F6 0 0 1.73636 35.34", None, "has no GCAT"),
    "nobody's": (f"N-BK77 {NOTHING}", None, "did you mean 'N-BK7'"),
    "nobody's of the file's catalogues": (f"J-LAS015 {NOTHING}", "SCHOTT HIKARI", "J-LASF015"),
    "nobody's in that catalogue": (f"N-BK7 {NOTHING}", "OHARA", "SCHOTT has another"),
    "a plastic of an unknown maker": ("OKP4 0 0 1.607 27.6", "OSAKA", "in none of the file's"),
    "a deviation beyond all glass": ("___BLANK 1 0 2 3.0 4.0", "SCHOTT", None),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_read_as_meant(case):
    glas, catalogues, said = REFUSED[case]
    with pytest.raises(InputError) as error:
        parse_material(material(glas, catalogues), index_model("dfc"))
    message = str(error.value)
    assert "\n" not in message
    if said:
        assert message.startswith(f"lens.zmx: surface 1: GLAS {glas.split()[0]}")
        assert said in message


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
        (f"BK7 {NOTHING}", None, "BK7"),
        ("N-BK7", "MISC OHARA SCHOTT", "N-BK7"),
        ("F2 0 0 1.62004 36.37", "SPECIAL SCHOTT", "F2"),
    ],
)
def test_what_can_be(glas, catalogues, name):
    assert material(glas, catalogues) == f"SCHOTT:{name}"


def lens_of(first, second="air", **keys):
    rows = (50.0, 6.0, first), (-80.0, 2.0, second), (-90.0, 0.0, "air")
    return lens_of_rows(*rows, name="Doublet", **keys)


KINDS = ["air", "occluder", "1.5", "2", "0.9997", "1.51680/64.17", "1.51680/64.17/0",
         "1.7/30/-0.0101", "N-BK7", "SCHOTT:F2", "SCHOTT:F6", "CDGM:F6", "BK7", "HIKARI:SF6",
         "SCHOTT:SF6", "HIKARI:5165", "K-PG325(M)", "SCHOTT:IRG22", "PMMA", "MISC:PMMA",
         "ZEONEX-E48R", "POLYCARB", "F_SILICA", "INFRARED:GERMANIUM", "MISC:N15", "VACUUM",
         "CORNING:C79-80"]  # fmt: skip


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
        infrared = ("SCHOTT:IRG22", "INFRARED:GERMANIUM")
        wavelength = 5000.0 if before.name in infrared else 550.0
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
    # CDGM and Hikari have an F2 of their own, Schott an F6 and an SF6.
    [("CDGM:F6", "SCHOTT:F2"), ("HIKARI:SF6", "SCHOTT:F2"), ("CDGM:F2", "SCHOTT:F6")],
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


def air(*lines):
    return singlet(
        "CURV 0.02", "DISZ 4", "GLAS ___BLANK 1 0 1.5 0 0", head="ENPD 16\nWAVM 1 0.55 1\n"
    ) + "".join(f"{line}\n" for line in ("MNUM 2 1", *lines))


def test_a_gap_at_a_pressure_of_its_own_is_refused():
    own = ("PRES 0 1 0.0 0 0 0 1 1", 'GLSS 2 1 "" 0 0 0', "PRES 0 1 1.0 0 0 0", 'GLSS 1 1 ""')
    with pytest.raises(InputError, match="surface 2: a medium at a temp"):
        read_zemax(air(*own))


@pytest.mark.parametrize(
    "lines",
    [
        ("TEMP 0 1 20 0 0 0", "PRES 0 1 1 0 0 0", 'GLSS 1 1 "" 0 0'),
        ("PRES 0 2 0.5 0 0 0", 'GLSS 1 2 "" 0 0', 'GLSS 1 1 "" 0 0'),
        ("PRES 0 1 0.5 0 0 0", "THIC 1 1 4 0 0"),
        ("MNUM 2", "TEMP 0 1 50 0 0 0", "TEMP 0 2 20 0 0", 'GLSS 1 1 "A" 0 0', 'GLSS 1 2 "A" 0 0'),
    ],
    ids=["as the system", "of another configuration", "no glass behind it", "one as the system"],
)
def test_media_in_the_air_of_the_system_are_held(lines):
    assert len(read_zemax(air(*lines)).prescription["surfaces"]) == 2


def test_a_glass_that_schott_gave_up_stands_beside_schotts_own_both_ways():
    """Schott's SSK4 had the nd and Vd of Sumita's, which is read where GCAT names Schott first; and
    SK16 was made by both.
    """
    glasses = {1: "SSK4", 2: "SK16", 3: "F15", 4: "SK1"}
    head = "GCAT SCHOTT SUMITA\nENPD 4\n"
    rows = [surface(n, "DISZ 2", f"CURV 0.0{n}", f"GLAS {name}") for n, name in glasses.items()]
    rows[0] += "  STOP\n"
    text = head + surface(0, "DISZ INFINITY") + "".join(rows)
    text += surface(5, "CURV 0.01", "DISZ 9") + surface(6, "")
    found = prescription_from_zemax(text)
    named = [row["material"] for row in found["surfaces"].values()]
    assert named == ["SUMITA:SSK4", "SCHOTT:SK16", "SCHOTT:F15", "SCHOTT:SK1", "air"]
    assert prescription_from_zemax(zemax_of(found))["surfaces"] == found["surfaces"]
