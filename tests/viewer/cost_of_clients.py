"""Cost of the viewer's clients to a stream: `python -m tests.viewer.cost_of_clients`, on a machine at rest.

Runs with `--deltas` alone and runs with `--view` and three clients take turns. Two clients read what they are sent, one
stalls; none draws, as if the browsers were on other machines. Prints the seconds from chunk to chunk, and their ratio.
"""

import re
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from ssplat_jax.storage.chunk_records import load_chunk_records
from ssplat_jax.storage.run_folder import RunFolder
from tests.viewer.chromium import wait_for
from tests.viewer.test_viewer import free_port

CAPTURE = "procedural:room?frames=96&size=320x240"
COMMAND = "from ssplat_jax.commands.start import start; start()"
ROUNDS = 3
CLIENTS = ("reads", "reads", "stalls")
NUM_WARM = 8  # chunks at the start that are not counted, during which clients connect
LEAST_BYTES = 5_000_000  # that a reading client has been sent


def streamed(out: Path, with_clients: bool) -> float:
    """Seconds from the end of a chunk of a run to the end of the next; clients connect during the first ones."""
    options = ("--view", "--port", str(free_port())) if with_clients else ("--deltas",)
    arguments = [sys.executable, "-c", COMMAND, "run", CAPTURE, "--out", str(out), "--quiet", *options]
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True)
    clients, folder = [], RunFolder(out)
    try:
        assert process.stdout is not None
        if with_clients:
            line = next(line for line in process.stdout if "http://" in line)
            url = re.search(r"http://\S+", line).group()  # pyright: ignore[reportOptionalMemberAccess]
            for i, way in enumerate(CLIENTS):
                file = out.with_name(f"{out.name}-{i}-{way}")
                command = ["nice", "-n", "19", sys.executable, "-m", "tests.viewer.plain_client", url, way, str(file)]
                clients.append((file, subprocess.Popen(command)))  # nice: they stand for other machines
            wait_for(lambda: all(file.exists() for file, _ in clients))
            assert len(folder.chunk_record_files()) < NUM_WARM
        wait_for(folder.metrics.exists, seconds=600)
        ends = [path.stat().st_mtime for path in folder.chunk_record_files()]
        steps = [record.seconds for record in load_chunk_records(folder.chunk_record_files())]
        for file, client in clients:
            assert client.poll() is None, "a client was dropped"
            assert "stalls" in file.name or int(file.read_text()) > LEAST_BYTES
    finally:
        process.kill()  # the viewer ends with it
        for _, client in clients:
            client.kill()
            client.wait()
        process.communicate()
    seconds = (ends[-1] - ends[NUM_WARM]) / (len(ends) - 1 - NUM_WARM)
    step, name = statistics.median(steps[NUM_WARM:]), "with" if with_clients else "without"
    print(f"  {name} clients: {seconds:.3f} s from chunk to chunk, {step:.3f} s of it the step (median)", flush=True)
    return seconds


def main() -> None:
    times = {False: [], True: []}
    with tempfile.TemporaryDirectory(prefix="ssplat-clients-") as name:
        for k in range(ROUNDS):
            for with_clients in times:
                times[with_clients].append(streamed(Path(name) / f"{k}-{with_clients}", with_clients))
    alone, watched = (statistics.median(times[with_clients]) for with_clients in times)
    print(f"seconds a chunk: {alone:.3f} alone, {watched:.3f} with clients that {', '.join(CLIENTS)}")
    print(f"cost: {watched / alone - 1:+.1%}")


if __name__ == "__main__":
    main()
