"""Runs the mutants of mutants.toml: `python -m tests.mutation.run` prints which of them the default tests notice.

Each mutant is applied to a copy of the tree in a temporary folder, where its tests run until the first failure.
Arguments are parts of `file: old`, such as `cache data/images.py`; without any, all mutants run (an hour on two cores).
"""

import collections
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
TIMEOUT_S = 900


class Mutant(NamedTuple):
    file: str
    old: str
    new: str
    tests: str


def copy_of_tree(folder: Path) -> None:
    """Copies the files that git knows, and new ones that it does not ignore."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        check=True,
    )
    for name in listed.stdout.decode().split("\0"):
        if name and (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)


def is_killed(folder: Path, mutant: Mutant) -> tuple[bool, str]:
    """True if the mutant's tests fail, and the last line that pytest prints."""
    file = folder / "ssplat_jax" / mutant.file
    source = file.read_text()
    file.write_text(source.replace(mutant.old, mutant.new))
    command = [sys.executable, "-m", "pytest", "-n", "0", "-x", "-p", "no:cacheprovider"]
    command += [f"tests/{name}" for name in mutant.tests.split()]
    environment = os.environ | {"PYTHONPATH": f"{folder}:{folder / 'experiments'}"}
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return True, "hangs"
    finally:
        file.write_text(source)
    if done.returncode not in (0, 1, 2):  # passed, failed, or a module that could not be imported
        raise SystemExit(f"{mutant.file}: tests of {mutant.tests} did not run: {(done.stdout + done.stderr)[-500:]}")
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return done.returncode != 0, failed[0][:150] if failed else (done.stdout.splitlines() or [done.stderr])[-1]


def all_mutants() -> list[Mutant]:
    """The mutants of mutants.toml."""
    with (Path(__file__).parent / "mutants.toml").open("rb") as file:
        return [Mutant(**fields) for fields in tomllib.load(file)["mutant"]]


def misplaced(mutants: list[Mutant]) -> list[str]:
    """A line for each mutant whose text does not occur once in its file: the code has moved."""
    counts = [(m, (ROOT / "ssplat_jax" / m.file).read_text().count(m.old)) for m in mutants]
    return [f"{m.file}: wanted {m.old!r} once, found it {count} times" for m, count in counts if count != 1]


def main(words: list[str]) -> int:
    mutants = all_mutants()
    if lines := misplaced(mutants):
        raise SystemExit("\n".join(lines))
    chosen = [m for m in mutants if not words or any(word in f"{m.file}: {m.old}" for word in words)]
    counts: collections.Counter[bool] = collections.Counter()
    with tempfile.TemporaryDirectory(prefix="ssplat-mutants-") as name:
        copy_of_tree(Path(name))
        for mutant in chosen:
            since = time.monotonic()
            killed, why = is_killed(Path(name), mutant)
            counts[killed] += 1
            change = " ".join(f"{mutant.old} -> {mutant.new}".split())
            print(f"{'killed  ' if killed else 'SURVIVED'} {time.monotonic() - since:4.0f} s  {mutant.file}: {change}")
            print(f"                   {why}", flush=True)
    print(f"{counts[True]} of {len(chosen)} killed")
    return 0 if not counts[False] else 1


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
