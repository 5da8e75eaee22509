"""Arrays of wrong shapes get one InputError that names them, as users get it: without the tests' own type checks."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

from ssplat_jax.core.chunk import check_chunk
from ssplat_jax.core.errors import InputError
from tests.model.small import MODEL, chunk

NAMED = {
    "means=jnp.zeros((9, 2))": "means of the Gaussians must be [9 3], got [9, 2]",
    "opacities=jnp.zeros(8)": "opacities of the Gaussians must be [9], got [8]",
    "sh=jnp.zeros((9, 3))": "sh of the Gaussians must be [9 k 3], got [9, 3]",
    "width=80.5": "the image of the camera must have whole numbers of pixels, at least 1x1, got 80.5x64",
    "Ks=jnp.eye(4)": "the camera must have viewmats [*b 4 4] and Ks [*b 3 3], got [4, 4] and [4, 4]",
    "captured=ss.Camera(jnp.eye(4), jnp.eye(4), 80, 64)": "the captured camera must have viewmats [*b 4 4] and Ks",
    "features=jnp.zeros((8, 2))": "features must be [9 c], got [8, 2]",
    "tile=7": "tile must be 8 or 16 pixels, got 7",
    "max_pairs=1.5": "max_pairs must be a whole number of at least 1, got 1.5",
    "max_pairs=0": "max_pairs must be a whole number of at least 1, got 0",
    "width=0": "the image of the camera must have whole numbers of pixels, at least 1x1, got 0x64",
    "sh=jnp.zeros((9, 5, 3))": "sh must hold 1, 4, 9 or 16 terms a Gaussian, got 5",
    "viewmats=jnp.zeros((0, 4, 4)), Ks=jnp.zeros((0, 3, 3))": "wanted at least one camera",
    "distortion=jnp.zeros((2, 5))": "distortion must be",
}
"""The message of `render` for each wrong argument."""

TAKEN = ("width=np.int64(80)", "tile=np.int32(8)", "max_pairs=np.uint32(64)")
"""Arguments that are right: whole numbers of NumPy are whole numbers."""

SCRIPT = """
import dataclasses, sys
import jax, jax.numpy as jnp, numpy as np
import ssplat_jax as ss

def draw(jit, **wrong):
    scene = dict(means=jnp.zeros((9, 3)), quats=jnp.ones((9, 4)), scales=jnp.ones((9, 3)), opacities=jnp.ones(9),
                 sh=jnp.zeros((9, 1, 3)))
    camera = dict(viewmats=jnp.eye(4), Ks=jnp.eye(3), width=80, height=64)
    options = {name: value for name, value in wrong.items() if name not in scene and name not in camera}
    scene, camera = ({**part, **{n: v for n, v in wrong.items() if n in part}} for part in (scene, camera))
    def inner(scene):
        return ss.render(ss.Gaussians(**scene), ss.Camera(**camera), **options)
    (jax.jit(inner) if jit else inner)(scene)

for jit in (False, True):
    for case in sys.argv[1:]:
        try:
            eval(f"draw({jit}, {case})")
        except ss.InputError as error:
            print(error)
        else:
            print("drawn")
"""


def test_render_names_each_wrong_argument_inside_and_outside_jit():
    quiet = {**os.environ, "TF_CPP_MIN_LOG_LEVEL": "3"}
    done = subprocess.run([sys.executable, "-c", SCRIPT, *NAMED, *TAKEN], capture_output=True, text=True, env=quiet)
    assert done.returncode == 0, done.stderr
    cases = [*((case, f"render: {words}") for case, words in NAMED.items()), *((case, "drawn") for case in TAKEN)]
    for (case, wanted), line in zip(cases * 2, done.stdout.splitlines(), strict=True):
        assert line.startswith(wanted), (case, line)


def wrong(tree, **leaves):
    """`tree` with other leaves, past the checks of a construction by hand."""
    paths, form = jax.tree_util.tree_flatten_with_path(tree)
    return jax.tree.unflatten(form, [leaves.get(path[-1].name, leaf) for path, leaf in paths])


def test_a_step_and_a_run_refuse_chunks_of_other_shapes():
    one = chunk()
    stacked = jax.tree.map(lambda x: jnp.stack([x, x]), one)
    check_chunk(stacked, 3, stacked=True)
    of_a_step = {"images": one.images[:2], "valid": jnp.ones(2, bool), "viewmats": one.viewmats[:, :3]}
    for name, leaf in (of_a_step | {"near": jnp.ones(3)}).items():
        for call in (MODEL.step, jax.jit(MODEL.step)):
            with pytest.raises(InputError, match=f"chunk: {name} must be"):
                call({}, MODEL.init_cache(), wrong(one, **{name: leaf}))
    for name, leaf in {"near": stacked.near[0], "valid": stacked.valid[:1], "Ks": stacked.Ks[:, :2]}.items():
        with pytest.raises(InputError, match=f"chunk: {name} must be \\[t"):
            MODEL.run({}, MODEL.init_cache(), wrong(stacked, **{name: leaf}))
    with pytest.raises(InputError, match=r"Chunks have 3 views \(`stream.chunk_size`\)"):
        check_chunk(chunk(views=2), 3)
    with pytest.raises(InputError, match=r"images must be \[t 3 h w 3\], got \[3, .*Stack chunks along a leading axis"):
        MODEL.run({}, MODEL.init_cache(), one)
