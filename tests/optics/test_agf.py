"""Glass catalogues in Zemax's format: every formula, every line, and files that are wrong.

The printed indices are those of the makers' catalogues; the formulas are evaluated at 50 digits.
"""

import math
import re

import mpmath
import pytest
import torch

from dolens import InputError
from dolens.files import decode_text
from dolens.optics.agf import parse_agf, read_entry
from dolens.optics.glass_catalog import user_glass

# Name, formula, nd as printed, coefficients, range: one glass of each formula that catalogues use.
CATALOGUE = """CC a catalogue of many makers
NM B270 1 1 1.523080 58.571369 0 3 0
CD 2.286575 -8.7334582E-3 1.1742884E-2 2.9041756E-4 -1.2506695E-5 9.2646253E-7 0 0 0 0
LD 0.334 2.5
NM N-BK7 2 517642.251 1.5168 64.17 0 1 4
GC step 0.5 available
ED 7.1000000E+00 8.3000000E+00 2.51 -9.0E-04 0
CD 1.03961212 6.00069867E-3 2.31792344E-1 2.00179144E-2 1.01046945 1.03560653E+2 0 0 0 0
TD 1.86E-06 1.31E-08 -1.37E-11 4.34E-07 6.27E-10 1.7E-01 2.0E+01
OD - 1.0 0.0 1.0 2.3 2.3
LD 3.0E-01 2.5E+00
IT 3.00E-01 5.0E-02 2.5E+01
IT 4.00E-01 9.92E-01 2.5E+01
NM IRG15 3 0 1.534275 55.700357 0
CD 1.52229817 4.23702119E-3 -4.45081715E-5 -2.7249843E-3 2.80677977E-5 -2.99845263E-6
LD 3.65E-01 3.303
NM AQUEOUS 5 0 1.336981 52.658991 0
CD 1.321072780E+000 8.471137390E-003 2.318250630E-004
LD 3.8E-01 7.8E-01
NM CALCITE 6 0 1.658643 48.541403 0
CD 0.8559 3.45744E-3 0.8391 1.98810E-2 0.0009 3.8809E-2
0.6845 49.070025
LD 0.2 2.2
NM BBO 7 0 1.670737 52.593907 0
CD 2.7405 0.0184 0.0179 0.0155
LD 0.22 1.06
NM ZNO 8 0 2.003385 12.424016 0
CD 2.81418 0.87968 0.09253764 0.00711
LD 0.45 4.0
NM E-LAFH3 12 0 1.795041 28.688901 0
CD 3.10091582 -0.0131944552 0.0377063856 0.00215246343 -0.000117361655 1.96473108e-5 -2.24111072e-5
LD 0.4 0.7
NM J-KZFH9 13 0 1.738000 32.261112 0
CD 2.92190512 -0.0131913454 -7.94286252e-5 0.0327997049 0.000700950165 0.00012416909
-1.12359582e-5 9.11052912e-7
LD 0.365015 2.05809
NM ALN 9 0 2.154291 50.733102 0
CD 3.1399 1.3786 0.02941 3.861 225.9009
LD 0.22 5.0
"""
PRINTED = {"B270": 1.523080, "N-BK7": 1.51680, "AQUEOUS": 1.336981, "CALCITE": 1.658643,
           "BBO": 1.670737, "ALN": 2.154291, "IRG15": 1.534275, "ZNO": 2.003385,
           "E-LAFH3": 1.795041, "J-KZFH9": 1.738000}  # fmt: skip
COEFFICIENTS = ["2.21", "0.013", "0.0112", "0.0004", "-0.00002", "0.0000011", "0.00000013",
                "0.000000017", "0.0000000021", "0.00000000031"]  # fmt: skip


def catalogue(text=CATALOGUE):
    return parse_agf(text, "glasses.agf")


