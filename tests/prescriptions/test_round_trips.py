"""Every format gives back what it was given, to the last bit, or says what it cannot hold."""

import copy
import math
from pathlib import Path

import pytest
import torch
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dolens import InputError, load_lens, save_lens
from dolens.files import decode_text
from dolens.prescriptions import lens_from_prescription, prescription_of
from dolens.prescriptions.codev.reader import read_codev
from dolens.prescriptions.codev.writer import codev_of
from dolens.prescriptions.diffoptics_text import diffoptics_text_of, prescription_from_diffoptics
from dolens.prescriptions.lens_formats import read_json
from dolens.prescriptions.plain_values import json_of
from dolens.prescriptions.zemax.file import encode_zemax
from dolens.prescriptions.zemax.reader import prescription_from_zemax
from dolens.prescriptions.zemax.writer import zemax_of
from tests.prescriptions.samples import SINGLET, require_same_parameters, with_row
from tests.refused import refused

LENSES = sorted((Path(__file__).resolve().parents[2] / "conf" / "lens").glob("*.yaml"))
# What a format cannot hold, and which surface says so.
REFUSED = {
    ("freeform_corrector", ".zmx"): "surface 2: a .zmx file cannot hold type 'b_spline'",
    ("freeform_corrector", ".txt"): "surface 2: a .txt file cannot hold type 'b_spline'",
    ("freeform_corrector", ".seq"): "surface 2: a .seq file cannot hold type 'b_spline'",
    **{
        (name, suffix): f"surface {number}: a {suffix} file cannot hold '{what}'"
        for name, number in (("diffractive_doublet", 5), ("flat_lens", 2))
        for suffix, what in ((".zmx", "diffractive"), (".txt", "phase"), (".seq", "phase"))
    },
    ("hybrid_phone", ".zmx"): "surface 3: a .zmx file cannot hold 'diffractive'",
    ("spectral_plate", ".zmx"): "surface 3: a .zmx file cannot hold 'diffractive'",
    ("spectral_plate", ".txt"): "surface 1: a .txt file cannot hold type 'paraxial_lens'",
    ("spectral_plate", ".seq"): "surface 1: a .seq file cannot hold type 'paraxial_lens'",
    # Plastics are no glass of a maker that these formats know.
    **{
        (name, suffix): f"surface 2: a {suffix} file cannot hold material 'PLASTIC:ZEONEX-E48R'"
        for name in ("phone", "phone_four", "phone_insensitive", "hybrid_phone")
        for suffix in (".txt", ".seq")
    },
    **{
        (name, suffix): what
        for name in ("coated_window", "textbook_window")
        for suffix, what in {
            ".zmx": "surface 1: a .zmx file cannot hold 'coating'",
            ".txt": "surface 1: a .txt file cannot hold material 'SCHOTT:N-BK7'",
            ".seq": "surface 3: a .seq file cannot hold type 'paraxial_lens'",
        }.items()
    },
}
FORMATS = {
    ".txt": lambda data: prescription_from_diffoptics(diffoptics_text_of(data)),
    ".zmx": lambda data: prescription_from_zemax(decode_text(encode_zemax(zemax_of(data)), "lens")),
    ".seq": lambda data: read_codev(codev_of(data), "lens").prescription,
    ".json": lambda data: read_json(json_of(data, "lens").decode(), "lens").prescription,
    ".yaml": lambda data: yaml.safe_load(yaml.safe_dump(data)),
}


def indices(material):
    """Refractive indices at three lines, of models and of glasses of a catalogue."""
    return [float(material.index(wavelength)) for wavelength in (486.1327, 587.5618, 656.2725)]


def require_equal(found, wanted):
    require_same_parameters(wanted, found)
    for n, surface in wanted.surfaces.items():
        assert type(found.surfaces[n]) is type(surface)
        assert found.surfaces[n].semi_diameter == surface.semi_diameter
    assert [indices(m) for m in found.materials] == [indices(m) for m in wanted.materials]
    for key in ("name", "stop", "index_model", "sensor_diameter", "object_distance"):
        assert getattr(found, key) == getattr(wanted, key)
    for key in ("wavelengths", "reference_wavelength", "fields"):
        # Zemax cannot do without these: see test_zemax_always_has_a_field_and_a_wavelength.
        if getattr(wanted, key) is not None:
            assert getattr(found, key) == getattr(wanted, key)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["f64", "f32"])
