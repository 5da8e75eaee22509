"""The `ssplat` command line: the list of commands, `main`, and the exit codes.

A command is a dataclass whose fields are the options and whose `run` returns the exit code. Commands import JAX when
they run, so that `ssplat --help` answers at once. Exit codes: 0 success, 2 bad input or usage, 3 storage, 4 out of
memory on the device or a full cache, 130 and 143 interrupted, 141 a closed pipe. The script's entry point is
`commands/start.py`.
"""

import functools
import operator
import os
import platform
import sys
import traceback
from collections.abc import Callable
from importlib import metadata
from typing import Annotated

import tyro

from ssplat_jax import __version__
from ssplat_jax.commands.measure_commands import Bench, Experiment
from ssplat_jax.commands.program_cache import keep_no_programs, keep_programs
from ssplat_jax.commands.scene_commands import Export, Inspect, Poses, View
from ssplat_jax.commands.weights_commands import ImportWeights, Train, Weights
from ssplat_jax.core.errors import CacheError, InputError, is_out_of_memory
from ssplat_jax.runs.stream_commands import Demo, Eval, Refine, Render, Run

EXIT_INPUT, EXIT_STORAGE, EXIT_MEMORY = 2, 3, 4

COMMANDS = {
    "demo": Demo,
    "poses": Poses,
    "inspect": Inspect,
    "run": Run,
    "refine": Refine,
    "eval": Eval,
    "train": Train,
    "export": Export,
    "render": Render,
    "view": View,
    "import-weights": ImportWeights,
    "weights": Weights,
    "bench": Bench,
    "experiment": Experiment,
}
"""All commands by name, in the order of `ssplat --help`."""


REMOVED = ("JAX_ENABLE_X64", "JAX_NUMPY_", "JAX_TRANSFER_GUARD", "JAX_DEFAULT_MATMUL_PRECISION", "JAX_DISABLE_JIT")
"""Prefixes of environment variables that `main` removes, so that commands compute in float32 as JAX does by default."""


PLATFORMS = ("JAX_PLATFORMS", "JAX_PLATFORM_NAME")  # JAX's variables that choose the device
WITHOUT_PROGRAMS = "--no-program-cache"  # option of every command; it comes before the options of each are read


def main(arguments: list[str] | None = None) -> None:
    """Runs the command in `arguments` (default: those of the process) and exits with its code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    for name in [name for name in os.environ if name.startswith(REMOVED)]:
        del os.environ[name]
    if arguments == ["--version"]:  # for reports of errors; answers without importing JAX
        packages = ", ".join(f"{name} {metadata.version(name)}" for name in ("jax", "jaxlib", "flax"))
        print(f"ssplat {__version__} ({packages}, Python {platform.python_version()}, {platform.platform()})")
        sys.exit(0)
    if WITHOUT_PROGRAMS in arguments:
        arguments = [word for word in arguments if word != WITHOUT_PROGRAMS]
        keep_no_programs()
    command = _parse(arguments)
    if not isinstance(command, Bench | Experiment):  # which measure what compiling costs
        keep_programs()
    sys.exit(guarded(command.run))


def _parse(arguments: list[str]):
    """The command that `arguments` name, with its options; exits with 2 if there is no such command or option."""
    options = [word.partition("=")[0] for word in arguments if word.startswith("--")]
    if repeated := [option for option in options if options.count(option) > 1]:  # the last one would hold alone
        sys.exit(_refuse(f"wanted {repeated[0]} once, got it twice; list several values behind one.", EXIT_INPUT))
    config = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff)
    if arguments and arguments[0] in COMMANDS:  # alone, so that hints name options of this command only
        name, *rest = arguments
        return tyro.cli(COMMANDS[name], prog=f"ssplat {name}", args=rest, config=config)
    commands = [Annotated[command, tyro.conf.subcommand(name)] for name, command in COMMANDS.items()]
    return tyro.cli(
        functools.reduce(operator.or_, commands),  # pyright: ignore[reportCallIssue, reportArgumentType]
        prog="ssplat",
        description="StreamSplat in JAX: a calibrated image stream becomes a 3D Gaussian scene, chunk by chunk."
        " `ssplat --version` prints versions; with --no-program-cache, any command compiles its programs anew.",
        args=arguments,
        config=config,
    )


def guarded(run: Callable[[], int]) -> int:
    """Calls `run` and returns its exit code; errors that users can cause become one line on stderr and a code."""
    try:
        return run()
    except (InputError, FileNotFoundError, IsADirectoryError, NotADirectoryError) as error:  # a name that was given
        return _refuse(error, EXIT_INPUT)
    except BrokenPipeError:  # nobody reads the output any more, which is no matter of storage
        raise
    except OSError as error:
        return _refuse(error, EXIT_STORAGE)
    except CacheError as error:
        return _refuse(error, EXIT_MEMORY)
    except KeyboardInterrupt:
        return _refuse("interrupted", 130)
    except Exception as error:
        if is_out_of_memory(error):
            return _refuse("out of device memory; try a smaller --size or capacity.", EXIT_MEMORY)
        given = next((f"{name}={os.environ[name]}" for name in PLATFORMS if os.environ.get(name)), None)
        *_, (frame, _) = traceback.walk_tb(error.__traceback__)
        if given and frame.f_globals.get("__name__", "").endswith(".xla_bridge"):  # JAX was opening its devices
            fix = "for `cuda`, pip install -e '.[cuda]'; or unset it"
            return _refuse(f"{given}: wanted a platform that JAX has here, got none; {fix}.", EXIT_INPUT)
        raise


def _refuse(message: object, code: int) -> int:
    print(f"ssplat: {' '.join(str(message).split())}", file=sys.stderr)
    return code