def exact(number, c, w):
    """Return the index by the formulas as Zemax's documentation prints them."""
    c = [mpmath.mpf(value) for value in c] + [mpmath.mpf(0)] * 10
    w2 = w**2
    if number == 3:
        pole = 1 / (w2 - mpmath.mpf("0.028"))
        return c[0] + c[1] * pole + c[2] * pole**2 + c[3] * w2 + c[4] * w2**2 + c[5] * w2**3
    if number == 5:
        return c[0] + c[1] / w + c[2] / w ** mpmath.mpf("3.5")
    if number in (2, 6, 11):
        count = {2: 3, 6: 4, 11: 5}[number]
        square = 1 + sum(c[2 * i] * w2 / (w2 - c[2 * i + 1]) for i in range(count))
    elif number == 4:
        square = 1 + c[0] + c[1] * w2 / (w2 - c[2] ** 2) + c[3] / (w2 - c[4] ** 2)
    elif number == 7:
        square = c[0] + c[1] / (w2 - c[2]) - c[3] * w2
    elif number == 8:
        square = c[0] + c[1] * w2 / (w2 - c[2]) - c[3] * w2
    elif number == 9:
        square = c[0] + c[1] * w2 / (w2 - c[2]) + c[3] * w2 / (w2 - c[4])
    else:
        powers = {
            1: (0, 2, -2, -4, -6, -8),
            10: (0, 2, -2, -4, -6, -8, -10, -12),
            12: (0, 2, -2, -4, -6, -8, 4, 6),
            13: (0, 2, 4, -2, -4, -6, -8, -10, -12),
        }[number]
        square = sum(a * w**e for a, e in zip(c, powers, strict=False))
    return mpmath.sqrt(square)


def resonances(number):
    """Return coefficients like those of a glass, for a formula with resonances."""
    strengths = ["1.03", "0.23", "1.01", "0.02", "0.31"]
    poles = ["0.006", "0.02", "103.5", "0.03", "0.011"]
    pairs = [value for pair in zip(strengths, poles, strict=True) for value in pair]
    return {4: ["0.6", "0.7", "0.1", "0.01", "0.15"], 9: ["2.2", "0.3", "0.02", "0.4", "210"],
            7: ["2.7", "0.018", "0.0179", "0.0155"], 8: ["1.9", "0.7", "0.0179", "0.0155"],
            3: ["1.5", "0.009", "-0.0001", "-0.003", "0.0002", "-0.00001"],
            5: COEFFICIENTS[:3]}.get(number, pairs)  # fmt: skip


@pytest.mark.parametrize("number", range(1, 14))
def test_every_formula_at_fifty_digits(number):
    words = COEFFICIENTS if number in (1, 10, 12, 13) else resonances(number)
    words = words[: {1: 6, 2: 6, 6: 8, 10: 8, 12: 8, 13: 9}.get(number)]
    text = f"NM G {number} 0 1.5 60\nCD {' '.join(words)}\nLD 0.3 2.5\n"
    formula, constant, terms = read_entry(catalogue(text)["G"]).dispersion
    with mpmath.workdps(50):
        for w in (0.3650146, 0.4358343, 0.5875618, 1.01398, 2.3):
            index = exact(number, words, mpmath.mpf(w))
            assert abs(formula(w, constant, terms) / index - 1) < 5e-15
            tensor = formula(torch.tensor(w, dtype=torch.float64), constant, terms)
            assert abs(float(tensor) / index - 1) < 5e-15


@pytest.mark.parametrize("name", PRINTED)
def test_printed_indices(name):
    glass = read_entry(catalogue()[name])
    formula, constant, terms = glass.dispersion
    assert abs(formula(0.5875618, constant, terms) - PRINTED[name]) < 1.1e-6
    assert glass.nd == PRINTED[name]


def test_the_other_lines():
    glass = read_entry(catalogue()["N-BK7"])
    assert glass.wavelengths == (0.3, 2.5)
    assert glass.expansion == pytest.approx(7.1e-6, rel=1e-15)
    assert glass.thermal == (1.86e-6, 1.31e-8, -1.37e-11, 4.34e-7, 6.27e-10, 0.17, 20.0)
    assert (glass.nd, glass.vd, glass.status) == (1.5168, 64.17, "preferred")
    assert glass.transmittance == ((0.3, 0.05, 25.0), (0.4, 0.992, 25.0))
    assert read_entry(catalogue()["BBO"]).thermal is None


@pytest.mark.parametrize(
    ("line", "price", "resistances"),
    [
        ("OD - 1.0 0.0 1.0 2.3 2.3", None, {"CR": 1.0, "FR": 0.0, "SR": 1.0, "AR": 2.3, "PR": 2.3}),
        ("OD 1.6 2.0 -1 -1 -1 -1", 1.6, {"CR": 2.0}),
        ("OD  2.0 0.0 1.0 2.3 2.3", None, {"CR": 2.0, "FR": 0.0, "SR": 1.0, "AR": 2.3, "PR": 2.3}),
        ("OD -1.0 -1.0 -1.0 -1.0 -1.0 -1.0", None, {}),
        ("OD", None, {}),
        ("GC nothing", None, {}),
    ],
)
def test_price_and_resistances(line, price, resistances):
    text = CATALOGUE.replace("OD - 1.0 0.0 1.0 2.3 2.3", line)
    glass = read_entry(catalogue(text)["N-BK7"])
    assert (glass.price, dict(glass.resistances)) == (price, resistances)


