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


def configurations(size: int) -> str:
    count = max(2, size // 30)
    return (
        ZEMAX[: ZEMAX.index("MNUM")]
        + f"MNUM {count} 1\n"
        + "".join(f"THIC 2 {n} {6 + n % 5}.0 0 0\n" for n in range(1, count + 1))
    )


def json_of(content: dict, key: str, more: object) -> str:
    return json.dumps({**content, key: more})


def code_v(more: str) -> str:
    at = CODE_V.index("\nS ")
    return CODE_V[:at] + more + CODE_V[at:]


def oslo(more: str) -> str:
    return OSLO.replace("\nEND", f"\n{more}END")


# Kind → the file's suffix, and its text for a size.
LARGE: dict[str, tuple[str, Callable[[int], str]]] = {
    "Zemax: remarks": (".zmx", lambda n: before(ZEMAX, "UNIT", many("NOTE 0 word word word\n", n))),
    "Zemax: line ends": (".zmx", lambda n: before(ZEMAX, "UNIT", "\n" * n)),
    "Zemax: blanks": (".zmx", lambda n: before(ZEMAX, "UNIT", " " * n + "\n")),
    "Zemax: one line": (".zmx", lambda n: before(ZEMAX, "UNIT", "NAME " + "x" * n + "\n")),
    "Zemax: unknown operands": (".zmx", lambda n: before(ZEMAX, "UNIT", many("Q{n} 1\n", n))),
    "Zemax: unknown lines": (".zmx", lambda n: in_surface(many("  COAT x{n}\n", n))),
    "Zemax: a long number": (".zmx", lambda n: in_surface("  DISZ " + "9" * n + "\n")),
    "Zemax: fields": (".zmx", lambda n: before(ZEMAX, "UNIT", many("FEFD 0.0 1.{n} 1\n", n))),
    "Zemax: listed fields": (
        ".zmx",
        lambda n: ZEMAX.replace("FTYP 0 0 3 3", "FTYP 0 0 0 3").replace(
            "YFLN 0.0", "YFLN " + many("1.{n} ", n)
        ),
    ),
    "Zemax: wavelengths": (
        ".zmx",
        lambda n: ZEMAX.replace("FTYP 0 0 3 3", "FTYP 0 0 3 0").replace(
            "WAVM 4", many("WAVM {n} 0.55{n} 1\n", n) + "WAVM 4"
        ),
    ),
    "Zemax: surfaces": (".zmx", zemax_surfaces),
    "Zemax: coefficients": (".zmx", lambda n: in_surface(many("  PARM 2 1e-{n}\n", n), "EVENASPH")),
    "Zemax: extra data": (
        ".zmx",
        lambda n: in_surface(
            "  XDAT 1 230\n  XDAT 2 1\n" + many("  XDAT 5 1e-{n}\n", n), "XPOLYNOM"
        ),
    ),
    "Zemax: a grid": (".zmx", zemax_grid),
    "Zemax: an outline": (
        ".zmx",
        lambda n: in_surface(
            "  USAP 0 0\n" + many("  UDAD 1 1.{n} 2 0\n", n) + "  UDAD 2 -5 -5 0\n  UDAD 3 -5 1 0\n"
        ),
    ),
    "Zemax: outlines": (
        ".zmx",
        lambda n: in_surface(
            "  USAP 0 0\n"
            + many(
                "  UDAD 1 {n} 1 0\n  UDAD 1 {n}.1 1.1 0\n  UDAD 1 {n} 1.1 0\n  UDAD 2 0 0 0\n", n
            )
        ),
    ),
    "Zemax: configurations": (".zmx", configurations),
    "Zemax: settings": (
        ".zmx",
        lambda n: ZEMAX[: ZEMAX.index("MNUM")] + "MNUM 9 1\n" + many("THIC 2 3 1.{n}\n", n),
    ),
    "Zemax: merit function": (".zmx", lambda n: ZEMAX + many("EFFL 0 2 0 0 0 0 50 1 0 {n}\n", n)),
    "CODE V: remarks": (".seq", lambda n: CODE_V + many("! word word word\n", n)),
    "CODE V: first remarks": (".seq", lambda n: many("! word\n", n) + CODE_V),
    "CODE V: line ends": (".seq", lambda n: "\n" * n + CODE_V),
    "CODE V: one line": (".seq", lambda n: code_v("\nTIT '" + "x" * n)),
    "CODE V: semicolons": (".seq", lambda n: code_v("\n" + many("CCY 0;" * 1000 + "\n", n))),
    "CODE V: quotes": (
        ".seq",
        lambda n: code_v("\n" + many("TIT '\"'\"'x'" + "'\"" * 9000 + "\n", n)),
    ),
    "CODE V: continued lines": (
        ".seq",
        lambda n: code_v("\n" + many("TIT" + "&\n" * 40_000 + "x\n", n)),
    ),
    "CODE V: surfaces": (".seq", lambda n: code_v("\n" + many("S 50 1 NBK7_SCHOTT\n", n))),
    "CODE V: settings": (
        ".seq",
        lambda n: CODE_V.replace("\nGO", "\n" + many("CCY S3 0\nTHI S3 1.{n}\n", n) + "\nGO"),
    ),
    "CODE V: coefficients": (".seq", lambda n: code_v("\nSPS XYP\n" + many("SCO C4 1e-{n}\n", n))),
    "CODE V: glasses": (
        ".seq",
        lambda n: code_v("\nPRV\nPWL 588 656 486\n" + many("'G{n}' 1.5 1.51 1.52\n", n) + "END\n"),
    ),
    "CODE V: fields": (".seq", lambda n: code_v("\n" + many("YAN " + "1.5 " * 20_000 + "\n", n))),
    "OSLO: remarks": (
        ".len",
        lambda n: oslo(many("// word word\n", n)),
    ),
    "OSLO: notes": (
        ".len",
        lambda n: oslo(many('SNO{n} "x"\n', n)),
    ),
    "OSLO: line ends": (".len", lambda n: "\n" * n + OSLO),
    "OSLO: one line": (".len", lambda n: OSLO.replace("\nEND", '\nLBL "' + "x" * n + "\nEND")),
    "OSLO: surfaces": (
        ".len",
        lambda n: oslo(many("NXT\nRD 50\nTH 1\n", n)),
    ),
    "OSLO: wavelengths": (
        ".len",
        lambda n: oslo(many("WV " + "0.55 " * 3000 + "\n", n)),
    ),
    "YAML: remarks": (".yaml", lambda n: many("# word word word\n", n) + YAML),
    "YAML: line ends": (".yaml", lambda n: "\n" * n + YAML),
    "YAML: one text": (".yaml", lambda n: f"{YAML}name: '{'x' * n}'\n"),
    "YAML: a plain text": (".yaml", lambda n: f"{YAML}name: {'x ' * (n // 2)}\n"),
    "YAML: a folded text": (".yaml", lambda n: f"{YAML}name: >\n" + many("  word\n", n)),
    "YAML: escapes": (".yaml", lambda n: f'{YAML}name: "{many(chr(92) + "x41", n)}"\n'),
    "YAML: keys": (".yaml", lambda n: YAML + many("k{n}: 1\n", n)),
    "YAML: surfaces": (".yaml", lambda n: "surfaces:\n" + many(f"  9{{n}}: {ROW}\n", n) + TAIL),
    "YAML: states": (
        ".yaml",
        lambda n: f"{YAML}states:\n" + many("  s{n}: {surfaces: {1: {thickness: 2}}}\n", n),
    ),
    "YAML: elements": (
        ".yaml",
        lambda n: f"{YAML}elements:\n" + many("  e{n}: {surfaces: [1, 2], tilt_x: 1}\n", n),
    ),
    "YAML: fields": (
        ".yaml",
        lambda n: f"{YAML}fields:\n  angles:\n" + many("  - [0, 1.{n}]\n", n),
    ),
    "YAML: wavelengths": (".yaml", lambda n: f"{YAML}wavelengths:\n" + many("  - 550.{n}\n", n)),
    "YAML: a grid": (
        ".yaml",
        lambda n: yaml_row(f"spacing_x: 0.1, spacing_y: 0.1, sag: {grid(n)}", "grid_sag"),
    ),
    "YAML: a spline": (
        ".yaml",
        lambda n: yaml_row(
            f"coefficients: {grid(n)}, knots_x: {grid(n)}, knots_y: [1]", "b_spline"
        ),
    ),
    "YAML: a polygon": (
        ".yaml",
        lambda n: yaml_row(
            "aperture: {polygons: [[" + many("[1.{n}, 2], ", n) + "[-4, -3], [-4, 5]]]}"
        ),
    ),
    "YAML: polygons": (
        ".yaml",
        lambda n: yaml_row(
            "aperture: {polygons: [" + many("[[{n}, 1], [{n}.1, 1], [{n}, 1.1]], ", n) + "]}"
        ),
    ),
    "YAML: obscurations": (
        ".yaml",
        lambda n: yaml_row(
            "obscuration: [" + many("{semi_diameter: 0.1, decenter_x: 1.{n}}, ", n) + "]"
        ),
    ),
    "YAML: anchors": (".yaml", lambda n: f"{YAML}name:\n" + many("  - &a{n} x\n", n)),
    "YAML: aliases": (".yaml", lambda n: f"{YAML}name:\n  - &a x\n" + many("  - *a\n", n)),
    "YAML: indents": (
        ".yaml",
        lambda n: (
            YAML + "name:\n" + "".join(" " * d + "- \n" for d in range(1, int((2 * n) ** 0.5)))
        ),
    ),
    "YAML: brackets": (".yaml", lambda n: f"{YAML}name: {'[' * n}"),
    "YAML: braces": (".yaml", lambda n: f"{YAML}name: {'{a: ' * (n // 4)}"),
    "YAML: question marks": (".yaml", lambda n: f"{YAML}name:\n  {'? ' * (n // 2)}"),
    "YAML: hyphens": (".yaml", lambda n: f"{YAML}name:\n  {'- ' * (n // 2)}"),
    "YAML: tags": (".yaml", lambda n: f"{YAML}name: !{'x' * n} y\n"),
    "YAML: keys that collide": (
        ".yaml",
        lambda n: YAML + "".join(f"{(2**61 - 1) * k}: 1\n" for k in range(1, max(2, n // 26))),
    ),
    "YAML: keys given twice": (".yaml", lambda n: YAML + many("k{n}: 1\n", n) + "k0: 1\n"),
    "JSON: keys": (
        ".json",
        lambda n: json.dumps({"surfaces": {}, **{f"k{k}": 1 for k in range(n // 12)}}),
    ),
    "JSON: keys given twice": (
        ".json",
        lambda n: '{"surfaces": {}, ' + many('"k{n}": 1, ', n) + '"k0": 2}',
    ),
    "JSON: brackets": (".json", lambda n: '{"surfaces": {}, "name": ' + "[" * n),
    "JSON: a list in lists": (
        ".json",
        lambda n: json.dumps({"surfaces": {"1": 0}}).replace(
            "0", "[" * min(n, 900) + "]" * min(n, 900)
        ),
    ),
    "JSON: a long number": (".json", lambda n: '{"surfaces": ' + "9" * n + "}"),
    "JSON: a long text": (".json", lambda n: json.dumps({"surfaces": {}, "x" * n: 1})),
    "DeepLens: surfaces": (
        ".json",
        lambda n: json_of(DEEPLENS, "surfaces", DEEPLENS["surfaces"] * max(1, n // 600)),
    ),
    "dO: rows": (".txt", lambda n: DO + many("S 1 50 10 AIR\n", n) + "I 95 0 5 AIR\n"),
    "dO: columns": (".txt", lambda n: f"{DO}S 1 50 10 AIR {'0.0 ' * (n // 4)}\nI 95 0 5 AIR\n"),
    "dO: a header": (
        ".txt",
        lambda n: (
            DO.replace(
                "material\n",
                'material # {"fields": {"angles": [' + many("[0, 1], ", n) + "[0, 0]]}}\n",
            )
            + "I 95 0 5 AIR\n"
        ),
    ),
    "text: line ends": (".txt", lambda n: "\n" * n + "x"),
    "text: SO": (".txt", lambda n: many("SO 1\n", n)),
    "catalogue: glasses": (".agf", lambda n: many(AGF.replace("OWN", "G{n}"), n)),
    "catalogue: remarks": (".agf", lambda n: AGF + many("GC word word\n", n)),
    "catalogue: coefficients": (
        ".agf",
        lambda n: AGF.replace("LD", many("1.0 2.0 3.0\n", n) + "LD"),
    ),
    "catalogue: transmittances": (".agf", lambda n: AGF + many("IT 0.5 0.9 10.{n}\n", n)),
    "catalogue: one line": (".agf", lambda n: f"NM {'x' * n} 2 0 1.5 60\n" + AGF),
}
_SPACING = "  GDAT {} 0.1 0.1 0 0\n  GARR 0 0 0 0 0 0\n"
GREEDY: dict[str, tuple[str, str]] = {}
for _count in ("1000000000", "1e300", "9" * 300):
    GREEDY |= {
        f"Zemax: {_count[:12]} configurations": (
            ".zmx",
            ZEMAX.replace("MNUM 1 1", f"MNUM {_count} 1\nTHIC 2 1 6\nTHIC 2 2 7"),
        ),
        f"Zemax: configuration {_count[:12]}": (
            ".zmx",
            ZEMAX.replace("MNUM 1 1", f"MNUM {_count} {_count}\nTHIC 2 1 6\nTHIC 2 {_count} 7"),
        ),
        f"Zemax: setting of surface {_count[:12]}": (
            ".zmx",
            ZEMAX.replace(
                "MNUM 1 1",
                f"MNUM 2 1\nTHIC {_count} 1 6\nTHIC {_count} 2 7\n"
                f"YFIE {_count} 1 6\nYFIE {_count} 2 7\nWAVE {_count} 1 6\nWAVE {_count} 2 7",
            ),
        ),
        f"Zemax: {_count[:12]} fields": (
            ".zmx",
            ZEMAX.replace("FTYP 0 0 3 3", f"FTYP 0 0 {_count} 3"),
        ),
        f"Zemax: {_count[:12]} wavelengths": (
            ".zmx",
            ZEMAX.replace("FTYP 0 0 3 3", f"FTYP 0 0 3 {_count}"),
        ),
        f"Zemax: wavelength {_count[:12]}": (".zmx", ZEMAX.replace("WAVM 4", f"WAVM {_count}")),
        f"Zemax: primary wavelength {_count[:12]}": (
            ".zmx",
            ZEMAX.replace("PWAV 2", f"PWAV {_count}"),
        ),
        f"Zemax: a grid of {_count[:12]} columns": (
            ".zmx",
            in_surface(_SPACING.format(f"{_count} {_count}"), "GRID_SAG"),
        ),
        f"Zemax: parameter {_count[:12]}": (".zmx", in_surface(f"  PARM {_count} 1\n", "EVENASPH")),
        f"Zemax: surface {_count[:12]}": (".zmx", ZEMAX.replace("SURF 2", f"SURF {_count}")),
        **{
            f"Zemax: {kind} of {_count[:12]} terms": (
                ".zmx",
                in_surface(f"  XDAT 1 {_count}\n  XDAT 2 {_count}\n  XDAT 3 {_count}\n", kind),
            )
            for kind in (
                "XASPHERE",
                "XOSPHERE",
                "QED_TYPE",
                "XPOLYNOM",
                "SZERNSAG",
                "FZERNSAG",
                "BINARY_2",
                "BINARY_1",
                "SZERNPHA",
                "FZERNPHA",
                "XDGRATIN",
                "CUBICSPL",
            )
        },
        f"CODE V: reference {_count[:12]}": (".seq", code_v(f"\nREF {_count}\n")),
        f"CODE V: positions {_count[:12]}": (".seq", code_v(f"\nZOO {_count}\n")),
        f"CODE V: surfaces to {_count[:12]}": (".seq", code_v(f"\nCIR S1..{_count} 5\n")),
        f"CODE V: surface {_count[:12]}": (".seq", code_v(f"\nCIR S{_count} 5\n")),
        f"CODE V: coefficient {_count[:12]}": (".seq", code_v(f"\nSPS XYP\nSCO C{_count} 5\n")),
        f"CODE V: order {_count[:12]}": (
            ".seq",
            CODE_V.replace("\nSI", f"\nDIF DOE; HOR {_count}; HWL 550; HCO C1 1\nSI"),
        ),
        f"YAML: stop {_count[:12]}": (".yaml", f"{YAML}stop: {_count}\n"),
        f"YAML: surface {_count[:12]}": (".yaml", YAML.replace("  2:", f"  {_count}:")),
        f"YAML: element of surface {_count[:12]}": (
            ".yaml",
            f"{YAML}elements: {{e: {{surfaces: [1, {_count}]}}}}\n",
        ),
        f"YAML: arms {_count[:12]}": (
            ".yaml",
            yaml_row(f"obscuration: {{width: 1, arms: {_count}}}"),
        ),
        f"YAML: order {_count[:12]}": (
            ".yaml",
            yaml_row(f"phase: {{type: radial, order: {_count}, p2: 1}}"),
        ),
        f"YAML: grating order {_count[:12]}": (
            ".yaml",
            yaml_row(f"phase: {{type: grating, order: {_count}, lines_per_mm: {_count}}}"),
        ),
        f"YAML: coefficient {_count[:12]}": (".yaml", yaml_row(f"a{_count}: 1")),
        f"YAML: reference {_count[:12]}": (".yaml", f"{YAML}reference_wavelength: {_count}\n"),
        f"YAML: weight {_count[:12]}": (
            ".yaml",
            f"{YAML}wavelengths: [500, 600]\nwavelength_weights: [{_count}, 1]\n",
        ),
        f"YAML: field {_count[:12]}": (
            ".yaml",
            f"{YAML}fields: {{heights: [[0, {_count}]]}}\nobject_distance: 100\n",
        ),
        f"ray-optics: stop {_count[:12]}": (
            ".roa",
            json.dumps(RAY_OPTICS).replace('"stop_surface": ', f'"stop_surface": {_count}, "x": '),
        ),
        f"catalogue: formula {_count[:12]}": (".agf", AGF.replace("OWN 2", f"OWN {_count}")),
        f"OSLO: {_count[:12]} in a unit": (".len", OSLO.replace("\nEND", f"\nUNI {_count}\nEND")),
    }
GREEDY |= {
    "YAML: all powers of x and y": (
        ".yaml",
        yaml_row(
            ", ".join(f"x{i}y{j}: 0" for i in range(2, 120) for j in range(2, 120)), "xy_polynomial"
        ),
    ),
    "YAML: all Zernike polynomials": (
        ".yaml",
        yaml_row(
            "normalization_radius: 5, " + ", ".join(f"z{i}: 0" for i in range(1, 400)),
            "zernike_standard",
        ),
    ),
}
