"""Reports: one page that loads nothing, with the pictures and figures of its folder."""

import base64
import io
import re
import shlex
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from ssplat_jax.evaluation.pictures import save_image
from ssplat_jax.runs.run_results import MOST_PICTURES, report_run
from ssplat_jax.storage.chunk_records import ChunkRecord, RecordedView, make_thumbnail, save_chunk_record
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.storage.weights import load_params, params_digest

SHIPPED = params_digest(load_params("tiny"))
JPEG_DB = 30.0  # of a smooth picture
COMMON = {
    "capture": 'a <room> & "more"',
    "size": [96, 24],
    "exposures": {"0": [1.0, 1.0, 1.0], "1": [1.5, 1.0, 1.0]},
    "cache": {"voxels": 10, "capacity": 20, "accepted_fraction": 0.5},
    "stream_frame": {"near": 1.0, "far": 4.0, "scale": 2.0, "warning": None},
    "compile_s": 1.5,
    "config_hash": "0123456789ab",
}


def smooth_picture(k, height=24, width=96):
    y, x = np.mgrid[:height, :width] / width
    return np.stack([x, y, 0.5 + 0.4 * np.sin(6 * x + k)], axis=-1).astype(np.float32)


def score(frame):
    block = {"psnr": 20.0 + frame / 10, "ssim": 0.7, "lpips": None}
    return {"frame": frame, "shown": block, "literal": block | {"psnr": 15.25}, "coverage": 0.9}


def record(num_views):
    """The record of the chunk after which so many views are streamed."""
    views = tuple(
        RecordedView(i, np.eye(4), np.eye(3), np.array([1.0, 1 + i / 50, 1.0]), make_thumbnail(smooth_picture(i)))
        for i in range(num_views - 4, num_views)
    )
    return ChunkRecord(num_views, (96, 24), views, 0.25, num_views / 40, 1000 * num_views)


class Page(HTMLParser):
    """The tags of a page, checked for balance."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.open, self.text = [], [], ""
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data

    def named(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture
def folder(tmp_path):
    return RunFolder(tmp_path / "run")


def test_the_report_of_a_run_holds_its_pictures_and_figures(folder):
    frames = list(range(0, 32, 2))
    for i in frames:
        save_image(folder.view(i), smooth_picture(i))
    for k in (4, 8, 12):
        save_chunk_record(folder.chunk_record(k), record(k))
    folder.scene.write_bytes(b"ply")
    metrics = COMMON | {"views": 12, "ply": {"num_written": 98765}, "seen_views": [score(i) for i in frames]}
    report_run(folder, metrics, "path to/it", SHIPPED)
    text = folder.report.read_text()
    page = Page(text)
    # Nothing is loaded from elsewhere, and links lead to files beside the page.
    assert not re.search(r"https?:|//\w|url\(|@import|<script|<link", re.sub(r'src="data:[^"]*"', "", text))
    hrefs = {attributes["href"] for attributes in page.named("a")}
    assert hrefs == {"scene.ply", "metrics.json", "views", "chunks"}
    assert all((folder.path / href).exists() for href in hrefs - {"metrics.json"})
    assert "98,765" in page.text and "21.50 dB" in page.text and COMMON["capture"] in page.text
    images = [attributes["src"].split(",", 1) for attributes in page.named("img")]
    assert len(images) == MOST_PICTURES and {kind for kind, _ in images} == {"data:image/jpeg;base64"}
    for place, k in ((0, 0), (-1, 30)):
        with Image.open(io.BytesIO(base64.b64decode(images[place][1]))) as image:
            assert -10 * np.log10(np.mean((np.asarray(image) / 255 - smooth_picture(k)) ** 2)) > JPEG_DB


def test_printed_commands_are_words_of_a_shell(tmp_path):
    folder, path = RunFolder(tmp_path / "my kitchen"), "it's $HOME; x"
    folder.path.mkdir()
    report_run(folder, COMMON | {"views": 4, "ply": {"num_written": 5}, "seen_views": [score(0)]}, path, SHIPPED)
    commands = [shlex.split(line, comments=True) for line in Page(folder.report.read_text()).text.splitlines()
                if line.strip().startswith("ssplat ")]  # fmt: skip
    assert [words[1] for words in commands] == ["view", "refine", "render", "export"]
    assert all(words[2] == str(folder.path) for words in commands)
    assert commands[1][3] == commands[2][3] == path and commands[2][-1] == f"{folder.path}_film"
    assert not any("--weights" in words for words in commands)


def test_a_report_without_records_or_pictures_is_whole_and_a_name_that_is_not_utf8_ends_no_run(folder):
    """Names on Linux are bytes; Python keeps the others as surrogates."""
    metrics = COMMON | {"views": 4, "ply": {"num_written": 5}, "seen_views": [score(0)], "capture": "caf\udce9"}
    report_run(folder, metrics, "caf\udce9", SHIPPED)
    text = folder.report.read_text()
    assert "caf?" in text and "Pictures" not in text
