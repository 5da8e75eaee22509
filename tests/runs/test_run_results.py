"""Reports: one page that loads nothing, with the pictures and figures of its folder."""

import base64
import html
import io
import re
import shlex
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from ssplat_jax.evaluation.pictures import report_page, save_image
from ssplat_jax.runs.run_results import MOST_PICTURES, report_eval, report_run
from ssplat_jax.storage.chunk_records import save_chunk_record
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.storage.weights import load_params, params_digest
from tests.runs.report_fixture import COMMON, record, score, smooth_picture

SHIPPED = params_digest(load_params("tiny"))
JPEG_DB = 30.0  # of a smooth picture


class Page(HTMLParser):
    """The tags of a page, checked for balance."""

    VOID = ("meta", "img")

    def __init__(self, text):
        super().__init__()
        self.tags, self.open, self.text = [], [], ""
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data

    def named(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture
def folder(tmp_path):
    return RunFolder(tmp_path / "run")


def images_of(page):
    for attributes in page.named("img"):
        kind, data = attributes["src"].split(",", 1)
        assert kind == "data:image/jpeg;base64"
        with Image.open(io.BytesIO(base64.b64decode(data))) as image:
            yield np.asarray(image, np.float64) / 255


def check_self_contained(page, text, folder):
    """Nothing is loaded from elsewhere, and links lead to files beside the page."""
    assert not re.search(r"https?:|//\w|url\(|@import|<script|<link", re.sub(r'src="data:[^"]*"', "", text))
    for attributes in page.named("a"):
        assert (folder.path / attributes["href"]).exists() or attributes["href"] == "metrics.json"


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
    check_self_contained(page, text, folder)
    for shown in ("98,765", "21.50 dB", "0.25 s", "30%", "--steps 200", "0123456789ab"):
        assert shown in page.text, shown
    assert "'path to/it'" in page.text and COMMON["capture"] in page.text
    assert {a["href"] for a in page.named("a")} == {"scene.ply", "metrics.json", "views", "chunks"}
    images = list(images_of(page))
    assert len(images) == MOST_PICTURES
    assert text.count("<tr><td>4</td>") == text.count("<tr><td>8</td>") == text.count("<tr><td>12</td>") == 1
    for place, k in ((0, 0), (-1, 30)):
        assert -10 * np.log10(np.mean((images[place] - smooth_picture(k)) ** 2)) > JPEG_DB


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


def test_the_report_of_an_evaluation_holds_both_scores(folder):
    for i in (3, 7):
        save_image(folder.target(i), smooth_picture(i))
    blocks = {"shown": {"psnr": 23.456, "ssim": 0.7521, "lpips": None}, "literal": {"psnr": 17.9, "ssim": 0.66}}
    refinement = {"steps": 10, "before": {"shown": {"psnr": 22.25}}}
    rest = {"target_views": 2, "context_views": 6, "num_gaussians": 4321, "protocol": "paper", "refinement": refinement}
    baselines = {"nearest_view_psnr": 16.28, "mean_color_psnr": 11.0}
    more = {"baselines": baselines, "chunk_ms": {"median": 730.4}, "per_view": [score(3), score(7)]}
    report_eval(folder, COMMON | blocks | rest | more)
    text = folder.report.read_text()
    page = Page(text)
    check_self_contained(page, text, folder)
    for shown in ("23.46 dB", "0.752", "17.90 dB", "16.28 dB", "730 ms", "4,321", "paper", "22.25 dB", "frame 7"):
        assert shown in page.text, shown
    assert len(list(images_of(page))) == 2


def test_text_is_escaped():
    parts = {"files": [("a", "<p>")], "commands": ["a && b <c>"], "details": [("<", ">")]}
    text = report_page(title="<b>&", summary="<i>", facts=[("<u>", "<s>")], **parts)
    for raw in ("<b>&", "<i>", "<u>", "<s>", "<p>", "<c>"):
        assert html.escape(raw) in text
        assert raw in Page(text).text
    assert not {"i", "u", "s", "c"} & {tag for tag, _ in Page(text).tags}


@pytest.mark.parametrize("name", ["a.png", "a.PNG", "a.Jpg"])
def test_an_image_is_written_in_the_format_of_its_suffix(name, tmp_path):
    image = np.tile(np.linspace(0.0, 1.0, 32)[:, None, None], (1, 48, 3))
    save_image(tmp_path / name, image)
    with Image.open(tmp_path / name) as held:
        assert held.format == ("PNG" if name.lower().endswith("png") else "JPEG") and held.size == (48, 32)
        np.testing.assert_allclose(np.asarray(held), 255 * image, atol=0.51 if held.format == "PNG" else 4)
