"""No pixel of a target reaches a result that is not a score: targets are poisoned, and everything else is equal."""

import dataclasses

import numpy as np
import pytest

from ssplat_jax.data.capture import ArrayPixels
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.split import interleaved_split
from ssplat_jax.evaluation import cost
from ssplat_jax.evaluation import scoring as evaluation
from ssplat_jax.evaluation.scoring import score_view
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.streaming.session import Session
from tests.model.small import random_params
from tests.streaming.narrow_model import FEW_GAUSSIANS, assert_same_bits

SPLIT = interleaved_split(9, 1, 6)


@pytest.fixture(scope="module")
def capture(programs_shared):
    return open_capture("procedural:room?frames=9&size=64x48")


def poisoned(capture, frames, below):
    """The capture with frames that are noise above and `below` in their lower half."""
    images, frames = np.stack([capture.image(i) for i in range(len(capture))]), list(frames)
    images[frames] = np.random.default_rng(3).uniform(size=images[frames].shape)
    images[frames, capture.height // 2 :] = below
    depths = np.zeros(images.shape[:3], np.float32)
    return dataclasses.replace(capture, pixels=ArrayPixels(images.astype(np.float32), depths))


def evaluated(capture, causal, out, monkeypatch):
    """Everything that an evaluation makes besides scores: frame, exposures, cache, scene and rendered pictures."""
    rendered = []

    def watched(gaussians, scored, i, frame, exposures, *rest):
        # A score against NaN is NaN, which JSON does not hold: the render is kept, the score taken of something else.
        blank = np.zeros((len(scored), scored.height, scored.width, 3), np.float32)
        view = score_view(gaussians, dataclasses.replace(scored, pixels=ArrayPixels(blank, blank[..., 0])), i, frame,
                          exposures, *rest)  # fmt: skip
        rendered.append((view.color, view.depth))
        return view

    monkeypatch.setattr(evaluation, "score_view", watched)
    monkeypatch.setattr(evaluation, "baselines", lambda capture, split: {})
    monkeypatch.setattr(evaluation, "peak_memory", lambda *given: {"peak_memory_bytes": None})
    monkeypatch.setattr(cost, "NUM_REPEATS", 1)
    session = Session(StreamSplat(FEW_GAUSSIANS.replace(causal=causal)), random_params(FEW_GAUSSIANS))
    metrics = evaluation.evaluate(session, capture, SPLIT, out)
    facts = {name: metrics[name] for name in ("stream_frame", "exposures", "cache", "num_gaussians", "split_sha256")}
    return facts, (session.cache, session.gaussians(), rendered)


@pytest.mark.parametrize("causal", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_poisoned_targets_change_nothing_but_scores(causal, capture, tmp_path, monkeypatch):
    facts, arrays = evaluated(capture, causal, tmp_path / "clean", monkeypatch)
    got, there = evaluated(poisoned(capture, SPLIT.targets, np.nan), causal, tmp_path / "poisoned", monkeypatch)
    assert got == facts
    assert_same_bits(there, arrays)


@pytest.mark.slow
def test_a_poisoned_context_view_is_noticed(capture, tmp_path, monkeypatch):
    """The comparison above can fail."""
    facts, _ = evaluated(capture, False, tmp_path / "clean", monkeypatch)
    other = poisoned(capture, SPLIT.context[-1:], 0.5)
    assert evaluated(other, False, tmp_path / "noise", monkeypatch)[0] != facts
