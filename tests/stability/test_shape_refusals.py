"""Arrays of wrong shapes get one InputError that names them, as users get it: without the tests' own type checks."""

import jax
import jax.numpy as jnp
import pytest

from ssplat_jax.core.chunk import check_chunk
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.pytree import replace
from tests.model.small import MODEL, chunk


def wrong(tree, **leaves):
    """`tree` with other leaves, past the checks of a construction by hand."""
    paths, form = jax.tree_util.tree_flatten_with_path(tree)
    return jax.tree.unflatten(form, [leaves.get(path[-1].name, leaf) for path, leaf in paths])


def test_a_step_and_a_run_refuse_chunks_of_other_shapes():
    one = replace(chunk(), depths=jnp.zeros((3, *chunk().images.shape[1:3])))
    stacked = jax.tree.map(lambda x: jnp.stack([x, x]), one)
    check_chunk(stacked, 3, stacked=True)
    of_a_step = {"images": one.images[:2], "viewmats": one.viewmats[:, :3], "depths": jnp.zeros((3, 8, 8))}
    for name, leaf in (of_a_step | {"near": jnp.ones(3)}).items():
        for call in (MODEL.step, jax.jit(MODEL.step)):
            with pytest.raises(InputError, match=f"chunk: {name} must be"):
                call({}, MODEL.init_cache(), wrong(one, **{name: leaf}))
    with pytest.raises(InputError, match=r"chunk: valid must be \[t"):
        MODEL.run({}, MODEL.init_cache(), wrong(stacked, valid=stacked.valid[:1]))
    with pytest.raises(InputError, match=r"Chunks have 3 views \(`stream.chunk_size`\)"):
        check_chunk(chunk(views=2), 3)
    with pytest.raises(InputError, match=r"images must be \[t 3 h w 3\], got \[3, .*Stack chunks along a leading axis"):
        MODEL.run({}, MODEL.init_cache(), one)
