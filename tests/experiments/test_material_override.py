"""A material chosen on the command line, as Hydra hands it on."""

import pytest

from dolens import InputError
from experiments.training import build_lens


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
    assert build_lens(cfg).materials[1].name == name


def test_an_unknown_glass_on_the_command_line(composed):
    cfg = composed("experiment=wavefront_coding", "lens.surfaces.1.material=NBK7")
    with pytest.raises(InputError, match=r"surface 1: unknown material 'NBK7'; .*'N-BK7'"):
        build_lens(cfg)
