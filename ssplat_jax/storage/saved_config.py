"""Model configurations in the headers of saved files, including those that earlier versions wrote."""

from typing import Any

from ssplat_jax.config import StreamConfig

BEFORE_FIELDS = {"evidence": False}
"""Values that fields of `HeadConfig` had, in effect, before they were there."""


def config_from_header(fields: dict[str, Any]) -> StreamConfig:
    """Returns the configuration in a file's header; files from before there was a second network do not name theirs.

    Raises:
        InputError: a field is unknown or has a bad value.
    """
    if isinstance(head := fields.get("head"), dict):
        fields = {**fields, "head": {**BEFORE_FIELDS, **head}}
    config = StreamConfig.from_dict({"network": "compact", **fields})
    return config if isinstance(head, dict) else config.replace(**BEFORE_FIELDS)
