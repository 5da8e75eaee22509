"""The report: one HTML page that holds its pictures and figures, and loads nothing from elsewhere."""

import base64
import dataclasses
import html
import io
import itertools
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from ssplat_jax.core.atomic import write_atomic

STYLE = """
:root { color-scheme: light dark; --paper: #fbfbf9; --ink: #23282e; --soft: #6b727b; --line: #e2e2dd; --card: #fff; }
@media (prefers-color-scheme: dark) {
  :root { --paper: #16181b; --ink: #e4e6e8; --soft: #9aa1a9; --line: #2c3036; --card: #1d2024; }
}
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink); font: 16px/1.55 system-ui, sans-serif; }
main { max-width: 1040px; margin: 0 auto; padding: 48px 24px 72px; }
h1 { font-size: 1.7rem; font-weight: 600; margin: 0 0 4px; overflow-wrap: anywhere; }
h2 { font-size: 1.05rem; font-weight: 600; margin: 44px 0 14px; }
.summary, .note { color: var(--soft); margin: 0; }
.note { font-size: 0.85rem; margin-bottom: 12px; }
.facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 12px; margin-top: 28px; }
.fact { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: 14px 16px; }
.fact b { display: block; font-size: 1.35rem; font-weight: 600; font-variant-numeric: tabular-nums; }
.fact span { color: var(--soft); font-size: 0.82rem; }
figure { margin: 0 0 6px; }
.pairs { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 440px), 1fr)); gap: 12px; }
figure img { display: block; width: 100%; border-radius: 6px; background: #000; }
figcaption { color: var(--soft); font-size: 0.85rem; margin-top: 5px; font-variant-numeric: tabular-nums; }
table { border-collapse: collapse; width: 100%; font-size: 0.92rem; }
td { border-top: 1px solid var(--line); padding: 7px 16px 7px 0; vertical-align: top; }
td:first-child { white-space: nowrap; }
pre { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: 14px 16px; }
pre { overflow-x: auto; }
code, pre { font: 0.85rem/1.6 ui-monospace, monospace; }
a { color: inherit; }
"""

JPEG_QUALITY = 88


@dataclasses.dataclass(frozen=True)
class Report:
    """The contents of a page, in the order in which they are shown. Empty parts are left out."""

    title: str
    summary: str  # one sentence
    facts: Sequence[tuple[str, str]]  # label and value with its unit
    stream: Sequence[Sequence[str]] = ()  # rows of the table over the stream, the first its header
    pictures: Sequence[tuple[Path, str]] = ()  # image files and captions; missing files are left out
    pictures_note: str = ""  # how the pictures were made
    files: Sequence[tuple[str, str]] = ()  # path relative to the page, and its content
    commands: Sequence[str] = ()  # to go on with
    details: Sequence[tuple[str, str]] = ()


def save_report(path: Path, report: Report) -> None:
    """Writes a report as one HTML file.

    Raises:
        StorageError: the file cannot be written.
    """
    write_atomic(path, page_text(report).encode(errors="replace"))


def page_text(report: Report) -> str:
    """The page as HTML."""
    files = [(f'<a href="{name}"><code>{name}</code></a>', text) for name, text in _escaped(report.files)]
    found = [(file, caption) for file, caption in report.pictures if file.is_file()]
    facts = [f'<div class="fact"><b>{value}</b><span>{label}</span></div>' for label, value in _escaped(report.facts)]
    body = [
        f"<h1>{html.escape(report.title)}</h1>",
        f'<p class="summary">{html.escape(report.summary)}</p>',
        f'<div class="facts">{"".join(facts)}</div>',
        _section("Over the stream", _table(_escaped(report.stream))),
        _section("Pictures", "\n".join(itertools.starmap(_figure, found)), "pairs", report.pictures_note),
        _section("Where everything is", _table(files)),
        _section("Next", f"<pre>{html.escape(chr(10).join(report.commands))}</pre>" if report.commands else ""),
        _section("Details", _table(_escaped(report.details))),
    ]
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(report.title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(filter(None, body))
        + "\n</main>\n</body>\n</html>\n"
    )


def _section(heading: str, content: str, kind: str = "", note: str = "") -> str:
    """A heading and its content; nothing without content."""
    note = f'<p class="note">{html.escape(note)}</p>' if note else ""
    return f'<h2>{heading}</h2>\n{note}<div class="{kind}">{content}</div>' if content else ""


def _table(rows: Sequence[Sequence[str]]) -> str:
    """A table of cells of HTML; nothing without rows."""
    lines = ["<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows]
    return f"<table>{''.join(lines)}</table>" if rows else ""


def _escaped(rows: Sequence[Sequence[str]]) -> list[list[str]]:
    return [[html.escape(cell) for cell in row] for row in rows]


def _figure(file: Path, caption: str) -> str:
    """A picture as a data URI, above its caption."""
    encoded = io.BytesIO()
    with Image.open(file) as picture:
        picture.convert("RGB").save(encoded, "JPEG", quality=JPEG_QUALITY)
    data = base64.b64encode(encoded.getvalue()).decode()
    caption = html.escape(caption)
    return (
        f'<figure><img src="data:image/jpeg;base64,{data}" alt="{caption}"><figcaption>{caption}</figcaption></figure>'
    )
