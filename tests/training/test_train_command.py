"""`ssplat train`: what it starts from, what it refuses and what it writes, and the evidence head on whole streams."""

import dataclasses
import json
from importlib import resources
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.commands.weights_commands import Train
from ssplat_jax.config import preset
from ssplat_jax.core.gaussians import mask_gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import interleaved_split
from ssplat_jax.model.network import init_params
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.rasterizer import render
from ssplat_jax.storage.weights import describe_weights, load_params, load_weights, save_weights
from ssplat_jax.training import anchors, crops, loop, recipe
from ssplat_jax.training.anchors import StreamParts
from ssplat_jax.training.crops import Crops
from ssplat_jax.training.recipe import ANCHOR_RECIPE, EVIDENCE_RECIPE
from ssplat_jax.training.samples import TrainingStart, ViewSamples
from tests.model.small import draw_with_numpy, finite, random_params
from tests.streaming.narrow_model import FEW_GAUSSIANS, assert_same_bits

SMALL = FEW_GAUSSIANS.replace(hpda=False, cgfi=False)
SHIPPED = Path(str(resources.files("ssplat_jax") / "weights" / "tiny.npz"))
PARTS = StreamParts(ViewSamples(2, ((64, 64),)), num_streams=2, size=(8, 12), capacity=1 << 12)
CROPS = Crops(procedural=("procedural:room?frames=12",), width=64, size=(32, 48))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Folder of a command that trained the evidence head on one small scene, and what was streamed."""
    out, streams, made_room = tmp_path_factory.mktemp("evidence"), [], []

    def streamed(*given):
        streams.append(stream_scene(*given))
        return streams[-1]

    stream_scene, (phase,) = crops.stream_scene, EVIDENCE_RECIPE.phases
    phase = dataclasses.replace(phase, steps=12, samples=CROPS, warmup_steps=1, learning_rate=0.02)
    with pytest.MonkeyPatch.context() as patch:
        draw_with_numpy(patch, compiled=("evidence",))
        patch.setattr(crops, "make_room", lambda: made_room.append(len(streams)))
        patch.setattr(crops, "stream_scene", streamed)
        patch.setitem(recipe.RECIPES, "evidence", dataclasses.replace(EVIDENCE_RECIPE, phases=(phase,)))
        patch.setattr("ssplat_jax.evaluation.metrics.installed_lpips", lambda: None)  # with the extra, it takes minutes
        start = out / "narrow.npz"
        save_weights(start, random_params(SMALL), SMALL, {"steps": 7})
        assert Train(out=out, recipe="evidence", init_weights=start, scale_steps=0.5, quiet=True).run() == 0
    assert made_room == [0]  # before the scene: programs of many would be too many for one process
    return out, streams


def assert_learned_alone(folder, stage, least):
    """The weights in a folder differ from those of the start in a stage alone, whose last layer began with zeros."""
    (before, _), (after, config) = (load_weights(folder / name) for name in ("narrow.npz", "weights.npz"))
    assert config == SMALL
    for name in before:
        assert jax.tree.all(jax.tree.map(np.array_equal, before[name], after[name])) == (name != stage)
    assert finite(after) and np.abs(after[stage]["out"]["kernel"]).max() > least


def test_the_evidence_head_learns_alone(trained):
    assert_learned_alone(trained[0], "evidence", 1e-3)


def test_a_crop_shows_what_the_whole_scene_shows_there(trained):
    """So do the Gaussians of the pivots that may be seen in it, as large as training may make them."""
    (cache, views), model = trained[1][0], StreamSplat(SMALL)
    params, _ = load_weights(trained[0] / "weights.npz")
    params["evidence"]["out"]["bias"] = jnp.array([0.0, 9.0, 9.0, 0.0])  # scales at their bound
    everything, num_left_out = jax.jit(model.decode)(params, cache), 0
    seen_from = [crops.crop_camera(views.camera(1), place, place, 16, 24) for place in (0, 8, 16)]
    counts = [tuple(map(int, crops.count_in_sight(cache, camera, SMALL))) for camera in seen_from]
    num_pivots, num_gaussians = map(max, zip(*counts, strict=True))
    decode = jax.jit(lambda pivots: model.decode_rows(params, cache, pivots, num_gaussians))
    for camera, count in zip(seen_from, counts, strict=True):
        pivots = crops.pivots_in_sight(cache, camera, SMALL, num_pivots)
        assert (pivots >= 0).sum() == count[0]
        is_kept = model.repeat_per_gaussian(jnp.zeros(cache.confidences.size, bool).at[pivots[: count[0]]].set(True))
        scenes = everything, mask_gaussians(everything, is_kept)
        wanted, got = (render(x, camera, effects=crops.EFFECTS, max_pairs=1 << 15) for x in scenes)
        assert int(wanted.num_overflow) == 0
        np.testing.assert_allclose(got.color, wanted.color, atol=1e-6)
        # Row by row, not by color: rounding changes the order of neighbors at one depth.
        rows, same = decode(pivots), scenes[1].opacities > 0
        for name in ("means", "scales", "opacities", "sh"):
            few, all_of_them = getattr(rows, name)[rows.opacities > 0], getattr(everything, name)[same]
            np.testing.assert_allclose(few, all_of_them, rtol=1e-5, atol=1e-5)
        num_left_out += int((everything.opacities > 0).sum()) - count[1]
    assert num_left_out > 0


def test_half_of_the_views_of_a_crop_were_never_streamed(trained):
    """They are the targets of the split; each stands with an exposure of its own."""
    _, views = trained[1][0]
    split = interleaved_split(12, 1, 11)
    capture = open_capture(CROPS.procedural[0], size=(64, 48))
    images = np.asarray(views.images)[..., :3] / 255
    shown = [i for i in range(12) if any(np.abs(capture.image(i) - x).max() < 0.01 for x in images)]
    assert set(split.targets) < set(shown) and len(shown) == len(images) == 2 * len(split.targets)
    assert np.isfinite(views.exposures).all() and (views.exposures > 0).all()


def test_the_anchor_learns_alone(tmp_path, monkeypatch):
    """On two short streams."""
    draw_with_numpy(monkeypatch, compiled=("hpda",))
    phase = dataclasses.replace(ANCHOR_RECIPE.phases[0], steps=6, samples=PARTS, warmup_steps=1)
    monkeypatch.setitem(recipe.RECIPES, "anchor", dataclasses.replace(ANCHOR_RECIPE, phases=(phase,)))
    save_weights(tmp_path / "narrow.npz", random_params(SMALL), SMALL, {})
    assert Train(out=tmp_path, recipe="anchor", init_weights=tmp_path / "narrow.npz", quiet=True).run() == 0
    assert_learned_alone(tmp_path, "hpda", 0)
    (record,) = (json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines())
    assert np.isfinite(list(record[name] for name in ("l1", "l1_of_matcher", "entropy"))).all()


@pytest.mark.parametrize("order", [[0, 1, 2, 3, 4, 5, 6, 7], [0, 2, 4, 6, 1, 3, 5, 7]], ids=["in order", "dealt out"])
def test_parts_of_a_stream_are_cells_of_its_later_chunks(order, monkeypatch):
    """The cells of a part are those that a model finds which takes the same chunks one after the other."""
    monkeypatch.setattr(anchors, "DEALT_OUT", float(order[1] == 2))
    model, params, said = StreamSplat(SMALL), random_params(SMALL), []
    start = TrainingStart(model, params, None, 3, 4, said.append)
    sample = jax.tree.map(lambda x: x[0], PARTS.views.open(start)(0, 0))
    causal = StreamSplat(SMALL.replace(causal=True, capacity=PARTS.capacity, overflow="drop_new"))
    ordered = lambda x: x.reshape(8, *x.shape[2:])[np.array(order)].reshape(x.shape)  # noqa: E731
    given, truths = sample.chunks, ordered(sample.log_depths)
    given = replace(given, **{name: ordered(getattr(given, name)) for name in ("images", "viewmats", "Ks")})
    chunks = [jax.tree.map(lambda x, t=t: x[t], given) for t in range(2)]
    cache, _ = jax.jit(causal.step)(params, causal.init_cache(), chunks[0])
    prediction = jax.jit(causal.predict)(params, cache, chunks[1])
    part_of = dataclasses.replace(PARTS, num_streams=1).open(start)
    for step in range(3):
        part = jax.tree.map(lambda x: x[0], part_of(step, step))
        assert part.inputs.mask.any() and part.usable.all()
        places = [  # where the part lies in the second chunk
            (y, x)
            for y in range(16 - 8 + 1)
            for x in range(16 - 12 + 1)
            if np.array_equal(part.inputs.mask, prediction.history.mask[:, y : y + 8, x : x + 12])
        ]
        probs, truth = np.asarray(prediction.distribution.probs), np.asarray(truths[1])
        assert any(
            np.allclose(part.inputs.probs, probs[:, y : y + 8, x : x + 12], atol=1e-3)
            and np.array_equal(part.log_depths[:, :7, :11], truth[:, y : y + 7, x : x + 11])
            for y, x in places
        )
    assert said == ["streamed 1 of 1"]


@pytest.fixture
def started(monkeypatch):
    """Arguments that the command gives to a training, which ends at once."""
    seen = {}
    draw_with_numpy(monkeypatch)

    def ends_at_once(config, recipe, out, *, params, **others):
        seen.update(config=config, params=params, lpips_weights=others["lpips_weights"])
        out.mkdir(exist_ok=True)
        return SimpleNamespace(params=params, step=1, interrupted=None)

    monkeypatch.setattr(loop, "train", ends_at_once)
    return seen


def test_the_command_goes_on_with_the_configuration_of_the_weights(tmp_path, started, capsys):
    """Unless --preset asks for another one; what is lost by that is said."""
    held = preset("tiny").replace(cgfi=True, voxel_size=0.02)
    save_weights(tmp_path / "w.npz", random_params(held), held, {"steps": 7})
    asked = {"out": tmp_path / "out", "recipe": "stream", "init_weights": tmp_path / "w.npz"}
    Train(**asked, set=("min_confidence=0.25",)).run()
    assert started["config"] == held.replace(min_confidence=0.25) and started["params"]["cgfi"]
    assert "leaves out" not in capsys.readouterr().err
    facts = describe_weights(str(tmp_path / "out" / "weights.npz"))
    assert facts.provenance["before"] == {"steps": 7} and facts.provenance["fresh"] == []
    Train(**asked, preset="tiny").run()
    said = capsys.readouterr().err
    assert "leaves out cgfi" in said and "memory.voxel_size 0.02 -> 0.03" in said and "cgfi" not in started["params"]


def test_the_command_starts_stages_that_the_weights_lack_at_random(tmp_path, started, capsys):
    Train(out=tmp_path, recipe="stream", init_weights=SHIPPED, seed=3, set=("cgfi=true",)).run()
    assert "tiny.npz gives no cgfi: random at the start" in capsys.readouterr().err  # the mixer has no blocks here
    untrained, shipped = init_params(jax.random.key(3), started["config"], ["cgfi"]), load_params("tiny")
    for name, stage in started["params"].items():
        assert_same_bits(stage, (untrained if name == "cgfi" else shipped)[name])


def test_losses_with_a_term_of_lpips_get_its_weights_where_they_are_installed(tmp_path, started, monkeypatch):
    monkeypatch.setattr("ssplat_jax.evaluation.metrics.installed_lpips", lambda: "weights")
    for name, given in (("stream", "weights"), ("evidence", "weights"), ("depth", None)):
        Train(out=tmp_path / name, recipe=name, init_weights=SHIPPED).run()
        assert started["lpips_weights"] == given


def test_the_head_that_the_weights_have_does_not_matter(tmp_path, started):
    noise = jax.tree.map(lambda x: np.asarray(x) + 1, load_params("tiny"))
    save_weights(tmp_path / "w.npz", noise, preset("tiny"), {})
    Train(out=tmp_path, recipe="evidence", init_weights=tmp_path / "w.npz", seed=5).run()
    wanted = init_params(jax.random.key(5), preset("tiny"), ["evidence"])
    assert_same_bits(started["params"]["evidence"], wanted["evidence"])
