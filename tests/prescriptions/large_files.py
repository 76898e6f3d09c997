"""Lens files that are large, or small and ask for much: each kind as a function of its size.

Every entry of `LARGE` has about as many bytes as it is asked for; those of `GREEDY` are small and
name a number of which a reader must not make as many things.
"""

import json
from collections.abc import Callable

from tests.prescriptions.codev.samples import TRIPLET as CODE_V
from tests.prescriptions.test_json_lenses import DEEPLENS, RAY_OPTICS
from tests.prescriptions.test_oslo import TRIPLET as OSLO
from tests.prescriptions.zemax import samples as zemax_samples

ZEMAX = zemax_samples.triplet()
ROW = "{type: sphere, radius: 50, semi_diameter: 5, thickness: 1, material: 1.5168/64.17}"
LAST = "{type: sphere, radius: -50, semi_diameter: 5, material: air}"
TAIL = "sensor: {distance: 95}\n"
YAML = f"surfaces:\n  1: {ROW}\n  2: {LAST}\n{TAIL}"
AGF = "NM OWN 2 0 1.5 60\nCD 1.0 0.01 0.2 0.02 1.0 100.0\nLD 0.3 2.0\n"
DO = """lens
type distance roc diameter material
O 0 0 0 AIR
S 0 50 10 1.5168/64.17
S 3 -50 10 AIR
"""
SUFFIXES = {"Zemax": ".zmx", "CODE V": ".seq", "OSLO": ".len", "YAML": ".yaml", "JSON": ".json",
            "DeepLens": ".json", "dO": ".txt", "text": ".txt", "ray-optics": ".roa",
            "catalogue": ".agf"}  # fmt: skip


def with_suffixes(kinds):
    """Return each kind with the suffix of its program."""
    return {kind: (SUFFIXES[kind.partition(":")[0]], made) for kind, made in kinds.items()}


