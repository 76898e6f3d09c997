"""Lenses that figures are of."""

import pytest

from dolens import load_lens


@pytest.fixture(scope="session")
def triplet():
    return load_lens("cooke_triplet").requires_grad_(False)
