"""Texts in the style of CODE V's files, which the tests of the format share."""

# The supplement's triplet, as CODE V writes.
TRIPLET = """RDM;LEN       "VERSION: 11.2   LENS VERSION: 84   Creation Date: 1-May-2019"
TITLE 'Cooke triplet'
EPD   10.2
DIM   M
WL    656.2725 587.5618 486.1327
REF   2
WTW   1 1 1
INI   'EO '
XAN   0.0 0.0 0.0
YAN   0.0 14.0 20.0
WTF   1.0 1.0 1.0
VUY   0.0 0.0 0.0
VLY   0.0 0.0 0.0
SO    0.0 0.1e14
S     22.014 3.259 620400.603100
  CCY 0; THC 0
  CIR 9.5
S     -435.76 6.008
  CIR 9.5
S     -22.213 1.0 620000.363700
  CIR 4.0
S     20.292 4.75
  STO
  CIR 3.86
S     79.684 2.952 620400.603100
  CIR 7.5
S     -18.395 42.208
  CIR 7.5
SI    0.0 0.0
  CIR 18.173
GO
"""


def system(*surfaces, head="RDM\nEPD 8\nWL 587.6\nYAN 0\n", target="SO 0 1e13", image="SI 0 0"):
    """A file with these surfaces, each a command of lines."""
    return "\n".join((head, target, *surfaces, image, "GO"))


SINGLET = ("S 50 4 NBK7_SCHOTT\n STO\n CIR 5", "S -50 40\n CIR 5")