def many(text: str, size: int) -> str:
    """Return a text with `{n}` as often as makes the size, n counting from 0."""
    count = max(1, size // len(text))
    return (
        "".join(text.replace("{n}", str(n)) for n in range(count))
        if "{n}" in text
        else (text * count)
    )


def before(sample: str, place: str, more: str) -> str:
    at = sample.index(place)
    return sample[:at] + more + sample[at:]


def at(sample: str, place: str, text: str) -> Callable[[int], str]:
    """Return a sample with a text many times in front of a place, or behind all of it."""
    return lambda n: before(sample + "\0", place or "\0", many(text, n))[:-1]


def in_surface(more: str, kind: str = "") -> str:
    """Return a Zemax lens whose surface 1 has more lines, and another type."""
    text = before(ZEMAX, "SURF 2\n", more)
    return (
        text.replace("TYPE STANDARD", f"TYPE {kind}", 2).replace(f"TYPE {kind}", "TYPE STANDARD", 1)
        if kind
        else text
    )


def yaml_row(more: str, kind: str = "even_asphere") -> str:
    return YAML.replace("type: sphere", f"type: {kind}", 1).replace("}", f", {more}}}", 1)


def grid(size: int, number: str = "0.001234567") -> str:
    side = max(4, int((size / (len(number) + 2)) ** 0.5))
    row = "[" + ", ".join([number] * side) + "]"
    return "[" + ", ".join([row] * side) + "]"


def zemax_grid(size: int) -> str:
    side = max(2, int((size / 38) ** 0.5))
    nodes = "".join(f"  GARR {n} 0.001234567 0.0 0.0 0.0 0\n" for n in range(side * side))
    return in_surface(f"  GDAT {side} {side} 0.01 0.01 0 0\n{nodes}", "GRID_SAG")


def zemax_surfaces(size: int) -> str:
    count = max(3, size // 130)
    blocks = "".join(
        f"SURF {n}\n  TYPE STANDARD\n  CURV 0.0{n % 7 + 1} 0 0 0 0\n  DISZ 1\n  CLAP 0 5 0\n"
        + "  STOP\n" * (n == 1)
        for n in range(1, count)
    )
    return (
        f"{zemax_samples.HEAD}SURF 0\n  TYPE STANDARD\n  DISZ INFINITY\n{blocks}SURF {count}\n"
        "  TYPE STANDARD\n"
    )


def outline(corners: str, last: str = "") -> Callable[[int], str]:
    """Return a Zemax aperture drawn by hand, with these corners many times."""
    return lambda n: in_surface("  USAP 0 0\n" + many(corners, n) + last)


def configurations(size: int) -> str:
    count = max(2, size // 30)
    return (
        ZEMAX[: ZEMAX.index("MNUM")]
        + f"MNUM {count} 1\n"
        + "".join(f"THIC 2 {n} {6 + n % 5}.0 0 0\n" for n in range(1, count + 1))
    )


def json_of(content: dict, key: str, more: object) -> str:
    return json.dumps({**content, key: more})


def in_yaml(line: str) -> Callable[[int], str]:
    """Return a YAML lens with another key, whose value is long: `…` stands for text many times."""
    begin, text, end = line.split("…")
    return lambda n: f"{YAML}{begin}{many(text, n)}{end}"


# Kind → the file's suffix, and its text for a size.
LARGE: dict[str, tuple[str, Callable[[int], str]]] = with_suffixes({
    "Zemax: remarks": at(ZEMAX, "UNIT", "NOTE 0 word word word\n"),
    "Zemax: line ends": at(ZEMAX, "UNIT", "\n"),
    "Zemax: blanks": lambda n: before(ZEMAX, "UNIT", " " * n + "\n"),
    "Zemax: one line": lambda n: before(ZEMAX, "UNIT", "NAME " + "x" * n + "\n"),
    "Zemax: unknown operands": at(ZEMAX, "UNIT", "Q{n} 1\n"),
    "Zemax: unknown lines": lambda n: in_surface(many("  COAT x{n}\n", n)),
    "Zemax: a long number": lambda n: in_surface("  DISZ " + "9" * n + "\n"),
    "Zemax: fields": at(ZEMAX, "UNIT", "FEFD 0.0 1.{n} 1\n"),
    "Zemax: listed fields": lambda n: ZEMAX.replace("FTYP 0 0 3 3", "FTYP 0 0 0 3").replace(
        "YFLN 0.0", "YFLN " + many("1.{n} ", n)
    ),
    "Zemax: wavelengths": lambda n: ZEMAX.replace("FTYP 0 0 3 3", "FTYP 0 0 3 0").replace(
        "WAVM 4", many("WAVM {n} 0.55{n} 1\n", n) + "WAVM 4"
    ),
    "Zemax: surfaces": zemax_surfaces,
    "Zemax: coefficients": lambda n: in_surface(many("  PARM 2 1e-{n}\n", n), "EVENASPH"),
    "Zemax: extra data": lambda n: in_surface(
        "  XDAT 1 230\n  XDAT 2 1\n" + many("  XDAT 5 1e-{n}\n", n), "XPOLYNOM"
    ),
    "Zemax: a grid": zemax_grid,
    "Zemax: an outline": outline(
        "  UDAD 1 1.{n} 2 0\n", "  UDAD 2 -5 -5 0\n  UDAD 3 -5 1 0\n"
    ),
    "Zemax: outlines": outline(
        "  UDAD 1 {n} 1 0\n  UDAD 1 {n}.1 1.1 0\n  UDAD 1 {n} 1.1 0\n  UDAD 2 0 0 0\n"
    ),
    "Zemax: configurations": configurations,
    "Zemax: settings": lambda n: (
        ZEMAX[: ZEMAX.index("MNUM")] + "MNUM 9 1\n" + many("THIC 2 3 1.{n}\n", n)
    ),
    "Zemax: merit function": at(ZEMAX, "", "EFFL 0 2 0 0 0 0 50 1 0 {n}\n"),
    "CODE V: remarks": at(CODE_V, "", "! word word word\n"),
    "CODE V: first remarks": at(CODE_V, CODE_V[:9], "! word\n"),
    "CODE V: line ends": at(CODE_V, CODE_V[:9], "\n"),
    "CODE V: one line": lambda n: before(CODE_V, "\nS ", "\nTIT '" + "x" * n),
    "CODE V: semicolons": at(CODE_V, "S     22", "CCY 0;" * 1000 + "\n"),
    "CODE V: quotes": at(CODE_V, "S     22", "TIT '\"'\"'x'" + "'\"" * 9000 + "\n"),
    "CODE V: continued lines": at(CODE_V, "S     22", "TIT" + "&\n" * 40_000 + "x\n"),
    "CODE V: surfaces": at(CODE_V, "S     22", "S 50 1 NBK7_SCHOTT\n"),
    "CODE V: settings": at(CODE_V, "GO", "CCY S3 0\nTHI S3 1.{n}\n"),
    "CODE V: coefficients": lambda n: before(
        CODE_V, "\nS ", "\nSPS XYP\n" + many("SCO C4 1e-{n}\n", n)
    ),
    "CODE V: glasses": lambda n: before(
        CODE_V, "\nS ", "\nPRV\nPWL 588 656 486\n" + many("'G{n}' 1.5 1.51 1.52\n", n) + "END\n"
    ),
    "CODE V: fields": at(CODE_V, "S     22", "YAN " + "1.5 " * 20_000 + "\n"),
    "OSLO: remarks": at(OSLO, "END", "// word word\n"),
    "OSLO: notes": at(OSLO, "END", 'SNO{n} "x"\n'),
    "OSLO: line ends": at(OSLO, OSLO[:9], "\n"),
    "OSLO: one line": lambda n: before(OSLO, "END", 'LBL "' + "x" * n + "\n"),
    "OSLO: surfaces": at(OSLO, "END", "NXT\nRD 50\nTH 1\n"),
    "OSLO: wavelengths": at(OSLO, "END", "WV " + "0.55 " * 3000 + "\n"),
    "YAML: remarks": at(YAML, YAML[:9], "# word word word\n"),
    "YAML: line ends": at(YAML, YAML[:9], "\n"),
    "YAML: one text": in_yaml("name: '…x…'\n"),
    "YAML: a plain text": in_yaml("name: …x …\n"),
    "YAML: a folded text": in_yaml("name: >\n…  word\n…"),
    "YAML: escapes": in_yaml('name: "…\\x41…"\n'),
    "YAML: keys": in_yaml("…k{n}: 1\n…"),
    "YAML: surfaces": lambda n: "surfaces:\n" + many(f"  9{{n}}: {ROW}\n", n) + TAIL,
    "YAML: states": in_yaml("states:\n…  s{n}: {surfaces: {1: {thickness: 2}}}\n…"),
    "YAML: elements": in_yaml("elements:\n…  e{n}: {surfaces: [1, 2], tilt_x: 1}\n…"),
    "YAML: fields": in_yaml("fields:\n  angles:\n…  - [0, 1.{n}]\n…"),
    "YAML: wavelengths": in_yaml("wavelengths:\n…  - 550.{n}\n…"),
    "YAML: a grid": lambda n: yaml_row(
        f"spacing_x: 0.1, spacing_y: 0.1, sag: {grid(n)}", "grid_sag"
    ),
    "YAML: a spline": lambda n: yaml_row(
        f"coefficients: {grid(n)}, knots_x: {grid(n)}, knots_y: [1]", "b_spline"
    ),
    "YAML: a polygon": lambda n: yaml_row(
        "aperture: {polygons: [[" + many("[1.{n}, 2], ", n) + "[-4, -3], [-4, 5]]]}"
    ),
    "YAML: polygons": lambda n: yaml_row(
        "aperture: {polygons: [" + many("[[{n}, 1], [{n}.1, 1], [{n}, 1.1]], ", n) + "]}"
    ),
    "YAML: obscurations": lambda n: yaml_row(
        "obscuration: [" + many("{semi_diameter: 0.1, decenter_x: 1.{n}}, ", n) + "]"
    ),
    "YAML: anchors": in_yaml("name:\n…  - &a{n} x\n…"),
    "YAML: aliases": in_yaml("name:\n  - &a x\n…  - *a\n…"),
    "YAML: indents": lambda n: (
        YAML + "name:\n" + "".join(" " * d + "- \n" for d in range(1, int((2 * n) ** 0.5)))
    ),
    "YAML: brackets": in_yaml("name: …[…"),
    "YAML: braces": in_yaml("name: …{a: …"),
    "YAML: question marks": in_yaml("name:\n  …? …\n"),
    "YAML: hyphens": in_yaml("name:\n  …- …\n"),
    "YAML: tags": in_yaml("name: !…x… y\n"),
    "YAML: keys that collide": lambda n: (
        YAML + "".join(f"{(2**61 - 1) * k}: 1\n" for k in range(1, max(2, n // 26)))
    ),
    "YAML: keys given twice": in_yaml("…k{n}: 1\n…k0: 1\n"),
    "JSON: keys": lambda n: json.dumps({"surfaces": {}, **{f"k{k}": 1 for k in range(n // 12)}}),
    "JSON: keys given twice": lambda n: '{"surfaces": {}, ' + many('"k{n}": 1, ', n) + '"k0": 2}',
    "JSON: brackets": lambda n: '{"surfaces": {}, "name": ' + "[" * n,
    "JSON: a list in lists": lambda n: (
        '{"surfaces": {"1": ' + "[" * min(n, 900) + "]" * min(n, 900) + "}}"
    ),
    "JSON: a long number": lambda n: '{"surfaces": ' + "9" * n + "}",
    "JSON: a long text": lambda n: json.dumps({"surfaces": {}, "x" * n: 1}),
    "DeepLens: surfaces": lambda n: json_of(
        DEEPLENS, "surfaces", DEEPLENS["surfaces"] * max(1, n // 600)
    ),
    "dO: rows": lambda n: DO + many("S 1 50 10 AIR\n", n) + "I 95 0 5 AIR\n",
    "dO: columns": lambda n: f"{DO}S 1 50 10 AIR {'0.0 ' * (n // 4)}\nI 95 0 5 AIR\n",
    "dO: a header": lambda n: DO.replace(
        "material\n", 'material # {"fields": {"angles": [' + many("[0, 1], ", n) + "[0, 0]]}}\n"
    ) + "I 95 0 5 AIR\n",
    "text: line ends": lambda n: "\n" * n + "x",
    "text: SO": lambda n: many("SO 1\n", n),
    "catalogue: glasses": lambda n: many(AGF.replace("OWN", "G{n}"), n),
    "catalogue: remarks": at(AGF, "", "GC word word\n"),
    "catalogue: coefficients": at(AGF, "LD", "1.0 2.0 3.0\n"),
    "catalogue: transmittances": at(AGF, "", "IT 0.5 0.9 10.{n}\n"),
    "catalogue: one line": lambda n: f"NM {'x' * n} 2 0 1.5 60\n" + AGF,
})  # fmt: skip
EXTRA = ("XASPHERE", "XOSPHERE", "QED_TYPE", "XPOLYNOM", "SZERNSAG", "FZERNSAG", "BINARY_2",
         "BINARY_1", "SZERNPHA", "FZERNPHA", "XDGRATIN", "CUBICSPL")  # fmt: skip


def greedy(count: str) -> dict[str, str]:
    """Return files that name a number, here `count`, of things."""
    zoom = f"MNUM {count} 1\nTHIC 2 1 6\nTHIC 2 2 7"
    far = f"MNUM {count} {count}\nTHIC 2 1 6\nTHIC 2 {count} 7"
    settings = "".join(f"{word} {count} {n} {5 + n}\n" for word in ("THIC", "YFIE", "WAVE")
                       for n in (1, 2))  # fmt: skip
    terms = "".join(f"  XDAT {n} {count}\n" for n in (1, 2, 3))
    return {
        "Zemax: configurations": ZEMAX.replace("MNUM 1 1", zoom),
        "Zemax: configuration": ZEMAX.replace("MNUM 1 1", far),
        "Zemax: setting of surface": ZEMAX.replace("MNUM 1 1", "MNUM 2 1\n" + settings),
        "Zemax: fields": ZEMAX.replace("FTYP 0 0 3 3", f"FTYP 0 0 {count} 3"),
        "Zemax: wavelengths": ZEMAX.replace("FTYP 0 0 3 3", f"FTYP 0 0 3 {count}"),
        "Zemax: wavelength": ZEMAX.replace("WAVM 4", f"WAVM {count}"),
        "Zemax: primary wavelength": ZEMAX.replace("PWAV 2", f"PWAV {count}"),
        "Zemax: columns of a grid": in_surface(
            f"  GDAT {count} {count} 0.1 0.1 0 0\n  GARR 0 0 0 0 0 0\n", "GRID_SAG"
        ),
        "Zemax: parameter": in_surface(f"  PARM {count} 1\n", "EVENASPH"),
        "Zemax: surface": ZEMAX.replace("SURF 2", f"SURF {count}"),
        **{f"Zemax: terms of {kind}": in_surface(terms, kind) for kind in EXTRA},
        "CODE V: reference": before(CODE_V, "\nS ", f"\nREF {count}\n"),
        "CODE V: positions": before(CODE_V, "\nS ", f"\nZOO {count}\n"),
        "CODE V: surfaces to": before(CODE_V, "\nS ", f"\nCIR S1..{count} 5\n"),
        "CODE V: surface": before(CODE_V, "\nS ", f"\nCIR S{count} 5\n"),
        "CODE V: coefficient": before(CODE_V, "\nS ", f"\nSPS XYP\nSCO C{count} 5\n"),
        "CODE V: order": before(CODE_V, "\nSI", f"\nDIF DOE; HOR {count}; HWL 550; HCO C1 1"),
        "YAML: stop": f"{YAML}stop: {count}\n",
        "YAML: surface": YAML.replace("  2:", f"  {count}:"),
        "YAML: element of surface": f"{YAML}elements: {{e: {{surfaces: [1, {count}]}}}}\n",
        "YAML: arms": yaml_row(f"obscuration: {{width: 1, arms: {count}}}"),
        "YAML: order": yaml_row(f"phase: {{type: radial, order: {count}, p2: 1}}"),
        "YAML: grating order": yaml_row(
            f"phase: {{type: grating, order: {count}, lines_per_mm: {count}}}"
        ),
        "YAML: coefficient": yaml_row(f"a{count}: 1"),
        "YAML: reference": f"{YAML}reference_wavelength: {count}\n",
        "YAML: weight": (
            f"{YAML}wavelengths: [500, 600]\nwavelength_weights: [{count}, 1]\n"
        ),
        "YAML: field": (
            f"{YAML}fields: {{heights: [[0, {count}]]}}\nobject_distance: 100\n"
        ),
        "ray-optics: stop": json.dumps(RAY_OPTICS).replace(
            '"stop_surface": ', f'"stop_surface": {count}, "x": '
        ),
        "catalogue: formula": AGF.replace("OWN 2", f"OWN {count}"),
        "OSLO: a unit": OSLO.replace("\nEND", f"\nUNI {count}\nEND"),
    }  # fmt: skip


GREEDY = with_suffixes({
    f"{kind} {count[:12]}": text
    for count in ("1000000000", "1e300", "9" * 300)
    for kind, text in greedy(count).items()
} | {
    "YAML: all powers of x and y": yaml_row(
        ", ".join(f"x{i}y{j}: 0" for i in range(2, 120) for j in range(2, 120)), "xy_polynomial"
    ),
    "YAML: all Zernike polynomials": yaml_row(
        "normalization_radius: 5, " + ", ".join(f"z{i}: 0" for i in range(1, 400)),
        "zernike_standard",
    ),
})  # fmt: skip
