"""Ctrl-C: at every moment, every command ends with exit code 130 and a line, never by a signal.

`pytest -m slow -s tests/commands/test_interrupts.py` prints what the fifty interrupts did.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ssplat_jax.commands.main import COMMANDS
from ssplat_jax.config import preset
from ssplat_jax.storage.interrupts import Interrupts
from ssplat_jax.storage.weights import published_tensors
from tests.model.resplat_fixture import named_tensor
from tests.poses.room_fixture import pictures, walk

NUM_INTERRUPTS = 50
TIMEOUT = 300.0


SCRIPT = "from ssplat_jax.commands.start import start; start()"  # as the script `ssplat` does

INTERRUPTED = (130, "ssplat: interrupted\n")

# A command in place of the command line: `main.main` runs `command`, and Ctrl-C ends it from the handler.
AROUND = """
import os, signal, sys, threading, time
from ssplat_jax.commands import main, start

{command}

main.main = lambda: {run}
start.PATIENCE = {patience}
start.start()
"""

# A program that takes seconds to compile, as the first step of a stream does. The pause is that of a busy machine,
# which leaves a thread that still compiles the time to meet data that are freed.
COMPILING = """
import jax, jax.numpy as jnp

def command():
    def compute(x):
        for i in range(1500):
            x = jnp.sort(jnp.sin(x + i) @ x)
        return x
    lowered = jax.jit(compute).lower(jnp.ones((8, 8)))
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    lowered.compile()
"""

SWALLOWING = """
def command():
    for _ in range({signals}):
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5)
        except KeyboardInterrupt:
            pass
    {ending}
"""

IN_A_DESTRUCTOR = """
class Thing:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5)

def command():
    thing = Thing()
    del thing
    time.sleep(60)
"""

CALLED_BY_JAX = """
import jax

def command():
    def traced(x):
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5)
        except KeyboardInterrupt:
            print("an exception went up into JAX", file=sys.stderr)
            raise
        return x

    jax.jit(traced)(1.0)
"""


def ended(command: str, patience: float = 60.0, run: str = "exit(main.guarded(command))") -> tuple[int, str]:
    """Exit code and last words of a process that interrupts itself."""
    environment = {**os.environ, "JAX_ENABLE_COMPILATION_CACHE": "false", "XLA_FLAGS": ""}
    code = AROUND.format(command=command, patience=patience, run=run)
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, timeout=TIMEOUT
    )
    return done.returncode, done.stderr


def test_an_interrupted_compilation_ends_with_130_at_once():
    since = time.monotonic()
    assert ended(COMPILING, run="(main.guarded(command), time.sleep(5), exit(0))") == INTERRUPTED
    assert time.monotonic() - since < TIMEOUT / 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("signals", "ending"),
    [(1, "return 0"), (1, "raise RuntimeError('made of an interrupt')"), (1, "time.sleep(60)"), (2, "time.sleep(60)")],
)
def test_a_swallowed_interrupt_still_ends_the_command(signals, ending):
    assert ended(SWALLOWING.format(signals=signals, ending=ending), patience=0.5) == INTERRUPTED


@pytest.mark.slow
@pytest.mark.parametrize("command", [IN_A_DESTRUCTOR, CALLED_BY_JAX])
def test_an_interrupt_in_a_destructor_or_under_jax_ends_the_command_at_once(command):
    assert ended(command) == INTERRUPTED


def test_ctrl_c_waits_only_where_there_is_work_to_save():
    with Interrupts(has_work=False) as interrupts:
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert interrupts.received is None
        interrupts.has_work = True
        signal.raise_signal(signal.SIGINT)
        assert interrupts.received == signal.SIGINT
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def command_lines(folder: Path) -> dict[str, tuple[str, ...]]:
    """A command line of each command, as new users would type it; `{out}` is a folder of the call's own."""
    run = folder / "run"
    room = "procedural:room?frames=8&size=64x48"
    arguments = ("run", room, "--out", str(run), "--refine", "0", "--quiet")
    subprocess.run([sys.executable, "-c", SCRIPT, *arguments], check=True)
    tensors = {
        t.name: named_tensor(t.name, t.shape) for t in published_tensors(preset("small")).values() if t is not None
    }
    np.savez(folder / "published.npz", **tensors)
    (folder / "photos").mkdir()
    for i, picture in enumerate(pictures(walk(12))):
        Image.fromarray(picture).save(folder / "photos" / f"{i}.png")
    return {
        "demo": ("--out", "{out}"),
        "poses": (str(folder / "photos"), "--out", "{out}"),
        "inspect": ("procedural:room",),
        "run": ("procedural:room", "--out", "{out}"),
        "refine": (str(run), room),
        "eval": ("procedural:room", "--context", "16", "--out", "{out}"),
        "train": ("--out", "{out}"),
        "export": (str(run), "--to", "{out}.spz"),
        "render": (str(run), room, "--out", "{out}"),
        "view": (str(run), "--port", "8931"),
        "import-weights": (str(folder / "published.npz"), "--out", "{out}.npz"),
        "weights": ("tiny",),
        "bench": ("render",),
        "experiment": ("accuracy_vs_time", "--out", "{out}"),
    }


def interrupted(arguments: tuple[str, ...], delay: float) -> tuple[int, str, float] | None:
    """Exit code, output and seconds from the signal to the end; None if the command was done before the signal."""
    command = [sys.executable, "-c", SCRIPT, *arguments]
    quiet = {**os.environ, "TF_CPP_MIN_LOG_LEVEL": "3"}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=quiet)
    try:
        output, _ = process.communicate(timeout=delay)
        assert process.returncode == 0, output
        return None
    except subprocess.TimeoutExpired:
        pass
    process.send_signal(signal.SIGINT)
    since = time.monotonic()
    output, _ = process.communicate(timeout=TIMEOUT)
    seconds = time.monotonic() - since
    # The interpreter's last moments: the closing line is out.
    return None if process.returncode == 0 and seconds < 1 else (process.returncode, output, seconds)


@pytest.mark.slow
def test_fifty_interrupts_at_random_moments_end_with_130(tmp_path):
    pytest.importorskip("viser")  # what `view` needs
    lines, rng = command_lines(tmp_path), np.random.default_rng(int(os.environ.get("SSPLAT_SEED", "0")))
    assert set(lines) == set(COMMANDS)
    longest = dict.fromkeys(lines, 45.0)
    done = attempts = 0
    while done < NUM_INTERRUPTS:
        name = list(lines)[done % len(lines)]
        attempts += 1  # Python itself starts in 0.1 s
        out, delay = (
            tmp_path / f"out{attempts}",
            float(rng.uniform(0.3, longest[name])),
        )
        since = time.monotonic()
        ended = interrupted((name, *(argument.format(out=out) for argument in lines[name])), delay)
        if ended is None:
            longest[name] = max(1.0, 0.9 * (time.monotonic() - since))
            continue
        code, output, seconds = ended
        print(f"{name:<15} after {delay:4.1f} s: {code}, {seconds:4.1f} s later, {output.splitlines()[-1:]}")
        assert code == 130 and "Traceback" not in output, output
        assert output.splitlines()[-1].startswith(("ssplat: interrupted", "stopped ", "closed "))
        done += 1
