import pytest

from dolens import load_lens


@pytest.fixture(scope="module")
def triplet():
    """A triplet of one line."""
    lens = load_lens("cooke_triplet").requires_grad_(False)
    lens.wavelengths = (587.5618,)
    return lens
