"""Type promotion in these tests."""

import jax
import pytest


@pytest.fixture(scope="module", autouse=True)
def standard_promotion():
    """Allows type promotion: optax raises a float to an int32 power in Adam's bias correction."""
    with jax.numpy_dtype_promotion("standard"):
        yield
