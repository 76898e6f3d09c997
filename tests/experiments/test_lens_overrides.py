"""A lens changed on the command line, as Hydra hands it on."""

import math

import pytest

from dolens import InputError
from dolens.experiments.running.run_settings import RunSettings
from dolens.experiments.running.training import build_lens


@pytest.mark.parametrize(
    ("written", "name"),
    [
        ("N-BK7", "SCHOTT:N-BK7"),
        ("ohara:S-BSL7", "OHARA:S-BSL7"),
        ("1.5", "1.5"),
        ("PC", "PLASTIC:POLYCARBONATE"),
    ],
)
def test_a_material_on_the_command_line(composed, written, name):
    cfg = composed("experiment=wavefront_coding", f"lens.surfaces.1.material={written}")
    assert build_lens(RunSettings.of(cfg)).materials[1].name == name


def test_an_unknown_glass_on_the_command_line(composed):
    cfg = composed("experiment=wavefront_coding", "lens.surfaces.1.material=NBK7")
    with pytest.raises(InputError, match=r"surface 1: unknown material 'NBK7'; .*'N-BK7'"):
        build_lens(RunSettings.of(cfg))


def test_an_element_on_the_command_line(composed):
    """The README's own words."""
    cfg = composed(
        "experiment=wavefront_coding",
        "+lens.elements.front={surfaces: [1, 3], tilt_x: 0.1, decenter_y: 0.05}",
    )
    lens = build_lens(RunSettings.of(cfg))
    assert (lens.elements["front"].first, lens.elements["front"].last) == (1, 3)
    tilt = lens.variables(["elements.front.tilt_x"])["elements.front.tilt_x"]
    assert float(tilt.detach()) == pytest.approx(math.radians(0.1), rel=1e-6)


def test_a_misspelt_pose_on_the_command_line(composed):
    cfg = composed(
        "experiment=wavefront_coding", "+lens.elements.front={surfaces: [1, 3], tiltx: 0.1}"
    )
    with pytest.raises(InputError, match="element front: unknown key 'tiltx'; did you mean"):
        build_lens(RunSettings.of(cfg))
