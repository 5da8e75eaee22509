"""Training of the evidence head: it moves that head alone, towards better crops, the same way every time."""

import dataclasses
from importlib import resources
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ssplat_jax.commands.train_command import Train
from ssplat_jax.config import preset
from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.rasterizer import render
from ssplat_jax.storage.weights import describe_weights, load_params, load_weights
from ssplat_jax.training import evidence_training, streamed_scenes
from ssplat_jax.training.evidence_training import EvidenceRecipe, crop_camera, train_evidence
from ssplat_jax.training.streamed_scenes import SceneSources, captures_of
from tests.commands.test_cli import make_capture

RECIPE = EvidenceRecipe(
    steps=6, crop=(32, 48), width=64, procedural=("procedural:room?frames=12",), warmup_steps=1, learning_rate=0.02
)


@pytest.fixture(scope="module", autouse=True)
def standard_promotion():
    """Allows type promotion: optax raises a float to an int32 power in Adam's bias correction."""
    with jax.numpy_dtype_promotion("standard"):
        yield


@pytest.fixture(scope="module")
def trained():
    """(parameters before, parameters after, facts, records, streams) of a short training on one small scene."""
    params, records, names, made_room, streams = load_params("tiny"), [], [], [], []

    def streamed(*given):
        streams.append(streamed_scenes.stream_scene(*given))
        return streams[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(streamed_scenes, "make_room", lambda: made_room.append(list(names)))
        patch.setattr(evidence_training, "stream_scene", streamed)
        after, facts = train_evidence(
            StreamSplat(preset("tiny")),
            params,
            [],
            RECIPE,
            on_scene=names.append,
            on_step=lambda step, record: records.append((step, record)),
        )
    assert names == facts["scenes"]
    assert made_room == [[]]  # before the scene: programs of many would be too many for one process
    return params, after, facts, records, streams


def test_it_moves_the_evidence_head_alone(trained):
    before, after, _, _, _ = trained
    for stage in before:
        same = [np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (before[stage], after[stage])), strict=True)]
        assert all(same) == (stage != "evidence")
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(after))
    assert float(jnp.abs(after["evidence"]["out"]["kernel"]).max()) > 1e-3  # zeros before training


def test_it_names_its_scenes_and_reports_every_step(trained):
    _, _, facts, records, _ = trained
    assert facts["scenes"] == ["procedural-room, stride 1"]
    assert [step for step, _ in records] == list(range(1, RECIPE.steps + 1))
    assert facts["shown_psnr"] == pytest.approx(records[-1][1]["shown_psnr"], abs=1e-3)
    assert 15 < facts["black_psnr"] <= facts["shown_psnr"] + 1 < 45


def test_an_untrained_head_is_what_it_starts_from(trained, monkeypatch):
    """The head that the parameters hold does not matter."""
    before, after, _, _, streams = trained
    monkeypatch.setattr(evidence_training, "stream_scene", lambda *given: streams[0])
    noise = jax.tree.map(lambda x: x + 1.0, before["evidence"])
    again, _ = train_evidence(StreamSplat(preset("tiny")), {**before, "evidence": noise}, [], RECIPE)
    jax.tree.map(np.testing.assert_array_equal, again["evidence"], after["evidence"])


@pytest.mark.parametrize("steps", [0, 2])
def test_a_stream_that_refines_is_refined_for_training_too(steps, monkeypatch):
    class Begun(Exception):
        """Ends the stream at its beginning."""

    def session(model, params, *, revise):
        assert (revise is None) == (steps == 0)
        raise Begun

    monkeypatch.setattr(streamed_scenes, "Session", session)
    monkeypatch.setattr(streamed_scenes, "make_room", lambda: None)
    model = StreamSplat(preset("tiny").replace(steps_per_chunk=steps))
    with pytest.raises(Begun):
        streamed_scenes.stream_scene(model, {}, open_capture("procedural:room?frames=12&size=64x48"), 1)


@pytest.mark.slow
def test_more_steps_give_better_crops():
    """The mean PSNR over black of the last steps is above that of the first, on the same small scene."""
    records = []
    recipe = dataclasses.replace(RECIPE, steps=40, black_weight=1.0)
    train_evidence(
        StreamSplat(preset("tiny")),
        load_params("tiny"),
        [],
        recipe,
        on_step=lambda step, record: records.append(record["black_psnr"]),
    )
    assert np.mean(records[-10:]) > np.mean(records[:10]) + 0.3


