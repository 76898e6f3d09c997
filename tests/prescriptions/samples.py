"""A lens and a check that several tests of lens files share."""

import copy

import torch

from dolens import load_lens
from tests.refused import refused

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


def with_row(n="1", **keys):
    """The singlet with other keys in a surface's row; a key that is None is left out."""
    data = copy.deepcopy(SINGLET)
    row = data["surfaces"][n] | keys
    data["surfaces"][n] = {key: value for key, value in row.items() if value is not None}
    return data


def require_refused(path, content, said):
    """A file of this text, or of these bytes, is refused in one line that names it and says
    this.
    """
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with refused(said, f"{path}: "):
        load_lens(path)


def require_same_parameters(one, other):
    """Two lenses have parameters of one name and value, to the last bit."""
    before, after = dict(one.named_parameters()), dict(other.named_parameters())
    assert before.keys() == after.keys()
    for name, value in before.items():
        assert torch.equal(value, after[name]), name
