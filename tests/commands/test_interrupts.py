"""Ctrl-C: at every moment a command ends with exit code 130 and a line, never by a signal."""

import os
import signal
import subprocess
import sys
import time

import pytest

from ssplat_jax.storage.run_folder import Interrupts

TIMEOUT = 300.0

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
    started = [sys.executable, "-c", AROUND.format(command=command, patience=patience, run=run)]
    done = subprocess.run(started, capture_output=True, text=True, env=environment, timeout=TIMEOUT)
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
