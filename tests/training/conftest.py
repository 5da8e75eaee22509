"""Compiles the programs of these tests without LLVM's optimizations; see `compiled_plainly`."""

import pytest


@pytest.fixture(autouse=True)
def _compiled_plainly(compiled_plainly):
    pass
