"""Fixtures of the tests of the documentation."""

from collections.abc import Iterator

import pytest

from ssplat_jax.model.network import NETWORKS
from ssplat_jax.network_configs import NETWORK_CONFIGS


@pytest.fixture
def registered_networks() -> Iterator[None]:
    """Forgets the networks that a test registers."""
    before = [(registry, dict(registry)) for registry in (NETWORK_CONFIGS, NETWORKS)]
    yield
    for registry, known in before:
        registry.clear()
        registry.update(known)
