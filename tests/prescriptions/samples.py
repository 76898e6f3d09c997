"""A lens and a check that several tests of lens files share."""

import pytest

from dolens import InputError, load_lens

SINGLET = {
    "name": "Singlet",
    "index_model": "dfc",
    "stop": 1,
    "surfaces": {
        "1": {"type": "even_asphere", "radius": 20.0, "conic": -0.5, "a4": 1e-6,
              "semi_diameter": 10, "thickness": 5.0, "material": "1.5168/64.17"},
        "2": {"type": "sphere", "radius": -50.0, "semi_diameter": 10, "material": "air"},
    },
    "sensor": {"distance": 30.0, "diameter": 10.0},
}  # fmt: skip


def require_refused(path, content, said):
    """A file of this text, or of these bytes, is refused in one line that names it and says
    this.
    """
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError) as error:
        load_lens(path)
    message = str(error.value)
    assert message.startswith(f"{path}: ")
    assert said in message
    assert "\n" not in message