def test_a_crop_is_a_part_of_the_image():
    key = jax.random.split(jax.random.key(0), 3)
    gaussians = Gaussians(
        means=jax.random.normal(key[0], (40, 3)) * 0.5 + jnp.array([0.0, 0.0, 3.0]),
        quats=jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (40, 1)),
        scales=jnp.full((40, 3), 0.1),
        opacities=jnp.full(40, 0.6),
        sh=jax.random.normal(key[1], (40, 1, 3)),
    )
    K = jnp.array([[60.0, 0.0, 40.0], [0.0, 60.0, 30.0], [0.0, 0.0, 1.0]])
    camera = Camera(viewmats=jnp.eye(4), Ks=K, width=80, height=60)
    whole = render(gaussians, camera).color
    part = render(gaussians, crop_camera(camera, jnp.asarray(7), jnp.asarray(13), 32, 48)).color
    np.testing.assert_allclose(part, whole[7 : 7 + 32, 13 : 13 + 48], atol=1 / 255)  # tiles cut faint rims


def test_a_configuration_without_evidence_is_refused():
    model = StreamSplat(preset("tiny").replace(evidence=False))
    with pytest.raises(InputError, match=r"head\.evidence"):
        train_evidence(model, load_params("tiny"), [], RECIPE)


def test_a_folder_of_captures_is_those_in_it(tmp_path):
    for name in ("a", "b"):
        make_capture(tmp_path / name, num_frames=12, size=(64, 48))
    (tmp_path / "notes").mkdir()
    sources = SceneSources(width=64, strides=(1, 2), procedural=())
    found = captures_of([tmp_path], sources, (16, 16))
    assert [(capture.name, stride) for capture, stride in found] == [("a", 1), ("a", 2), ("b", 1), ("b", 2)]


def test_strides_for_which_a_capture_is_too_short_are_left_out(tmp_path):
    make_capture(tmp_path / "short", num_frames=10, size=(64, 48))
    sources = SceneSources(width=64, strides=(1, 2), procedural=())
    assert [stride for _, stride in captures_of([tmp_path / "short"], sources, (16, 16))] == [1]
    make_capture(tmp_path / "shorter", num_frames=5, size=(64, 48))
    with pytest.raises(InputError, match="train: shorter: wanted at least 6 frames, got 5; leave it out"):
        captures_of([tmp_path / "shorter"], sources, (16, 16))


def test_images_smaller_than_a_crop_are_refused():
    recipe = dataclasses.replace(RECIPE, crop=(64, 48))
    with pytest.raises(InputError, match="48x64 or more"):
        train_evidence(StreamSplat(preset("tiny")), load_params("tiny"), [], recipe)


SHIPPED = Path(str(resources.files("ssplat_jax") / "weights" / "tiny.npz"))


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({}, "--init-weights"),
        ({"init_weights": SHIPPED, "shares": (0.5,), "captures": (Path("x"),)}, "--shares"),
        ({"init_weights": SHIPPED, "save_every": 10}, "--save-every"),
    ],
)
def test_options_that_do_not_fit_the_recipe_are_refused(options, named, tmp_path):
    with pytest.raises(InputError, match=named):
        Train(out=tmp_path / "out", recipe="evidence", **options).run()
    assert not (tmp_path / "out").exists()


def test_the_command_writes_weights_with_their_history(trained, tmp_path, monkeypatch, capsys):
    """The file tells the recipe, the scenes, and the training of the weights that it started from."""
    monkeypatch.setattr("ssplat_jax.training.evidence_training.EvidenceRecipe", lambda seed: RECIPE)
    monkeypatch.setattr(evidence_training, "stream_scene", lambda *given: trained[-1][0])
    assert Train(out=tmp_path, recipe="evidence", init_weights=SHIPPED, scale_steps=0.5).run() == 0
    said = capsys.readouterr().err
    assert "minutes on two cores" in said and f"next: `ssplat run CAPTURE --weights {tmp_path}/weights.npz" in said
    params, config = load_weights(tmp_path / "weights.npz")
    provenance = describe_weights(str(tmp_path / "weights.npz")).provenance
    assert config == preset("tiny") and "evidence" in params
    assert provenance["steps"] == 3 and provenance["scenes"] == ["procedural-room, stride 1"]
    assert provenance["before"] == describe_weights("tiny").provenance
