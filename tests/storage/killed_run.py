"""`ssplat run` that records every chunk it has processed and can kill itself at a chosen step of a file write.

    python -m tests.storage.killed_run NOTES MOMENT ARGUMENT...

NOTES gets a line per chunk: how many the cache has seen. MOMENT is `-`, or FILE,STEP,COUNT,DELAY: DELAY seconds after
the file called FILE has come to STEP for the COUNT-th time. The steps of a write are

    open      of `FILE.partial`; with a delay, death comes while the bytes are written or brought to the disk
    keep      FILE is about to become FILE.previous
    rename    FILE.partial is about to become FILE, which is not there if it was kept
    sync      FILE has its new contents, and the folder is about to be brought to the disk
"""

import os
import signal
import sys
import threading
import time
from pathlib import Path

STEPS = ("open", "keep", "rename", "sync")
_latest = ""  # name of the file that was renamed last


def step_of(event: str, arguments: tuple) -> tuple[str, str] | None:
    """(file, step) of an audit event that is part of a write, else None."""
    global _latest
    if event == "os.rename":
        source, target = Path(arguments[0]), Path(arguments[1])
        _latest = target.name
        return (source.name, "keep") if target.suffix == ".previous" else (target.name, "rename")
    if event == "open" and isinstance(arguments[0], str | os.PathLike):
        path, flags = Path(arguments[0]), arguments[2]
        if path.suffix == ".partial" and flags & (os.O_WRONLY | os.O_RDWR):
            return path.stem, "open"
        if _latest and path.is_dir():
            return _latest, "sync"
    return None


def die_at(file: str, step: str, count: int, delay: float) -> None:
    """Makes this process kill itself at the `count`-th `step` of `file`, after `delay` seconds."""
    seen = 0

    def die():
        time.sleep(delay)
        os.kill(os.getpid(), signal.SIGKILL)

    def watch(event, arguments):
        nonlocal seen
        if step_of(event, arguments) == (file, step):
            seen += 1
            if seen == count:
                threading.Thread(target=die).start() if delay else die()

    sys.addaudithook(watch)


def main(notes: str, moment: str, *arguments: str) -> None:
    from ssplat_jax.commands.main import main
    from ssplat_jax.streaming.session import Session

    feed, descriptor = Session.feed, os.open(notes, os.O_WRONLY | os.O_CREAT | os.O_APPEND)

    def noted(session, chunk):
        out = feed(session, chunk)
        os.write(descriptor, f"{int(session.cache.stats.num_chunks)}\n".encode())  # a killed process flushes nothing
        return out

    Session.feed = noted
    if moment != "-":
        file, step, count, delay = moment.split(",")
        die_at(file, step, int(count), float(delay))
    main(list(arguments))


if __name__ == "__main__":
    main(*sys.argv[1:])
