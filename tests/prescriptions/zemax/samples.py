"""Texts in the style of Zemax's files, which the tests of the format share."""

from dolens import load_lens

# The supplement's triplet, written as Zemax writes.
HEAD = """VERS 140124 258 36214
MODE SEQ
NAME Cooke triplet for 35 µm
NOTE 0 Supplement, Section III C
PFIL 0 0 0
LANG 0
UNIT MM X W X CM MR CPMM
FLOA
ENVD 2.0E+1 1 0
GFAC 0 0
GCAT SCHOTT MISC
RAIM 0.0 0 1 1 0 0 0 0 0
FTYP 0 0 3 3 0 0 0
ROPD 2
XFLN 0.0 0.0 0.0 0.0 0.0 0.0
YFLN 0.0 1.4E+1 2.0E+1 0.0 0.0 0.0
FWGN 1.0 1.0 1.0 1.0 1.0 1.0
VCXN 0.0 0.0 0.0 0.0 0.0 0.0
WAVM 1 4.861327E-1 1
WAVM 2 5.875618E-1 1
WAVM 3 6.562725E-1 1
WAVM 4 5.5E-1 1
PWAV 2
GLRS 1 0
"""
# ΔPgF is that of the lens's two-term formula, A + B/λ².
TRIPLET = [
    ("22.014", "3.259", "GLAS ___BLANK 1 0 1.6204 6.031E+1 -1.393716327E-3 0 0 0 0 0", "9.5"),
    ("-435.76", "6.008", "", "9.5"),
    ("-22.213", "1", "GLAS ___BLANK 1 0 1.62 3.637E+1 -4.1660796327E-2 0 0 0 0 0", "4"),
    ("20.292", "4.75", "", "3.86"),
    ("79.684", "2.952", "GLAS ___BLANK 1 0 1.6204 6.031E+1 -1.393716327E-3 0 0 0 0 0", "7.5"),
    ("-18.395", "42.208", "", "7.5"),
]
TAIL = """BLNK
TOL TOFF   0   0 0.0000000000000000E+00 0.0000000000000000E+00   0 0 0 0 0
EFFL 0 2 0 0 0 0 50 1 0 0
MNUM 1 1
MOFF   0   1 "" 0 0 0 1 1 0 0.0 ""
"""


def surface(n, *lines):
    common = ("FIMP ", "", "HIDE 0 0 0 0 0 0 0 0 0 0", "MIRR 2 0.0", "SLAB 3")
    return "".join([f"SURF {n}\n", *(f"  {line}\n" for line in (*common, *lines) if line)])


def standard(n, radius, thickness, glass="", semi_diameter="5", *more):
    return surface(
        n,
        *more,
        "TYPE STANDARD",
        f'CURV {1.0 / float(radius)!r} 0 0.0 0.0 0 ""',
        f"DISZ {thickness}",
        glass,
        f'DIAM {semi_diameter} 1 0 0 1 ""',
        f"FLAP 0 {semi_diameter} 0",
    )


def triplet():
    rows = [standard(n, *row, *(["STOP"] if n == 4 else [])) for n, row in enumerate(TRIPLET, 1)]
    target = surface(0, "TYPE STANDARD", "CURV 0.0", "DISZ INFINITY")
    image = surface(7, "TYPE STANDARD", "CURV 0.0", "DISZ 0", 'DIAM 18.173 1 0 0 1 ""')
    return "".join([HEAD, target, *rows, image, TAIL])


def singlet(*first, head="FLOA\n", last="DIAM 5", object_distance="INFINITY", image=""):
    """A file whose surface 1, the stop, has these lines."""
    return "".join(
        (
            head,
            surface(0, f"DISZ {object_distance}"),
            surface(1, "STOP", *first),
            surface(2, "CURV -0.02", "DISZ 40", last),
            surface(3, image),
        )
    )


def lens_of(text, tmp_path):
    path = tmp_path / "lens.zmx"
    path.write_text(text)
    return load_lens(path).requires_grad_(False)


GLASS = "GLAS ___BLANK 1 0 1.5168 64.17"