@pytest.mark.parametrize("path", LENSES, ids=lambda p: p.stem)
def test_every_lens_through_every_format(path, dtype, suffix, tmp_path):
    lens = load_lens(path, dtype)
    generator = torch.Generator().manual_seed(2)
    for changed in (False, True):
        if changed:
            # Numbers without a short decimal form, as an optimizer leaves them.
            with torch.no_grad():
                for p in lens.parameters():
                    p *= 1.0 + 1e-3 * torch.rand((), generator=generator, dtype=dtype)
        if (path.stem, suffix) in REFUSED:
            with pytest.raises(InputError, match=REFUSED[path.stem, suffix]):
                save_lens(lens, tmp_path / f"lens{suffix}")
            assert not (tmp_path / f"lens{suffix}").exists()
            continue
        save_lens(lens, tmp_path / f"lens{suffix}")
        again = load_lens(tmp_path / f"lens{suffix}", dtype)
        require_equal(again, lens)
        assert again.materials == lens.materials or suffix != ".yaml"


@pytest.mark.parametrize("suffix", FORMATS)
def test_any_curvature_survives(suffix):
    """1/R in double precision skips some curvatures; files and prescriptions must not."""
    generator = torch.Generator().manual_seed(3)
    lens, skipped = lens_from_prescription(SINGLET | {"entrance_pupil_diameter": 1.0}), 0
    for value in (0.0, *(0.09 * torch.rand(100, generator=generator).double() - 0.045)):
        with torch.no_grad():
            lens.surfaces["2"].curvature.fill_(value)
        c = float(value)
        skipped += c != 0.0 and 1.0 / (1.0 / c) != c
        again = lens_from_prescription(FORMATS[suffix](prescription_of(lens)))
        assert float(again.surfaces["2"].curvature.detach()) == c
    assert skipped > 0


def test_the_tables_of_the_supplement_read_the_same_in_every_format(root):
    """Numbers come back as they are printed: 22.014 and not 22.014000000000003."""
    data = yaml.safe_load((root / "conf/lens/nikon.yaml").read_text())
    for suffix in (".txt", ".zmx", ".seq"):
        rows = FORMATS[suffix](data)["surfaces"]
        for n, row in data["surfaces"].items():
            for key in row.keys() - {"type", "material"}:
                assert rows[n][key] == row[key], (suffix, n, key)


finite = st.floats(-1e3, 1e3, allow_subnormal=False)
glass = st.builds("{:.6f}/{:.4f}".format, st.floats(1.3, 2.1), st.floats(15.0, 100.0))
medium = st.one_of(st.just("air"), glass)
coefficient = st.floats(-1e-4, 1e-4, allow_subnormal=False)


@st.composite
def surfaces(draw, kinds):
    kind = draw(st.sampled_from(kinds))
    semi_diameter = draw(st.floats(1e-3, 9.0))
    row = {"type": kind, "semi_diameter": semi_diameter, "material": draw(medium)}
    if kind in ("sphere", "conic", "even_asphere"):
        if draw(st.booleans()):
            row["radius"] = draw(st.sampled_from([12.5, -31.7, 1e5, math.inf]))
        else:
            row["curvature"] = draw(st.floats(-0.1, 0.1).filter(lambda c: abs(c) > 1e-290 or not c))
    if kind in ("conic", "even_asphere"):
        row["conic"] = draw(st.floats(-10.0, 0.0, allow_subnormal=False))
    if kind == "even_asphere":
        row |= draw(
            st.dictionaries(st.sampled_from(["a2", "a4", "a6", "a8", "a12", "a16"]), coefficient)
        )
    if kind == "xy_polynomial":
        names = ["x", "y", "x2", "xy", "y2", "x3", "x2y", "xy2", "y3", "b"]
        row |= draw(st.dictionaries(st.sampled_from(names), coefficient))
    return row


