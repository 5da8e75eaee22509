"""`ssplat run --view`: a viewer beside a run, which stays open after it."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import urllib.request

import pytest

from ssplat_jax.storage.run_folder import RunFolder
from tests.commands.command_fixture import make_capture
from tests.viewer.fake_client import free_port


@pytest.mark.slow
def test_a_capture_is_streamed_and_shown_by_one_command(tmp_path):
    pytest.importorskip("viser")
    capture, out = make_capture(tmp_path / "capture", num_frames=12), tmp_path / "out"
    code = "from ssplat_jax.commands.start import start; start()"
    arguments = [sys.executable, "-c", code, "run", str(capture), "--out", str(out), "--view"]
    arguments += ["--port", str(free_port()), "--set", "capacity=2048", "--refine", "0"]
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True, start_new_session=True)
    try:
        line = next(line for line in process.stdout if line.startswith("http://localhost:"))
        with urllib.request.urlopen(line.split()[0], timeout=60) as page:
            assert page.status == 200
        assert any("stays open" in line for line in process.stdout)
        assert json.loads(RunFolder(out).metrics.read_text())["views"] == 12
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(timeout=60) == 130
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
