"""Records of a run's chunks as they are streamed, and the scores of frames that the run holds back."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ssplat_jax.core.errors import refusal
from ssplat_jax.data.capture import Capture
from ssplat_jax.evaluation.scoring import score_view
from ssplat_jax.runs.resume import RunState
from ssplat_jax.storage.chunk_records import ChunkRecord, RecordedView, make_thumbnail, save_chunk_record
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.streaming.feed import FedChunk

CHUNKS_PER_SCORE = 4
"""Held-back frames are scored after every so many chunks: to decode and to draw takes about as long as a chunk."""


def hold_back(indices: Sequence[int], count: int) -> tuple[list[int], list[int]]:
    """Splits frames into those to stream and `count` evenly spread ones to hold back.

    Raises:
        InputError: fewer than two frames would be left to stream.
    """
    if count == 0:
        return list(indices), []
    if not 0 <= count <= len(indices) - 2:
        wanted, fix = f"0 to {max(len(indices) - 2, 0)} of the {len(indices)} frames", "hold back fewer"
        raise refusal("--hold-back", wanted=wanted, got=str(count), fix=fix)
    places = {round((k + 0.5) * len(indices) / count - 0.5) for k in range(count)}
    return [i for k, i in enumerate(indices) if k not in places], [indices[k] for k in sorted(places)]


@dataclasses.dataclass
class ChunkRecorder:
    """Writes a record of each chunk.

    Args:
        capture: the capture that is streamed.
        folder: the folder of the run.
        held_back: frames that are not streamed, to be scored.
    """

    capture: Capture
    folder: RunFolder
    held_back: Sequence[int] = ()

    def start(self, run: RunState) -> None:
        """Removes the records that an interrupted run left of chunks which it will stream again."""
        for path in self.folder.chunk_record_files():
            if int(path.stem) > run.num_views:
                path.unlink(missing_ok=True)

    def record(self, run: RunState, fed: FedChunk, *, is_last: bool) -> None:
        """Writes the record of a chunk that the run has just taken in.

        Raises:
            StorageError: it cannot be written.
        """
        facts = run.session.cache_facts()
        number = -(-run.num_views // run.session.model.config.stream.chunk_size) - 1  # of the chunk, from 0
        is_scored = bool(self.held_back) and (is_last or number % CHUNKS_PER_SCORE == 0)
        images = np.asarray(fed.chunk.images)
        record = ChunkRecord(
            num_views=run.num_views,
            size=(self.capture.width, self.capture.height),
            views=tuple(self._view(i, image, fed) for i, image in zip(fed.frames, images, strict=False)),
            seconds=round(fed.seconds, 4),
            occupancy=round(facts["voxels"] / facts["capacity"], 4),
            num_gaussians=int(facts["decoded"]),
            held_back_psnr=self._score(run) if is_scored else None,
        )
        save_chunk_record(self.folder.chunk_record(run.num_views), record)

    def _view(self, i: int, image: Float[np.ndarray, "h w 3"], fed: FedChunk) -> RecordedView:
        exposure = np.asarray(fed.exposures[i], np.float64)
        pose, K = self.capture.frames[i].camtoworld, self.capture.K(i)
        return RecordedView(i, pose, K, exposure, make_thumbnail(image))

    def _score(self, run: RunState) -> float:
        """Mean PSNR, in dB, of the held-back frames as they are shown."""
        gaussians = run.session.gaussians()
        scores = [score_view(gaussians, self.capture, i, run.frame, run.exposures).score for i in self.held_back]
        return round(float(np.mean([score.shown.psnr for score in scores])), 4)