@pytest.mark.parametrize(("word", "density"), [("2.51", 2.51), ("0.0", None), ("-", None)])
def test_density(word, density):
    entry = catalogue(CATALOGUE.replace("+00 2.51 -9", f"+00 {word} -9"))["N-BK7"]
    assert read_entry(entry).density == density


def test_transmittance_by_beer_s_law():
    glass = user_glass("OWN", catalogue()["N-BK7"])
    passed = [math.exp(-d * glass.absorption(nm)) for nm, d in ((400.0, 50.0), (350.0, 10.0))]
    assert passed[0] == pytest.approx(0.992**2, rel=1e-14)
    middle = math.exp((math.log(0.05) + math.log(0.992)) / 2 / 25 * 10)
    assert passed[1] == pytest.approx(middle, rel=1e-14)
    several = torch.tensor([400.0, 350.0, 450.0], dtype=torch.float64)
    assert glass.absorption(several).tolist() == [glass.absorption(float(w)) for w in several]
    # The catalogue says nothing of 450 nm: the glass is clear there, and says so.
    assert glass.absorption(450.0) == 0.0
    assert [glass.knows_absorption(nm) for nm in (400.0, 450.0)] == [True, False]


@pytest.mark.parametrize(
    ("lines", "share"),
    [
        ("IT 0.4 0.9 10\nIT 0.4 0.8 25", 0.8 ** (10 / 25)),
        ("IT 0.4 0.0 10", 1e-4),
        ("IT 0.4 1.0 10", 1.0),
    ],
)
def test_the_thickest_sample_counts_and_zero_is_less_than_a_digit(lines, share):
    text = re.sub(r"(IT .*\n)+", lines + "\n", CATALOGUE)
    glass = user_glass("OWN", catalogue(text)["N-BK7"])
    assert math.exp(-10.0 * glass.absorption(400.0)) == pytest.approx(share, rel=1e-14)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "latin-1"])
def test_encodings(encoding):
    data = CATALOGUE.replace("\n", "\r\n").encode(encoding)
    assert catalogue(decode_text(data, "glasses.agf")).keys() == catalogue().keys()


NUMBERS = "CD 2.2 0 0 0 0 0\nLD 0.4 0.7\n"
WRONG = {
    "no number of a formula": (f"NM G x 0 1.5 60\n{NUMBERS}", "number of its dispersion formula"),
    "an unknown formula": (f"NM G 14 0 1.5 60\n{NUMBERS}", "formula 14 is unknown"),
    "no coefficients": ("NM G 1 0 1.5 60\nLD 0.4 0.7\n", "line CD with its coefficients is miss"),
    "words": ("NM G 1 0 1.5 60\nCD 2.2 os.system 0\nLD 0.4 0.7\n", "'os.system' must be a finite"),
    "infinite": ("NM G 1 0 1.5 60\nCD 1e999 0\nLD 0.4 0.7\n", "'1e999' must be a finite"),
    "not a number": ("NM G 1 0 1.5 60\nCD nan 0\nLD 0.4 0.7\n", "'nan' must be a finite number"),
    "no range": ("NM G 1 0 1.5 60\nCD 2.2 0\n", "line LD must give"),
    "a range backwards": ("NM G 1 0 1.5 60\nCD 2.2 0\nLD 0.7 0.4\n", "line LD must give"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_in_one_glass_refuses_that_glass(case):
    text, said = WRONG[case]
    entries = catalogue(f"{text}NM FINE 1 0 1.5 60\n{NUMBERS}")
    with pytest.raises(InputError) as error:
        read_entry(entries["G"])
    assert str(error.value).startswith("glasses.agf: line 1: glass 'G': ")
    assert said in str(error.value) and "\n" not in str(error.value)
    assert read_entry(entries["FINE"]).name == "FINE"


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "holds no glass"),
        (b"CC nothing but a comment", "holds no glass"),
        (b"NM\0" + bytes(range(256)), "no text"),
        (b"\xff\xfe\x00", "not valid UTF-16"),
        (b"PK\x03\x04" + bytes(64), "no text"),
    ],
)
def test_a_file_that_is_no_catalogue(data, said):
    with pytest.raises(InputError, match=said) as error:
        parse_agf(decode_text(data, "glasses.agf"), "glasses.agf")
    assert str(error.value).startswith("glasses.agf: ")