@st.composite
def prescriptions(draw, kinds, models):
    rows = draw(st.lists(surfaces(kinds), min_size=1, max_size=6))
    for row in rows[:-1]:
        row["thickness"] = draw(finite)
    stop = draw(st.integers(1, len(rows)))
    data = {
        "name": draw(st.text("Aa é–µ1.", min_size=1, max_size=12).map(str.strip).filter(bool)),
        "index_model": draw(st.sampled_from(models)),
        "stop": stop,
        "object_material": draw(medium),
        "surfaces": {str(n): row for n, row in enumerate(rows, 1)},
        "sensor": {"distance": draw(finite)},
    }
    if draw(st.booleans()):
        data["sensor"]["diameter"] = draw(st.floats(1e-3, 1e3))
    if draw(st.booleans()):
        data["object_distance"] = draw(st.floats(1e-3, 1e9))
        heights = st.tuples(finite, finite).map(list)
        data["fields"] = {"heights": draw(st.lists(heights, min_size=1, max_size=4))}
    if draw(st.booleans()):
        waves = draw(st.lists(st.floats(200.0, 2000.0), min_size=1, max_size=4))
        data |= {"wavelengths": waves, "reference_wavelength": draw(st.sampled_from(waves))}
    return data


ROTATIONAL = ["plane", "sphere", "conic", "even_asphere"]
relaxed = settings(
    deadline=None, max_examples=150, suppress_health_check=[HealthCheck.too_slow], derandomize=True
)


@relaxed
@given(prescriptions([*ROTATIONAL, "aperture", "xy_polynomial"], ["dfc", "do", "paper"]))
def test_any_lens_through_the_source_s_format(data):
    for row in data["surfaces"].values():
        row.pop("a2", None)  # which this format does not have
    require_equal(
        lens_from_prescription(FORMATS[".txt"](data)), lens_from_prescription(copy.deepcopy(data))
    )


@relaxed
@given(prescriptions(ROTATIONAL, ["dfc"]))
def test_any_lens_through_zemax(data):
    data = with_aperture(data, zemax_of, ".zmx")
    require_equal(lens_from_prescription(FORMATS[".zmx"](data)), lens_from_prescription(data))


@relaxed
@given(prescriptions(ROTATIONAL, ["dfc"]))
def test_any_lens_through_code_v(data):
    """CODE V's codes of glass end at nd 2 and Vd 100, and its aspheres begin at r⁴."""
    data["entrance_pupil_diameter"] = 1e-9
    for row in data["surfaces"].values():
        row.pop("a2", None)
    for holder, key in (
        (data, "object_material"),
        *((row, "material") for row in data["surfaces"].values()),
    ):
        nd, slash, vd = holder[key].partition("/")
        if slash and (float(nd) >= 2.0 or float(vd) >= 100.0):
            holder[key] = "1.62/36.37"
    data = with_aperture(data, codev_of, ".seq")
    del data["entrance_pupil_diameter"]
    found = FORMATS[".seq"](data | {"entrance_pupil_diameter": 1e9})
    del found["entrance_pupil_diameter"]
    require_equal(lens_from_prescription(found), lens_from_prescription(data))


def with_aperture(data, write, suffix):
    """A flat stop in one medium can be written in no other way than as an aperture."""
    media = [data["object_material"], *(row["material"] for row in data["surfaces"].values())]
    flat = [
        row["type"] == "plane"
        or (
            row["type"] == "sphere" and (row.get("radius") == math.inf or row.get("curvature") == 0)
        )
        for row in data["surfaces"].values()
    ]
    n = data["stop"] - 1
    if not flat[n] or media[n] != media[n + 1]:
        return data
    row = data["surfaces"][str(n + 1)]
    if suffix == ".zmx" or row["type"] == "plane":
        with pytest.raises(InputError, match=rf"surface {n + 1}: a {suffix} file cannot hold"):
            write(data)
    shape = {key: value for key, value in row.items() if key not in ("radius", "curvature")}
    data["surfaces"][str(n + 1)] = shape | {"type": "aperture"}
    return data


