"""Model configurations in the headers of saved files, including those that earlier versions wrote."""

from typing import Any

from ssplat_jax.config import StreamConfig


def config_from_header(fields: dict[str, Any]) -> StreamConfig:
    """Returns the configuration in a file's header; files from before there was a second network do not name theirs.

    Raises:
        InputError: a field is unknown or has a bad value.
    """
    return StreamConfig.from_dict({"network": "compact", **fields})
