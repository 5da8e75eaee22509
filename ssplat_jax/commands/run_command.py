"""`ssplat run`: a capture streamed into a scene."""

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ssplat_jax.commands.options import (
    AxesOption,
    CapturePath,
    ConfigChanges,
    PosesOption,
    QualityOption,
    QuietOption,
    ReviseOption,
    WeightsOption,
    capture_path,
    causal_changes,
    check_refinement,
    load_model,
    online_changes,
    parse_size,
    refinement_steps,
)
from ssplat_jax.commands.refine_command import Refine
from ssplat_jax.config import QUALITIES
from ssplat_jax.core.errors import InputError

if TYPE_CHECKING:
    from ssplat_jax.runs.capture_run import RunResult


@dataclasses.dataclass(frozen=True)
class Run:
    """Stream a capture into a scene: scene.ply in the capture's frame, pictures, metrics.json. Continues a stopped run.

    Example: ssplat run path/to/capture --stride 5 --size 320x240 --out runs/kitchen
    """

    capture: CapturePath
    out: Path
    """Folder of the results; a run that stopped there is continued."""
    stride: int = 1
    """Use every STRIDE-th frame."""
    max_views: int | None = None
    """Stop after this many views."""
    size: str | None = None
    """Image size WxH; default the capture's own."""
    quality: QualityOption = "accurate"
    weights: WeightsOption = "tiny"
    set: ConfigChanges = ()
    save_every: int = 8
    """Chunks between saved states."""
    overwrite: bool = False
    """Remove the run in the folder and start anew."""
    deltas: bool = False
    """Also write the changes of each chunk, deltas/<views so far>.npz, for `ssplat view` to follow."""
    hold_back: int = 0
    """Keep so many evenly spread frames out of the stream, and score them every fourth chunk."""
    view: bool = False
    """Open a viewer beside the run, which shows the scene while it grows; implies --deltas (extra `viewer`)."""
    port: int = 8080
    """With --view: its port; the next free one if it is taken."""
    refine: int | None = None
    """Then take this many steps on the streamed frames, as `ssplat refine` does, into refined.ply; default 0, with
    --quality best 100."""
    revise: ReviseOption = None
    online_refine: int = 0
    """Gradient steps on kept views after each chunk, while streaming; later chunks see the revised scene."""
    causal: bool = False
    """No look-ahead: near, far and scale come from the first chunk, and frames keep their order."""
    watch: bool = False
    """The folder is still being written (transforms.json): stream chunks as their images are complete, causally."""
    quiet_seconds: float = 10.0
    """With --watch: end after so many seconds without a new frame; a file `done` in the capture ends it at once."""
    axes: AxesOption = None
    poses: PosesOption = None
    quiet: QuietOption = False

    @property
    def refine_steps(self) -> int:
        """Refinement steps after the stream."""
        return refinement_steps(self.quality, self.refine)

    def run(self) -> int:
        self._check()
        if not self.view:
            return self._run()
        from ssplat_jax.viewer.beside_run import viewer_beside

        with viewer_beside(self.out, self.port) as viewer:
            if code := self._run():
                return code
            print("the viewer stays open; Ctrl-C ends it", flush=True)
            ended = viewer.wait()
        return 128 + ended if ended else 0

    def _check(self) -> None:
        """Refuses options that contradict each other."""
        from ssplat_jax.data.posed_image import split_options

        check_refinement(self.refine_steps, "--refine")
        if self.quiet_seconds != Run.quiet_seconds and not self.watch:
            raise InputError("--quiet-seconds: wanted --watch beside it, which it is for; got none.")
        if self.watch and self.revise:  # before the stream, poses are adjusted to all frames
            raise InputError(f"--revise {self.revise}: wanted a capture that is complete, got --watch; leave one out.")
        if self.watch and (self.axes or self.poses or split_options(self.capture)[1]):
            got = "--axes or --poses" if self.axes or self.poses else "?axes= or ?poses= behind the capture"
            raise InputError(f"--watch: wanted poses as transforms.json has them, got {got}; leave one out.")
        if self.hold_back and self.watch:
            raise InputError("--hold-back: wanted a capture that is complete; got --watch. Leave one out.")
        if self.port != Run.port and not self.view:
            raise InputError("--port: wanted --view beside it, which it is for; got none.")

    def _run(self) -> int:
        """Streams, tells what came of it, and refines if that is wanted; returns the exit code."""
        result = self._watch() if self.watch else self._stream()
        if result.interrupted:
            how = " without --overwrite" if self.overwrite else ""
            print(f"stopped after {result.num_views} views; the same command{how} continues", file=sys.stderr)
            return 128 + result.interrupted
        if result.was_finished:
            print(
                f"{self.out} holds this run, finished: scene.ply ({result.num_gaussians} Gaussians from"
                f" {result.num_views} views), views/ and metrics.json; --overwrite starts it anew"
            )
        else:
            print(
                f"wrote {self.out}/scene.ply ({result.num_gaussians} Gaussians from {result.num_views} views);"
                f" pictures and figures: {self.out}/report.html"
            )
        if self.refine_steps:
            return Refine(
                self.out,
                self.capture,
                self.refine_steps,
                self.weights,
                overwrite=self.overwrite,
                axes=self.axes,
                poses=self.poses,
                quiet=self.quiet,
            ).run()
        return 0

    def _stream(self) -> "RunResult":
        """Streams a capture that is complete."""
        from ssplat_jax.core.console import Reporter
        from ssplat_jax.runs.capture_run import run_capture

        changes = causal_changes(online_changes(self.set, self.online_refine), self.causal)
        model, params = load_model(self.weights, changes)
        return run_capture(
            model,
            params,
            capture_path(self.capture, self.axes, self.poses),
            self.out,
            size=parse_size(self.size),
            scale=QUALITIES[self.quality].scale,
            stride=self.stride,
            max_views=self.max_views,
            save_every=self.save_every,
            overwrite=self.overwrite,
            deltas=self.deltas or self.view,
            num_held_back=self.hold_back,
            revise=self.revise,
            reporter=Reporter(self.quiet),
        )

    def _watch(self) -> "RunResult":
        """Streams a capture while it is written."""
        from ssplat_jax.core.console import Reporter
        from ssplat_jax.runs.watch_run import WatchOptions, watch_capture

        changes = online_changes(self.set, self.online_refine)
        model, params = load_model(self.weights, causal_changes(changes, True))
        options = WatchOptions(
            size=parse_size(self.size),
            scale=QUALITIES[self.quality].scale,
            stride=self.stride,
            max_views=self.max_views,
            quiet_seconds=self.quiet_seconds,
            save_every=self.save_every,
            overwrite=self.overwrite,
            deltas=self.deltas or self.view,
        )
        return watch_capture(model, params, self.capture, self.out, options, Reporter(self.quiet))
