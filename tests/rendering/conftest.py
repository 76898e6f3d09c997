import pytest


@pytest.fixture
def backend():
    """The fused kernels: `test_fused_render` holds that they are the reference."""
    return "auto"