CANNOT = {
    "unknown type": ((".txt", ".zmx"), with_row(type="b_spline", coefficients=[1.0]),
                     "surface 1: a {} file cannot hold type 'b_spline' (allowed: "),
    "unknown surface key": ((".txt", ".zmx"), with_row(aperture={"rectangle": [1, 2]}),
                            "surface 1: a {} file cannot hold 'aperture'"),
    "elements": ((".txt", ".zmx"), {**SINGLET, "elements": {"1": {"tilt_x": 1.0}}},
                 "a {} file cannot hold 'elements'"),
    "sensor key": ((".txt", ".zmx"), {**SINGLET, "sensor": {"distance": 1, "tilt_x": 0.1}},
                   "sensor: a {} file cannot hold 'tilt_x' 0.1"),
    "title of two lines": ((".txt",), {**SINGLET, "name": "a\ntype"}, "lens: "),
    "name of two lines": ((".zmx",), {**SINGLET, "name": "a\nb"},
                          "a .zmx file cannot hold 'name' 'a\\nb' (it would come back as 'a')"),
    "remark": ((".txt",), with_row(note="front"), "surface 1: a .txt file cannot hold 'note'"),
    "catalogue glass": ((".txt",), with_row(material="N-BK7"),
                        "surface 1: a .txt file cannot hold material 'N-BK7'"),
    "unknown glass": ((".txt",), with_row(material="SCHOTT:X"),
                      "surface 1: a .txt file cannot hold material 'SCHOTT:X'"),
    "glass in two words": ((".zmx",), with_row(material="flint glass"),
                           "surface 1: a .zmx file cannot hold material 'flint glass'"),
    "index model": ((".zmx",), {**SINGLET, "index_model": "do"},
                    "a .zmx file cannot hold index_model 'do' (allowed: dfc"),
    "high power": ((".zmx",), with_row(a18=1e-20),
                   "surface 1: a .zmx file cannot hold 'a18' (allowed: a2 to a16)"),
    "high monomial": ((".txt",), with_row("2", type="xy_polynomial", radius=None, x4=1e-5),
                      "surface 2: a .txt file cannot hold 'x4' 1e-05"),
    "second aperture": ((".zmx",), with_row("2", type="aperture", radius=None),
                        "surface 2: a .zmx file cannot hold 'type' 'aperture'"),
}  # fmt: skip


@pytest.mark.parametrize("case", CANNOT)
def test_what_a_format_cannot_hold(case):
    suffixes, data, said = CANNOT[case]
    for suffix in suffixes:
        with refused(said.format(suffix), "lens: "):
            FORMATS[suffix](data)


def test_what_zemax_keeps_beside_the_surfaces():
    data = with_row(note="front", material="SCHOTT:N-BK7") | {
        "source": "US 1,234,567\nexample 2",
        "f_number": 2.8,
        "fields": {"angles": [[0.0, 0.0], [0.1, -3.3]]},
        "wavelengths": [486.1327, 587.5618],
        "reference_wavelength": 587.5618,
    }
    del data["surfaces"]["1"]["semi_diameter"]
    text = zemax_of(data)
    assert "\nGCAT SCHOTT\n" in text
    found = prescription_from_zemax(text)
    assert found["surfaces"]["1"] == data["surfaces"]["1"]
    for key in ("source", "f_number", "fields", "wavelengths", "reference_wavelength"):
        assert found[key] == data[key]


def test_zemax_always_has_a_field_and_a_wavelength():
    found = FORMATS[".zmx"](SINGLET)
    assert found["fields"] == {"angles": [[0.0, 0.0]]}
    assert found["wavelengths"] == [587.5618]


def test_text_beyond_ascii_is_written_as_utf_16():
    assert encode_zemax("NAME Gauss\n") == b"NAME Gauss\r\n"
    assert encode_zemax("NAME Gauß\n")[:4] == b"\xff\xfeN\0"


def test_an_unknown_suffix_is_refused(tmp_path):
    lens = lens_from_prescription(SINGLET)
    with pytest.raises(InputError, match=r"lens files are written as \.yaml, \.yml, \.zmx"):
        save_lens(lens, tmp_path / "lens.pdf")
    with pytest.raises(InputError, match="OSLO is read, not written"):
        save_lens(lens, tmp_path / "lens.len")
    assert prescription_of(lens)["name"] == "Singlet"
