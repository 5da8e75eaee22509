"""Programs here are few (`programs_shared`)."""

import pytest

from tests.commands.command_fixture import narrow_options


@pytest.fixture(autouse=True)
def _few_programs(programs_shared):
    pass


@pytest.fixture(scope="session")
def narrow(tmp_path_factory):
    """Options for a small model."""
    return narrow_options(tmp_path_factory.mktemp("narrow"))
