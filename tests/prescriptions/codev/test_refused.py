"""CODE V's .seq format: what is refused, each in one line, and files that mean harm."""

import pytest

from dolens import load_lens
from tests.prescriptions.codev.samples import SINGLET, TRIPLET, system
from tests.prescriptions.samples import require_refused
from tests.refused import refused

LAST = "S -50 40\n CIR 5"
REFUSED = {
    "S 50 4 517.642\n STO\n SPS QCN": "a Forbes asphere (Q_con) is not held (SPS QCN)",
    "S 50 4 517.642\n STO\n SPS ODD 5.0": "an odd asphere with a radius of normalisation",
    "S 50 4 517.642\n STO\n SPS ODD; SCO C32 1e-9": "SCO C32 of SPS ODD is not held",
    "S 50 4 517.642\n STO\n XTO": "a toroid is not held",
    "S 50 4 517.642\n DIF HOE": "a diffractive surface of this kind is not held (DIF HOE R",
    "S 50 4 517.642\n SPS XYP; SCO C4 1": "a polynomial in x and y on a curved surface",
    "S 50 4 517.642\n GRT": "a diffraction grating is not held",
    "S 50 4 517.642\n ASP; CUF 0.1": "a Fresnel surface is not held (CUF)",
    "S 50 4 517.642\n FOO 1": "command FOO is not known, and may bend rays",
    "S 50 4 517.642\n ELX 4": "the aperture needs ELX and ELY",
    "S 50 4 517.642\n CIR 5; REX 4; REY 3": "an aperture of two outlines is not held (CIR and REX)",
    "S 50 4 517.642\n REX 5; REY 4; ARO 30": "a turned aperture is not held (ARO)",
    "S 50 4 517.642\n CIR 5; CIR L'B' 6": "a second aperture of one kind",
    "S 50 4 517.642\n GLB S1": "axes relative to another surface (GLB) is not held",
    "S 50 4 REFL\n BEN; ADE 5; BDE 5": "BEN about two axes at once is not held",
    "S 50 4 517.642\n ADE 5; YOD 3": "a tilt about a point of its own is not held (YOD)",
    "S 50 4 517.642 TIR": "TIR (allowed: REFL for a mirror, REFR)",
    "S 50 4 F2_HERAEUS": "catalogue HERAEUS is not known here",
    "S 50 4 F2": "may be",
    "S 50 4 NBK77_SCHOTT": "glass NBK77_SCHOTT is not known here of SCHOTT",
    "S 50 x": "surface S1: THI must be a number, not 'x'",
    "S 50 0\n THI HMY 0": "its gap is left to a solve (THI)",
}


@pytest.mark.parametrize("lines", REFUSED)
def test_what_is_not_held_is_refused_by_name(lines, tmp_path):
    require_refused(tmp_path / "lens.seq", system(lines, LAST), REFUSED[lines])


HEADS = {
    "RDM\nEPD 8\nFNO 5\n": "EPD and FNO both give the aperture",
    "RDM\nEPD 8\nYAN 0 5\nYOB 0 5\n": "YAN and YOB are two kinds of fields",
    "RDM\nEPD 8\nWL 587\nREF 2\n": "REF 2 is none of the wavelengths 1 to 1",
    "RDM\nEPD 8\nPUI 0.13\n": "apodization of the pupil is not held",
    "RDM\nDIM Q\nEPD 8\n": "DIM Q is unknown (allowed: M, C, I)",
    "EPD 8\n": "would be a curvature, as the file does not say RDM",
}


@pytest.mark.parametrize("head", HEADS)
def test_what_contradicts_itself_is_refused(head, tmp_path):
    require_refused(tmp_path / "lens.seq", system(*SINGLET, head=head), HEADS[head])


def test_a_private_glass_of_another_dispersion_is_refused(tmp_path):
    """The table's index at 486.1 nm is not the one that nd and Vd of its lines give at 550 nm."""
    head = (
        "RDM;EPD 8;WL 480 660\nPRV\n PWL 656.3 587.6 550 486.1\n"
        " 'ODD' 1.51432 1.5168 1.52100 1.52237\n 'FORM' LAU 2.3 0 0.01 0\nEND\n"
    )
    first = "S 50 4 'ODD'\n STO\n CIR 5"
    require_refused(tmp_path / "a.seq", system(first, LAST, head=head), "has another dispersion")
    first = "S 50 4 'FORM'\n STO\n CIR 5"
    require_refused(tmp_path / "b.seq", system(first, LAST, head=head), "by a formula (LAU)")


@pytest.mark.parametrize("line", ["num ^x(2)", "^x == 1", "FOR ^i 1 4"])
def test_a_macro_is_no_lens(line, tmp_path):
    text = f"{line}\nSO 0 1e13\nS 0 1\nSI 0 0\n"
    require_refused(tmp_path / "lens.seq", text, "is a macro of CODE V")


@pytest.mark.parametrize(
    ("zoom", "said"),
    [
        ("ZOO THI S2 41 50", "ZOO THI: position 1 has 41, and the lens 40"),
        ("ZOO WTW W1 0 1", "ZOO WTW: position 1 has 0, and the lens 1"),
        ("ZOO WTF F1 3 1", "ZOO WTF: position 1 has 3, and the lens 1"),
    ],
)
def test_the_first_zoom_position_must_be_the_lens(zoom, said, tmp_path):
    text = system(*SINGLET, "SI 0 0", f"ZOO 2\n{zoom}", image="")
    require_refused(tmp_path / "lens.seq", text, said)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("S     20.292", "S 1e999", "must be a finite number"),
        ("S     20.292", f"S {'9' * 5000}", "must be a number, not 5000 letters"),
        ("S     20.292", "S 2_0", "must be a finite number"),
        ("SI    0.0", f"! {'x' * 200_000}\nSI 0.0", "is longer than 100000 letters"),
        ("SI    0.0", "& \n" * 200_000 + "\nSI 0.0", "is longer than 100000 letters"),
        ("SI    0.0", "S 0 1\n" * 2100 + "SI 0.0", "more than 2000 surfaces"),
        ("SO    0.0 0.1e14", "", "expected SO or S0, not S"),
    ],
)  # fmt: skip
def test_hostile_text_ends_in_one_line(old, new, said, tmp_path):
    require_refused(tmp_path / "lens.seq", TRIPLET.replace(old, new), said)


def test_what_ends_within_its_words(tmp_path):
    for end in range(0, TRIPLET.index("\nSI "), 29):
        path = tmp_path / "lens.seq"
        path.write_text(TRIPLET[:end])
        with refused("", f"{path}: "):
            load_lens(path)
