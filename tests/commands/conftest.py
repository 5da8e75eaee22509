"""Programs here are compiled without LLVM's optimizations (`compiled_plainly`), and scenes decoded at their size."""

import pytest

from tests.commands.command_fixture import narrow_options


@pytest.fixture(autouse=True)
def _small(compiled_plainly, programs_shared, monkeypatch):
    monkeypatch.setattr("ssplat_jax.streaming.session.MIN_DECODED_PIVOTS", 1 << 11)


@pytest.fixture(scope="session")
def narrow(tmp_path_factory):
    """Options for a small model."""
    return narrow_options(tmp_path_factory.mktemp("narrow"))
