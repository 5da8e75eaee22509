"""`ssplat run`: a capture streamed into a scene."""

import dataclasses
import sys

from ssplat_jax.commands.options import QualityOption, StreamOptions, parse_size
from ssplat_jax.commands.refine_command import Refine
from ssplat_jax.core.errors import InputError


@dataclasses.dataclass(frozen=True)
class Run(StreamOptions):
    """Stream a capture into a scene, scene.ply, and refine it into refined.ply. Continues where it was stopped.

    Example: ssplat run path/to/capture --stride 5 --size 320x240 --out runs/kitchen
    """

    quality: QualityOption = "best"
    max_views: int | None = None
    """Stop after this many views."""
    save_every: int = 8
    """Chunks between saved states."""
    overwrite: bool = False
    """Remove the run in the folder and start anew."""
    deltas: bool = False
    """Also write the changes of each chunk, deltas/<views so far>.npz, for `ssplat view` to follow."""
    view: bool = False
    """Open a viewer beside the run, which shows the scene while it grows; implies --deltas (extra `viewer`)."""
    port: int = 8080
    """With --view: its port; the next free one if it is taken."""
    watch: bool = False
    """The folder is still being written (transforms.json): stream chunks as their images are complete, causally."""
    quiet_seconds: float = 10.0
    """With --watch: end after so many seconds without a new frame; a file `done` in the capture ends it at once."""

    def run(self) -> int:
        self._check()
        if not self.view:
            return self._stream_and_refine()
        from ssplat_jax.viewer.view_scene import viewer_beside

        with viewer_beside(self.out, self.port) as wait_for_viewer:
            if code := self._stream_and_refine():
                return code
            print("the viewer stays open; Ctrl-C ends it", flush=True)
            ended = wait_for_viewer()
        return 128 + ended if ended else 0

    def _check(self) -> None:
        """Refuses options that contradict each other."""
        from ssplat_jax.data.posed_image import split_options

        if self.quiet_seconds != Run.quiet_seconds and not self.watch:
            raise InputError("--quiet-seconds: wanted --watch beside it, which it is for; got none.")
        if self.port != Run.port and not self.view:
            raise InputError("--port: wanted --view beside it, which it is for; got none.")
        if self.watch and split_options(self.path)[1]:
            wanted, got = "transforms.json as it is, without depth maps", "--axes, --poses or --depth"
            raise InputError(f"--watch: wanted {wanted}, got {got}; leave it out.")

    def _stream_and_refine(self) -> int:
        """Streams, prints a summary, then refines if requested; returns the exit code."""
        from ssplat_jax.core.console import Reporter
        from ssplat_jax.runs.capture_run import RunOptions, run_capture

        model, params = self.load_model(causal=self.causal or self.watch)
        options = RunOptions(
            size=parse_size(self.size),
            scale=self.scale,
            stride=1 if self.stride is None else self.stride,
            max_views=self.max_views,
            save_every=self.save_every,
            overwrite=self.overwrite,
            deltas=self.deltas or self.view,
            revise=self.revise,
            quiet_seconds=self.quiet_seconds if self.watch else None,
        )
        result = run_capture(model, params, self.path, self.out, options, Reporter(self.quiet))
        if result.interrupted:
            how = " without --overwrite" if self.overwrite else ""
            print(f"stopped after {result.num_views} views; the same command{how} continues", file=sys.stderr)
            return 128 + result.interrupted
        scene = f"scene.ply ({result.num_gaussians} Gaussians from {result.num_views} views)"
        if result.was_finished:
            print(f"{self.out} holds this run, finished: {scene}, views/, metrics.json; --overwrite starts it anew")
        else:
            print(f"wrote {self.out}/{scene}; pictures and figures: {self.out}/report.html")
        if not self.refine_steps:
            return 0
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
