"""A narrow model configuration that compiles quickly, and the comparison of pytrees."""

import jax
import numpy as np

from ssplat_jax.config import StreamConfig

NARROW = StreamConfig().replace(
    encoder_widths=(8, 16),
    encoder_blocks=1,
    attention_blocks=0,  # tests/model compiles attention
    fine_matching=False,
    match_width=8,
    num_depths=16,
    unet_width=16,
    token_width=16,
    hpda=True,
    cgfi=True,
    cgfi_width=16,
    mixer_blocks=1,
    mixer_proj=8,
    min_confidence=0.0,
    voxel_size=0.04,
    capacity=8192,  # a session starts with it too: one program for loop and session
)
"""A small model without a confidence threshold, which the flat distributions of untrained weights would not pass."""

FEW_GAUSSIANS = NARROW.replace(gaussians_per_token=4, mixer_blocks=0)
"""The narrow model with few Gaussians and no mixer, for tests around the stream, which render scenes many times."""


def leaves_with_names(tree):
    """Pairs (path, array) of all leaves."""
    return [(jax.tree_util.keystr(k), np.asarray(x)) for k, x in jax.tree_util.tree_flatten_with_path(tree)[0]]


def assert_same_bits(tree, expected, except_fields=()):
    """All leaves equal to the last bit, except the fields named."""
    for (name, x), (_, y) in zip(leaves_with_names(tree), leaves_with_names(expected), strict=True):
        if name.rpartition(".")[2] not in except_fields:
            np.testing.assert_array_equal(x, y, err_msg=name)
            assert np.asarray(x).tobytes() == np.asarray(y).tobytes(), name  # 0 and -0 differ
