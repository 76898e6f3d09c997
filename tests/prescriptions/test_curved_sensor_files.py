"""A curved sensor in lens files, and in the lenses that other programs' files describe."""

import pytest

from dolens import InputError, load_lens
from dolens.analysis.spot_diagram import spot_diagram
from dolens.prescriptions.codev.reader import read_codev
from dolens.prescriptions.codev.writer import codev_of
from dolens.prescriptions.diffoptics_text import diffoptics_text_of
from dolens.prescriptions.other_programs import differences
from dolens.prescriptions.zemax.reader import prescription_from_zemax, read_zemax
from dolens.prescriptions.zemax.writer import zemax_of
from tests.prescriptions.samples import SINGLET

FILM = SINGLET | {"sensor": {"distance": 30.0, "diameter": 10.0, "radius": -27.3, "conic": -0.4}}


@pytest.mark.parametrize(
    "sensor",
    [
        {"distance": 30.0, "radius": -27.3, "conic": -0.4},
        {"distance": 30.0, "radius": 12.5, "diameter": 9.0},
        # No radius gives this curvature to the last bit.
        {"distance": 30.0, "curvature": -0.036630036630036634},
    ],
)
@pytest.mark.parametrize("program", ["zmx", "seq"])
def test_files_give_it_back(sensor, program):
    lens = SINGLET | {"sensor": sensor}
    if program == "zmx":
        found = prescription_from_zemax(zemax_of(lens))
    else:
        found = read_codev(codev_of(lens), "lens").prescription
    assert not [d for d in differences(lens, found) if d.place == ("sensor",)]
    curvature = found["sensor"].get("curvature") or 1.0 / found["sensor"]["radius"]
    assert curvature == sensor.get("curvature", 1.0 / sensor.get("radius", 1.0))


def test_a_format_without_it_says_so():
    """A text file of dO's has a plane for its sensor."""
    with pytest.raises(InputError, match=r"sensor: a \.txt file cannot hold"):
        diffoptics_text_of(FILM, "lens")


def test_a_radius_is_its_curvature_and_a_plane_is_a_plane():
    sensor = FILM["sensor"]
    flat = {"distance": 30.0, "diameter": 10.0}
    same = {key: value for key, value in sensor.items() if key != "radius"}
    assert not differences(FILM, FILM | {"sensor": same | {"curvature": 1.0 / -27.3}})
    assert not differences(
        FILM | {"sensor": flat}, FILM | {"sensor": flat | {"radius": float("inf"), "conic": 0.0}}
    )
    assert differences(FILM, FILM | {"sensor": flat})


@pytest.mark.parametrize("mode, listed", [(0, False), (1, True), (3, True)])
def test_the_opd_mode_of_a_paraxial_lens_is_listed(mode, listed):
    text = (
        "MODE SEQ\nENPD 4\nWAVM 1 0.55 1\nPWAV 1\nSURF 0\n  DISZ INFINITY\nSURF 1\n  STOP\n"
        f"  TYPE PARAXIAL\n  PARM 1 50\n  PARM 2 {mode}\n  DISZ 50\n  DIAM 2\nSURF 2\n  CURV 0\n"
    )
    found = read_zemax(text)
    assert any("OPD mode of a paraxial lens" in said for said in found.passed_over) == listed


def test_a_schmidt_camera_is_sharp_on_its_film(root):
    """All fields of a camera with its corrector at the mirror's centre see the same optics, but for
    how the corrector is foreshortened.
    """
    film = load_lens(root / "conf/lens/published/schmidt_camera_200_f24.yaml")
    fields = [(0.0, 0.0), (0.0, 1.26), (0.0, 1.8)]
    spots = 1e3 * spot_diagram(film, fields, film.wavelengths, 400).polychromatic_rms
    assert (spots / spots[0] - 1.0).abs().max() < 0.08
    assert spots[0] < 3.0
