"""Picture files: images, H.264 videos, which all browsers and players support, and reports.

A report is one HTML page that holds its pictures and figures, and loads nothing from elsewhere.
"""

import base64
import html
import io
import os
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from ssplat_jax.core.atomic import write_atomic
from ssplat_jax.core.errors import optional_package
from ssplat_jax.core.false_colors import eight_bits


def save_image(path: Path, image: Float[np.ndarray, "h w 3"]) -> None:
    """Writes an image in [0, 1] as an 8-bit file in the format of the suffix.

    Raises:
        StorageError: the file cannot be written.
    """
    encoded = io.BytesIO()
    Image.fromarray(eight_bits(image)).save(encoded, Image.registered_extensions()[path.suffix.lower()])
    write_atomic(path, encoded.getvalue())


# -- video -------------------------------------------------------------------------------------------------------------


FRAMES_PER_SECOND = 24
BT709 = 1  # color space; players assume it when a file names none, and ours names it
QUALITY = "18"  # x264's constant rate factor: visually lossless


class VideoWriter:
    """Encoder of a video of fixed size: frames are encoded as they are added, and `save` writes the file.

    Raises:
        InputError: PyAV is not installed.
    """

    def __init__(self, width: int, height: int) -> None:
        av = optional_package("av", "video")
        self._encoded, self._frame_of = io.BytesIO(), av.VideoFrame.from_ndarray
        self._container: Any = av.open(self._encoded, "w", format="mp4")
        self._stream = self._container.add_stream("libx264", Fraction(FRAMES_PER_SECOND), options={"crf": QUALITY})
        # Chroma is stored per 2x2 pixels, so the last pixel of an odd side is cropped.
        self._stream.width, self._stream.height = width // 2 * 2, height // 2 * 2
        self._stream.pix_fmt = "yuv420p"
        context = self._stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = BT709

    def add(self, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Appends one RGB frame."""
        image = np.ascontiguousarray(image[: self._stream.height, : self._stream.width])
        frame = self._frame_of(image, format="rgb24").reformat(format="yuv420p", dst_colorspace="ITU709")
        self._container.mux(self._stream.encode(frame))

    def save(self, path: str | os.PathLike) -> None:
        """Finishes the video and writes it to `path` atomically.

        Raises:
            StorageError: the file cannot be written.
        """
        self._container.mux(self._stream.encode())
        self._container.close()
        write_atomic(path, self._encoded.getvalue())


# -- report ------------------------------------------------------------------------------------------------------------


STYLE = """
:root { color-scheme: light dark; --soft: color-mix(in srgb, CanvasText 60%, Canvas); }
* { box-sizing: border-box; }
body { margin: 0; font: 16px/1.55 system-ui, sans-serif; }
main { max-width: 1040px; margin: 0 auto; padding: 48px 24px 72px; }
h1 { font-size: 1.7rem; margin: 0 0 4px; overflow-wrap: anywhere; }
h2 { font-size: 1.05rem; margin: 44px 0 14px; }
p, figcaption, .facts span { color: var(--soft); font-size: 0.85rem; margin: 4px 0 12px; }
.facts, .pairs { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 12px; }
.pairs { grid-template-columns: repeat(auto-fill, minmax(min(100%, 440px), 1fr)); }
.facts b { display: block; font-size: 1.35rem; }
figure { margin: 0; }
figure img { width: 100%; border-radius: 6px; }
table { border-collapse: collapse; width: 100%; font-size: 0.92rem; }
td { border-top: 1px solid var(--soft); padding: 7px 16px 7px 0; vertical-align: top; }
pre { overflow-x: auto; }
"""

JPEG_QUALITY = 88


def report_page(
    *,
    title: str,
    summary: str,
    facts: Sequence[tuple[str, str]],
    stream: Sequence[Sequence[str]] = (),
    pictures: Sequence[tuple[Path, str]] = (),
    pictures_note: str = "",
    files: Sequence[tuple[str, str]] = (),
    commands: Sequence[str] = (),
    details: Sequence[tuple[str, str]] = (),
) -> str:
    """The report as HTML, its parts in the order of the arguments; empty ones are left out.

    Args:
        title: heading.
        summary: one sentence.
        facts: label and value with its unit.
        stream: rows of the table over the stream, the first its header.
        pictures: image files and captions; missing files are left out.
        pictures_note: how the pictures were made.
        files: path relative to the page, and its content.
        commands: to go on with.
        details: label and value.
    """
    title, summary, note = map(html.escape, (title, summary, pictures_note))
    linked = [(f'<a href="{name}"><code>{name}</code></a>', text) for name, text in _escaped(files)]
    figures = [_figure(file, html.escape(caption)) for file, caption in pictures if file.is_file()]
    sections = {
        "Over the stream": _table(_escaped(stream)),
        "Pictures": f'<p>{note}</p><div class="pairs">{"".join(figures)}</div>' if figures else "",
        "Where everything is": _table(linked),
        "Next": f"<pre>{html.escape(chr(10).join(commands))}</pre>" if commands else "",
        "Details": _table(_escaped(details)),
    }
    shown = "".join(f"<div><b>{value}</b><span>{label}</span></div>" for label, value in _escaped(facts))
    body = "\n".join(f"<h2>{heading}</h2>\n{content}" for heading, content in sections.items() if content)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<main>\n<h1>{title}</h1>\n<p>{summary}</p>\n"
        f'<div class="facts">{shown}</div>\n{body}\n</main>\n</body>\n</html>\n'
    )


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
    shown = f'<img src="data:image/jpeg;base64,{data}" alt="{caption}">'
    return f"<figure>{shown}<figcaption>{caption}</figcaption></figure>"
