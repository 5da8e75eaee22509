"""Files that version 0.1 wrote, whose headers hold the configuration as a flat dictionary, can still be read."""

import json

import jax
import numpy as np
import pytest

from ssplat_jax.config import PRESETS, preset
from ssplat_jax.core.errors import InputError
from ssplat_jax.model import complete_params
from ssplat_jax.storage.delta_files import load_delta, load_delta_header
from ssplat_jax.storage.npz import save_arrays
from ssplat_jax.storage.saved_config import config_from_header
from ssplat_jax.storage.stream_state import load_state
from ssplat_jax.storage.training_state import RECIPE_FILE, TrainingCheckpoints
from ssplat_jax.storage.weights import load_params, load_weights

FLAT_CONFIG = {
    **{"preset": "tiny", "chunk_size": 4, "scene_scale": "auto", "median_depth": 2.0, "chunk_step": 0.03},
    **{"network": "compact", "encoder_widths": [32, 64], "encoder_blocks": 2, "attention_blocks": 2},
    **{"attention_window": 8, "attention_ffn": 2, "num_depths": 64, "num_sources": 3, "fine_matching": True},
    **{"match_width": 32, "unet_width": 64, "token_width": 64, "mixer_blocks": 2, "mixer_neighbours": 8},
    **{"mixer_radius": 2, "mixer_proj": 32, "vit": "s", "match_stride": 4, "depth_range": None, "depth_space": "log"},
    **{"upstream_compat": False, "depth_readout": "window", "readout_window": 4, "confidence": "window"},
    **{"confidence_window": 1, "cluster_ratio": 1.15, "hpda": True, "anchor_space": "log", "anchor_norm": "none"},
    **{"sigma0": 0.1, "lambda_sigma": 0.5, "gamma_init": 0.1, "cgfi": True, "cgfi_width": 48, "vacc": "voxel"},
    **{"voxel_size": 0.03, "pivots_per_voxel": 4, "min_confidence": 0.5, "capacity": 32768, "overflow": "grow"},
    **{"merge_key": "seed", "merge_weight": "max", "carving": True, "num_witnesses": 32, "match_exposure": True},
    **{"gaussians_per_token": 4, "sh_degree": 0, "scale_mode": "footprint", "max_scale": 1.0},
}
NEW_FIELDS = ("network", "vit", "match_stride", "depth_range", "depth_space", "upstream_compat", "match_exposure")
OLDEST_CONFIG = {name: value for name, value in FLAT_CONFIG.items() if name not in NEW_FIELDS}
"""Configuration from before there was a second network, as in the weights that ship with the preset."""

OLD = preset("tiny").replace(evidence=False, hpda=True, cgfi=True, mixer_blocks=2, min_confidence=0.5)
"""The preset as it was before pivots kept evidence, with the stages that it has left out since and the τ of then."""

FRAME = {"rotation": np.eye(3).tolist(), "origin": [0.0, 0.0, 1.0], "scale": 0.6, "near": 0.7, "far": 4.9}


@pytest.mark.parametrize("fields", [FLAT_CONFIG, OLDEST_CONFIG, OLD.to_dict()], ids=("flat", "oldest", "new"))
def test_flat_configurations_are_read(fields):
    assert config_from_header(fields) == OLD


def test_a_configuration_with_every_field_is_read_as_it_is():
    assert config_from_header(preset("tiny").to_dict()) == preset("tiny")


ADDITIONS = {
    **{"history": {"cgfi_form": "residual", "unit_features": True}},
    **{"head": {"opacity_mode": "compound", "grow_footprints": True, "evidence": False}},
}
"""Fields that became switches, with what they did before."""


@pytest.mark.parametrize("name", PRESETS)
def test_fields_missing_in_a_saved_configuration_do_what_they_did(name):
    fields = preset(name).to_dict()
    for group, switches in ADDITIONS.items():
        fields[group] = {field: value for field, value in fields[group].items() if field not in switches}
    wanted = {f"{group}.{field}": value for group, switches in ADDITIONS.items() for field, value in switches.items()}
    assert config_from_header(fields) == preset(name).replace(**wanted)


def test_changed_fields_of_flat_configurations_are_kept():
    config = config_from_header(FLAT_CONFIG | {"mixer_neighbours": 12, "voxel_size": 0.05})
    assert config == OLD.replace(mixer_neighbors=12, voxel_size=0.05)


def test_unknown_fields_of_flat_configurations_are_refused():
    with pytest.raises(InputError, match="no_such_field"):
        config_from_header(FLAT_CONFIG | {"no_such_field": 1})


