"""`ssplat run --view`: a viewer beside a run, which waits for neither the viewer nor its browsers."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
import urllib.request

import pytest

from ssplat_jax.storage.run_folder import RunFolder
from tests.commands.command_fixture import make_capture
from tests.viewer.fake_client import free_port, wait_for


@pytest.mark.slow
def test_a_live_folder_is_streamed_and_shown_by_one_command(tmp_path):
    """A process drops one posed frame a second; the viewer's page is there, and deltas come before the last frame."""
    pytest.importorskip("viser")
    whole, live, out = make_capture(tmp_path / "whole", num_frames=12), tmp_path / "live", tmp_path / "out"
    (live / "images").mkdir(parents=True)
    code = "from ssplat_jax.commands.start import start; start()"
    arguments = [sys.executable, "-c", code, "run", str(live), "--out", str(out), "--watch", "--quiet-seconds", "60"]
    arguments += ["--view", "--port", str(free_port()), "--set", "capacity=2048", "--refine", "0"]
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True, start_new_session=True)
    try:
        facts, seen_early = json.loads((whole / "transforms.json").read_text()), 0
        for i, frame in enumerate(facts["frames"], start=1):
            (live / frame["file_path"]).write_bytes((whole / frame["file_path"]).read_bytes())
            (live / "transforms.json").write_text(json.dumps(facts | {"frames": facts["frames"][:i]}))
            time.sleep(1.0)
            if i == 8:
                wait_for(lambda: RunFolder(out).delta_files(), seconds=300)
                seen_early = len(RunFolder(out).delta_files())
        (live / "done").touch()
        assert process.stdout is not None and seen_early > 0
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
