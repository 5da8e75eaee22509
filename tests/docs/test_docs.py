"""The pages hold what they promise: commands parse, snippets run, links resolve."""

import re
import shlex
import subprocess
from pathlib import Path

import pytest

from ssplat_jax.commands import main as command_line

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*(ROOT / "docs").glob("*.md"), *ROOT.glob("*.md")])

FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
INLINE_CODE = re.compile(r"`([^`]+)`")

every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())

STREAMED = "procedural:room"
STREAMED_SMALL = "procedural:room?frames=8&size=64x48"
"""The capture of the manual loop, and a small one in its place."""


def blocks(page: Path, language: str) -> list[str]:
    """Contents of the fenced blocks in a language."""
    return [text for found, text in FENCE.findall(page.read_text()) if found == language]


def prose(page: Path) -> str:
    """The page without its fenced blocks."""
    return FENCE.sub("", page.read_text())


def anchors(page: Path) -> set[str]:
    """Anchors of the headings, as Python-Markdown's `toc` makes them."""
    headings = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    plain = (re.sub(r"[^\w\s-]", "", heading).strip().lower() for heading in headings)
    return {re.sub(r"[-\s]+", "-", heading) for heading in plain}


def commands_of(page) -> list[str]:
    """Commands `ssplat ...` with arguments, in fenced blocks, indented blocks and inline code."""
    lines = [line for language in ("sh", "") for text in blocks(page, language) for line in text.splitlines()]
    lines += [line.strip() for line in prose(page).splitlines() if line.startswith("    ")]
    lines += INLINE_CODE.findall(prose(page).replace("\n", " "))
    return [line for line in lines if re.match(r"ssplat [a-z]", line)]


def is_complete(command: str) -> bool:
    """True if a command can be typed as it stands: no ellipsis, no alternatives, no placeholder value."""
    return not re.search(r"\.\.\.|\||\[|\bNAME\b|=( |$)", command)


@every_page
def test_commands_parse(page, monkeypatch):
    parsed = []  # by the real parser; the commands do not run
    monkeypatch.setattr(command_line, "guarded", lambda run: parsed.append(run.__self__) or 0)
    for command in filter(is_complete, commands_of(page)):
        arguments = shlex.split(command, comments=True)[1:]
        command_type = command_line.COMMANDS[arguments[0]]
        if "--help" in arguments:
            continue
        is_mention = command in INLINE_CODE.findall(prose(page))
        flags = [a.split("=")[0] for a in arguments if a.startswith("--")]
        if is_mention and not {"--out", "--to"} & set(flags):
            # A mention names the command and the options that matter; the options must exist.
            fields = {name.replace("_", "-") for name in command_type.__dataclass_fields__}
            assert {flag.removeprefix("--") for flag in flags} <= fields, command
            continue
        with pytest.raises(SystemExit) as stop:
            command_line.main(arguments)
        assert not stop.value.code and isinstance(parsed.pop(), command_type), command


def run_snippets(page, tmp_path, monkeypatch, is_wanted) -> int:
    """Runs the wanted snippets of a page in one namespace; returns their number."""
    monkeypatch.chdir(tmp_path)
    namespace: dict = {"__name__": "snippet"}
    wanted = [snippet for snippet in blocks(page, "python") if is_wanted(snippet)]
    for snippet in wanted:
        exec(compile(snippet.replace(f'"{STREAMED}"', f'"{STREAMED_SMALL}"'), str(page), "exec"), namespace)
    return len(wanted)


@every_page
@pytest.mark.usefixtures("compiled_plainly", "registered_networks")
def test_cheap_snippets_run(page, tmp_path, monkeypatch):
    run_snippets(page, tmp_path, monkeypatch, lambda snippet: STREAMED not in snippet)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "count"), [("docs/python_api.md", 1), ("README.md", 1)])
def test_manual_loop_runs(name, count, tmp_path, monkeypatch):
    assert run_snippets(ROOT / name, tmp_path, monkeypatch, lambda snippet: STREAMED in snippet) == count


@every_page
def test_links_resolve(page):
    for link in LINK.findall(prose(page)):
        if "://" in link:
            continue
        file, _, anchor = link.partition("#")
        target = (page.parent / file).resolve() if file else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_no_private_documents_are_cited():
    words = "ALGOR" + "ITHM|DE" + "SIGN"  # not written out, so that this file passes
    found = subprocess.run(["git", "grep", "-nE", words], cwd=ROOT, capture_output=True, text=True, check=False)
    if found.returncode > 1:
        pytest.skip("no git repository")
    assert found.stdout == ""