@pytest.mark.parametrize("fields", [FLAT_CONFIG, OLDEST_CONFIG], ids=("flat", "oldest"))
def test_old_weights_files_are_read(fields, tmp_path):
    params = complete_params(jax.random.key(0), OLD, load_params("tiny"))
    params = jax.tree.map(lambda x: np.asarray(x, np.float16).astype(np.float32), params)
    leaves = jax.tree_util.tree_flatten_with_path(params)[0]
    arrays = {"/".join(key.key for key in keys): np.asarray(leaf, np.float16) for keys, leaf in leaves}
    save_arrays(tmp_path / "weights.npz", arrays, "weights", {"config": fields, "provenance": {"steps": 3400}})
    loaded, config = load_weights(tmp_path / "weights.npz")
    assert config == OLD
    jax.tree.map(np.testing.assert_array_equal, loaded, params)


def state_arrays() -> dict[str, np.ndarray]:
    """Leaves of a cache with one voxel of two pivots, as version 0.1 named them."""
    counters = ("num_chunks", "num_seen", "num_accepted", "num_merged", "num_low_confidence")
    counters += ("num_non_finite", "num_out_of_range", "num_dropped", "num_evicted")
    floats = {"means": (1, 2, 3), "feats": (1, 2, 5), "seeds": (1, 2, 5), "confidences": (1, 2), "rgbs": (1, 2, 12)}
    floats |= {"quats": (1, 2, 4), "footprints": (1, 2), "witnesses.viewmats": (3, 4, 4), "witnesses.Ks": (3, 3, 3)}
    floats |= {"witnesses.log_depths": (3, 8, 8), "witnesses.weights": (3, 8, 8)}
    rng = np.random.default_rng(0)
    return {
        **{name: rng.normal(size=shape).astype(np.float32) for name, shape in floats.items()},
        **{f"stats.{name}": np.array(i, np.int32) for i, name in enumerate(counters)},
        "voxels": np.array([[1, -2, 3]], np.int32),
        "counts": np.array([2], np.int32),
        "num_voxels": np.array(1, np.int32),
        "num_members": np.array([[3, 1]], np.int32),
        "last_chunks": np.array([[0, 1]], np.int32),
        "table": np.arange(32, dtype=np.int32),
    }


def test_old_stream_states_are_read(tmp_path):
    arrays, caller = state_arrays(), {"config": FLAT_CONFIG, "done": 24, "frame": FRAME}
    save_arrays(tmp_path / "state.npz", arrays, "stream state 3", {"capacity": 8, "caller": caller})
    cache, header = load_state(tmp_path / "state.npz")
    assert header == caller and config_from_header(header["config"]) == OLD
    assert cache.capacity == 8 and int(cache.stats.num_evicted) == 8
    np.testing.assert_array_equal(cache.means[:1], arrays["means"])
    assert not np.asarray(cache.means[1:]).any()
    np.testing.assert_array_equal(cache.table, arrays["table"])
    np.testing.assert_array_equal(cache.witnesses.log_depths, arrays["witnesses.log_depths"])


def test_old_deltas_are_read(tmp_path):
    shapes = {"means": (4, 3), "quats": (4, 4), "scales": (4, 3), "opacities": (4,), "sh": (4, 1, 3)}
    arrays = {name: np.full(shape, i, np.float32) for i, (name, shape) in enumerate(shapes.items())}
    arrays["rows"] = np.array([2], np.int32)
    header = {"capacity": 8, "caller": {"frame": FRAME, "views": 4}}
    save_arrays(tmp_path / "000004.npz", arrays, "scene delta 1", header)
    delta = load_delta(tmp_path / "000004.npz")
    assert delta.capacity == 8 and delta.rows.tolist() == [2]
    for name in shapes:
        np.testing.assert_array_equal(getattr(delta.gaussians, name), arrays[name])
    assert load_delta_header(tmp_path / "000004.npz") == header["caller"]


@pytest.mark.parametrize("fields", [FLAT_CONFIG, OLDEST_CONFIG], ids=("flat", "oldest"))
def test_old_trainings_are_resumed(fields, tmp_path):
    (tmp_path / RECIPE_FILE).write_text(json.dumps({"config": fields, "recipe": {"seed": 0}}))
    description = {"config": OLD.to_dict(), "recipe": {"seed": 0}}
    TrainingCheckpoints(tmp_path, description).close()
    other = {"config": OLD.replace(voxel_size=0.05).to_dict(), "recipe": {"seed": 0}}
    with pytest.raises(InputError, match=r"memory\.voxel_size = 0\.03, wanted 0\.05"):
        TrainingCheckpoints(tmp_path, other)
