"""`ssplat run --view`: the viewer in a process of its own beside a run, which never waits for it.

The process reads the files that the run writes, as `ssplat view` does. It yields the processors to the run (a lower
priority), draws on the CPU where the run has a GPU, and ends with the run's process.
"""

import contextlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path

from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError, StorageError
from ssplat_jax.storage.interrupts import Interrupts
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.viewer.scene_sources import GrowingScene
from ssplat_jax.viewer.view_scene import show_source
from ssplat_jax.viewer.viser_viewer import check_address, import_viser

HOST, MOST_GAUSSIANS = "127.0.0.1", 500_000

LOWER_PRIORITY = 19
"""Niceness of the viewer: the least that there is."""


class BesideRun:
    """The viewer's process."""

    def __init__(self, process: BaseProcess) -> None:
        self._process = process

    def wait(self) -> int:
        """Waits until a signal comes or the viewer ends; returns the signal, or 0."""
        with Interrupts() as interrupts:
            while self._process.is_alive() and not interrupts.received:
                self._process.join(0.2)
            return interrupts.received or 0


@contextlib.contextmanager
def viewer_beside(folder: Path, port: int) -> Iterator[BesideRun]:
    """Opens a viewer of a run that is about to write its deltas to `folder`, and closes it afterwards.

    Args:
        folder: the folder of the run.
        port: the port to listen on; the next free one if it is taken.

    Raises:
        InputError: viser is not installed, or cannot listen there.
    """
    import_viser()
    check_address(HOST, port)
    context = multiprocessing.get_context("spawn")  # a fork would share JAX's threads and locks
    process = context.Process(target=_view, args=(folder, port), daemon=True)
    process.start()
    try:
        yield BesideRun(process)
    finally:
        process.terminate()
        process.join()


def _view(folder: Path, port: int) -> None:
    """The viewer's process: shows the run until it is terminated or the run's process is gone."""
    import jax

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run's process decides what Ctrl-C ends
    jax.config.update("jax_platforms", "cpu")
    with contextlib.suppress(OSError):
        os.nice(LOWER_PRIORITY)
    parent, source = multiprocessing.parent_process(), GrowingScene(RunFolder(folder))
    try:
        show_source(
            source,
            host=HOST,
            port=port,
            max_gaussians=MOST_GAUSSIANS,
            is_wanted=lambda: parent is None or parent.is_alive(),
            reporter=Reporter(quiet=True),
        )
    except (InputError, StorageError) as error:
        print(f"ssplat: the viewer has ended, the run goes on: {error}", file=sys.stderr)
