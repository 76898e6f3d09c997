import pytest


@pytest.fixture
def backend():
    """What a lens chooses by itself: `tests/optics` holds that the backends agree."""
    return "auto"
