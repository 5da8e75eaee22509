"""Set-up of all tests: shapes and types checked at every call, strict dtypes, and the folders of real data."""

import atexit
import collections
import gc
import importlib
import importlib.metadata
import os
import shutil
import signal
import tempfile
from pathlib import Path

from jaxtyping import install_import_hook

# Laws to the last bit are laws of the CPU backend; set the variable to test another.
os.environ.setdefault("JAX_PLATFORMS", "cpu")

# Most of the run is compilation, and most of that LLVM's. `XLA_FLAGS= pytest` compiles as users do.
FAST_COMPILATION = ["--xla_backend_optimization_level=0", "--xla_cpu_parallel_codegen_split_count=1"]
if importlib.metadata.version("jaxlib").startswith("0.10."):  # later ones know no other emitters, and no flag for them
    FAST_COMPILATION.append("--xla_cpu_use_fusion_emitters=false")
os.environ.setdefault("XLA_FLAGS", " ".join(FAST_COMPILATION))

# Workers and command lines started by tests compile the same programs: they share one cache, which ends with the run.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="ssplat-tests-")
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)

# Before the package is imported: every annotated signature in it is checked at run time.
install_import_hook("ssplat_jax", "beartype.beartype")

import jax  # noqa: E402
import pytest  # noqa: E402

from ssplat_jax.core.cpu_backend import drop_programs  # noqa: E402

# An int32 array that meets a float32 array is an oversight; Python scalars stay welcome.
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Traced programs are millions of objects that stay. At Python's thresholds, collecting them takes a tenth of a run.
gc.freeze()
gc.set_threshold(50_000, 20, 50)

# Workers take whole files, in this order: the long ones first, so that no worker ends long after the others.
LONG_FILES = (
    "tests/training/",
    "tests/refinement/",
    "tests/runs/",
    "tests/streaming/",
    "tests/commands/",
    "tests/evaluation/",
    "tests/model/test_predict.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts the long files first."""
    items.sort(key=lambda item: not item.nodeid.startswith(LONG_FILES))


@pytest.fixture(scope="session", autouse=True)
def interruptible():
    """Tests and the processes that they start hear Ctrl-C, even where pytest is a background job, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module", autouse=True)
def programs_end_with_their_file():
    """Compiled programs are dropped after a file: those of all files together took 8 GB in each worker."""
    yield
    drop_programs()


def _shared(name: str) -> Path:
    folder = Path(__file__).resolve().parents[2] / "shared" / name
    if not folder.is_dir():
        pytest.skip(f"no ../shared/{name} beside the repository: real data is not part of it")
    return folder


@pytest.fixture
def compiled_plainly():
    """Programs that take longer to optimize than to run: XLA's passes as ever, LLVM's not.

    For the network, training and the command line. The stream, the cache, the rasterizer and its hard cases are tested
    as users compile them.
    """
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.fixture(autouse=True)
def folders_compiled_plainly(request):
    """In these folders all tests are compiled plainly."""
    if request.node.path.parent.name in ("model", "training", "commands"):
        request.getfixturevalue("compiled_plainly")


_session_programs: dict = collections.defaultdict(dict)


@pytest.fixture(scope="module")
def programs_shared():
    """Few programs, for tests of what is around the stream.

    Sessions that differ only in the order of their views share their programs. Small scenes are decoded and drawn as if
    they had one size.
    """
    from ssplat_jax.streaming.session import Session

    create = Session.__init__

    def shared(session, *given, **more):
        create(session, *given, **more)
        session._programs = _session_programs[session.model.config.replace(causal=False, chunk_step=0.0)]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Session, "__init__", shared)
        patch.setattr("ssplat_jax.streaming.session.MIN_DECODED_PIVOTS", 1 << 13)
        patch.setattr(importlib.import_module("ssplat_jax.rasterizer.render"), "MIN_CAPACITY", 1 << 16)
        patch.setattr("ssplat_jax.streaming.scene_delta.MIN_DECODED_ROWS", 1 << 10)
        yield


@pytest.fixture
def registered_networks():
    """Forgets the networks that a test registers."""
    from ssplat_jax.model.network import NETWORKS
    from ssplat_jax.network_configs import NETWORK_CONFIGS

    before = [(registry, dict(registry)) for registry in (NETWORK_CONFIGS, NETWORKS)]
    yield
    for registry, known in before:
        registry.clear()
        registry.update(known)


@pytest.fixture(scope="session")
def captures() -> Path:
    """Folder of real captures beside the repository."""
    return _shared("captures")


@pytest.fixture(scope="session")
def scenes() -> Path:
    """Folder of real splat scenes beside the repository."""
    return _shared("scenes")
