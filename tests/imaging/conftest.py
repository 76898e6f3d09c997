from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from dolens import Lens, load_lens


@pytest.fixture
def wavefront_coding(root: Path, backend: str) -> Callable[..., Lens]:
    """The wavefront-coding lens with a cubic plate of the given strength (mm⁻²)."""

    def build(plate: float = 0.0, dtype: torch.dtype = torch.float64) -> Lens:
        lens = load_lens(root / "conf/lens/wavefront_coding.yaml", dtype=dtype)
        lens.backend = backend
        with torch.no_grad():
            lens.surfaces["5"].x3.fill_(plate)
            lens.surfaces["5"].y3.fill_(plate)
        return lens.requires_grad_(False)

    return build


@pytest.fixture
def triplet(root: Path, backend: str) -> Lens:
    lens = load_lens(root / "conf/lens/cooke_triplet.yaml").requires_grad_(False)
    lens.backend = backend
    return lens
