"""Saved runs that may be continued."""

import copy

import pytest

from ssplat_jax.config import preset
from ssplat_jax.core.errors import InputError
from ssplat_jax.runs.resume import _check_identity
from ssplat_jax.storage.run_folder import RunFolder

FACTS = {"capture": "room", "size": [64, 48], "frames": [0, 1]}


def identity(**changes):
    return FACTS | {"config": preset("tiny").replace(**changes).to_dict()}


def test_a_run_with_equal_facts_may_be_continued(tmp_path):
    _check_identity(copy.deepcopy(identity()), identity(), RunFolder(tmp_path))


def test_capacity_matters_only_if_tokens_may_be_dropped(tmp_path):
    held = identity(overflow="grow", capacity=1024)
    _check_identity(held, identity(overflow="grow", capacity=4096), RunFolder(tmp_path))
    held = identity(overflow="drop_new", capacity=1024)
    with pytest.raises(InputError, match=r"config \(capacity: 1024 there, 4096 now\)"):
        _check_identity(held, identity(overflow="drop_new", capacity=4096), RunFolder(tmp_path))
