"""Import of ReSplat's checkpoints: every tensor has its place, and other files are refused."""

import jax
import numpy as np
import pytest

from ssplat_jax.config import preset
from ssplat_jax.core.errors import InputError
from ssplat_jax.model.network import init_params
from ssplat_jax.storage.weights import DEPTH, as_published, import_params, published_tensor, published_tensors
from tests.model.resplat_fixture import listed_tensors

CONFIG = preset("small").replace(mixer_blocks=1)
HEAD = "encoder.gaussian_head."


@pytest.fixture(scope="module")
def tensors() -> dict[str, np.ndarray]:
    """Checkpoint in which every tensor has its own constant value."""
    shapes = {t.name: t.shape for t in published_tensors(CONFIG).values() if t is not None}
    return {name: np.full(shape, i, np.float32) for i, (name, shape) in enumerate(shapes.items())}


def saved(path, **arrays):
    np.savez(path, **arrays)
    return path


@pytest.mark.parametrize("name", ["paper", "small"])
def test_published_weights_keep_the_depths_that_they_were_trained_with(name):
    config = as_published(preset(name))
    assert config.network.depth_range == (0.01, 200.0) and config.additions.depth_readout == "mean"


def test_every_published_tensor_has_a_place_and_a_shape():
    ours = published_tensors(as_published(preset("small")))
    assert {t.name: t.shape for t in ours.values() if t is not None} == listed_tensors("resplat_small")
    assert {path.split("/")[0] for path, tensor in ours.items() if tensor is None} == {"hpda", "cgfi"}


PLACES = (
    ("encoder/backbone/layer1_0/conv1/kernel", (3, 3, 5, 7), f"{DEPTH}backbone.layer1.0.conv1.weight", (7, 5, 3, 3)),
    ("encoder/pretrained/blocks_11/ls1/gamma", (5,), f"{DEPTH}pretrained.blocks.11.ls1.gamma", (5,)),
    ("cost_volume/regressor_0_3/input_blocks_5_1/qkv/kernel", (5, 7),
     f"{DEPTH}regressor.0.3.input_blocks.5.1.qkv.weight", (7, 5, 1)),
    ("upsampler/resize_layers_1/kernel", (2, 2, 5, 7), f"{DEPTH}upsampler.resize_layers.1.weight", (5, 7, 2, 2)),
    ("upsampler/resize_layers_3/kernel", (3, 3, 5, 7), f"{DEPTH}upsampler.resize_layers.3.weight", (7, 5, 3, 3)),
    ("decoder/gaussian_head_2/kernel", (5, 7), f"{HEAD}2.weight", (7, 5)),
)  # fmt: skip


@pytest.mark.parametrize(("place", "shape", "name", "theirs"), PLACES)
def test_a_parameter_is_found_by_its_name(place, shape, name, theirs):
    tensor = published_tensor(tuple(place.split("/")), shape)
    assert tensor is not None and (tensor.name, tensor.shape) == (name, theirs)
    x = np.random.default_rng(0).normal(size=theirs)
    came = tensor.to_parameter(x)
    assert came.shape == shape
    if len(shape) > 1:  # entry (in 2, out 4); the order differs for transposed convolutions
        index = (2, 4) if theirs[0] == 5 else (4, 2)
        np.testing.assert_array_equal(came[..., 2, 4].reshape(-1), x[index].reshape(-1))


@pytest.mark.slow
def test_a_depth_network_leaves_other_parts_initialized(tensors, tmp_path):
    """A file of the depth network alone, without the prefix of the model around it."""
    alone = {name.removeprefix(DEPTH): x for name, x in tensors.items() if name.startswith(DEPTH)}
    imported = import_params(saved(tmp_path / "depth.npz", **alone), CONFIG)
    assert imported.initialized_parts == ["decoder", "mixer", "tokens"]
    assert imported.num_imported == len(alone) and imported.num_unused == 0
    wanted = jax.eval_shape(lambda key: init_params(key, CONFIG), jax.random.key(0))
    shapes = lambda tree: jax.tree.map(lambda x: (x.shape, x.dtype), tree)  # noqa: E731
    assert shapes(imported.params) == shapes(wanted)
    for place, tensor in published_tensors(CONFIG).items():
        if tensor is not None and tensor.name.startswith(DEPTH):
            leaf = imported.params
            for name in place.split("/"):
                leaf = leaf[name]
            assert float(leaf.reshape(-1)[0]) == tensors[tensor.name].reshape(-1)[0], place
    fresh = init_params(jax.random.key(0), CONFIG, ("hpda", "tokens", "cgfi", "mixer", "decoder"))
    for name, stage in fresh.items():
        jax.tree.map(np.testing.assert_array_equal, imported.params[name], stage)


@pytest.mark.slow
def test_the_depth_network_of_depthsplat_can_be_imported(tmp_path, tensors):
    other = {f"{HEAD}0.weight": np.zeros((37, 64, 3, 3), np.float32), "encoder.feature_upsampler.x": np.zeros(3)}
    pretrained = {name: x for name, x in tensors.items() if ".pretrained." in name or ".backbone." in name}
    path = saved(tmp_path / "depthsplat.ckpt.npz", **pretrained, **other)
    with pytest.raises(InputError, match=r"encoder\.gaussian_head"):
        import_params(path, CONFIG)
    imported = import_params(path, CONFIG, depth_only=True)
    assert imported.num_imported == len(pretrained) and imported.num_unused == 2
    assert not {"encoder/backbone", "encoder/pretrained"} & set(imported.initialized_parts)


def test_files_of_other_networks_are_refused(tmp_path, tensors):
    head = {name: x for name, x in tensors.items() if name.startswith(HEAD)}
    path = tmp_path / "a.npz"
    with pytest.raises(InputError, match=r"a\.npz: wanted weights of ReSplat, .* none of their \d+ tensors"):
        import_params(saved(path, **{"encoder.other.weight": np.zeros(3, np.float32)}), CONFIG)
    lacking = {name: x for name, x in head.items() if not name.endswith("2.bias")}
    with pytest.raises(InputError, match=r"a\.npz: wanted an array encoder\.gaussian_head\.2\.bias, the file has none"):
        import_params(saved(path, **lacking), CONFIG)
    other = head | {f"{HEAD}2.bias": np.zeros(37, np.float32)}
    with pytest.raises(InputError, match=r"wanted encoder\.gaussian_head\.2\.bias of shape \(58,\), got \(37,\)"):
        import_params(saved(path, **other), CONFIG)
    with pytest.raises(InputError, match="cannot be read"):
        import_params(tmp_path / "nothing.pth", CONFIG)
