"""Masks: where they come from, and that what they hide gives no tokens, no exposure, no score and nothing to learn."""

import dataclasses
from typing import NamedTuple

import jax
import numpy as np
import pytest
from PIL import Image

import ssplat_jax as ss
from ssplat_jax.cache.key_views import KeyViews
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import mean_color
from ssplat_jax.data.capture import ArrayPixels, Capture
from ssplat_jax.data.images import Lens, undistort
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.data.stream_frame import StreamFrame
from ssplat_jax.evaluation.metrics import psnr, ssim
from ssplat_jax.rasterizer import fill_holes
from ssplat_jax.refinement.compared_views import RefineConfig, view_loss
from ssplat_jax.refinement.refine import key_views_of
from ssplat_jax.runs.capture_run import GrowingCapture
from ssplat_jax.runs.stream_commands import Run
from ssplat_jax.streaming.session import Exposures, Session, feed_capture
from tests.badinputs.cases import HEIGHT, NUM_FRAMES, WIDTH, another, frame, make_capture, opened, top
from tests.data.capture_fixture import smooth_capture
from tests.scene_files.scene_fixture import scene

HIDDEN = np.zeros((HEIGHT, WIDTH), bool)
HIDDEN[10:20, 5:30] = True


def write_mask(path, white=255, size=(WIDTH, HEIGHT)):
    path.parent.mkdir(parents=True, exist_ok=True)
    mask = Image.fromarray(np.where(HIDDEN, 0, white).astype(np.uint8))
    mask.resize(size, Image.Resampling.NEAREST).save(path)


def in_folder(name, **options):
    return lambda root, meta: write_mask(root / "masks" / name, **options)


def by_path(root, meta):
    write_mask(root / "hidden" / "a.png")
    frame(2, mask_path="hidden/a.png")(root, meta)


def by_alpha(root, meta):
    pixels = np.full((HEIGHT, WIDTH, 4), 200, np.uint8)
    pixels[HIDDEN, 3] = 0
    another(2, "2.png", Image.fromarray(pixels).save)(root, meta)


def painted(values, name="2.png"):
    """A mask in the folder of masks: `values` of hidden pixels, of shown ones, and of two shown rows."""

    def write(root, meta):
        (root / "masks").mkdir()
        pixels = np.where(HIDDEN[..., None], values[0], values[1]).astype(np.uint8)
        pixels[:2] = values[-1]
        Image.fromarray(pixels.squeeze()).save(root / "masks" / name)

    return write


@pytest.mark.parametrize(
    "mask",
    [
        by_path,
        in_folder("2_mask.png"),
        in_folder("2.mask.png"),
        in_folder("2.jpg.mask.png"),
        painted(([0], [1], [7])),  # numbers of objects
        painted(([255, 255, 255, 0], [255, 255, 255, 255])),  # in the alpha channel alone
        painted(([0, 0, 0, 0], [0, 0, 0, 255])),
        painted(([0, 255], [255, 255])),  # gray, opaque
        by_alpha,
        in_folder("2.png"),
        in_folder("2.jpg.png"),
        in_folder("images/2.jpg.png", white=1),
        in_folder("2.png", size=(2 * WIDTH, 2 * HEIGHT)),
    ],
)
def test_masks_hide_pixels_of_some_images(mask, tmp_path):
    capture = opened(tmp_path, mask)
    np.testing.assert_array_equal(capture.seen(2), ~HIDDEN)
    assert capture.seen(1).all() and len(capture.notes) == 1
    chunk = next(capture.chunks(StreamConfig(), range(4), stream_frame=capture.stream_frame(StreamConfig())))
    np.testing.assert_array_equal(chunk.seen[2], ~HIDDEN)
    assert chunk.seen[:2].all()
    small = dataclasses.replace(capture, width=WIDTH // 2, height=HEIGHT // 2).seen(2)
    assert not small[5:10, 3:15].any() and small[:4].all() and small[12:].all()


def test_masks_of_no_image_are_counted_and_captures_without_masks_have_none(tmp_path):
    capture = opened(tmp_path, in_folder("another.png"))
    assert not capture.is_masked and capture.notes[0].startswith("1 files in masks/ are left out")
    assert capture.seen(0) is None
    assert next(capture.chunks(StreamConfig(), stream_frame=capture.stream_frame(StreamConfig()))).seen is None


def test_a_mask_of_another_shape_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"2\.png: wanted the shape of 2\.jpg, 64x48, got 48x48"):
        opened(tmp_path, in_folder("2.png", size=(HEIGHT, HEIGHT)))


def test_a_frame_waits_until_its_mask_is_complete(tmp_path):
    """As `ssplat run --watch` takes frames: a mask of which half is written is as an image of which half is."""
    root = make_capture(tmp_path / "c", by_path)
    watched = GrowingCapture(Run(str(root), tmp_path / "out", quiet_seconds=60.0), Reporter())
    whole = (root / "hidden" / "a.png").read_bytes()
    for content, num_frames in ((None, 2), (whole[: len(whole) // 2], 2), (whole, NUM_FRAMES)):
        (root / "hidden" / "a.png").unlink(missing_ok=True)
        if content is not None:
            (root / "hidden" / "a.png").write_bytes(content)
        watched.look()
        assert len(watched.indices) == num_frames
    np.testing.assert_array_equal(watched.capture.seen(2), ~HIDDEN)


def test_pixels_beyond_the_border_of_a_distorted_image_are_not_seen(tmp_path):
    """A pincushion lens: the undistorted image asks for places that the stored one does not have."""
    capture = opened(tmp_path / "a", top(k1=0.3))
    frame = capture.frames[0]
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    places = Lens(k1=0.3).pixels(frame.K, np.stack([columns, rows], axis=-1))
    inside = ((places >= 0) & (places <= (WIDTH, HEIGHT))).all(axis=-1)
    assert 0.02 < np.mean(~inside) < 0.5
    assert np.mean(capture.seen(0) != inside) < 0.01
    assert any("beyond the border" in note for note in capture.notes)
    barrel = opened(tmp_path / "b", top(k1=-0.1))
    assert not barrel.is_masked and barrel.frames[0].lens is not None
    assert undistort(barrel.image(0), Lens(k1=-0.1), barrel.frames[0].K, outside=0.0).any(axis=-1).all()


def test_scores_are_those_of_the_pixels_that_are_seen():
    rng = np.random.default_rng(0)
    target = rng.uniform(size=(40, 50, 3)).astype(np.float32)
    image = np.clip(target + rng.normal(0, 0.1, target.shape), 0, 1).astype(np.float32)
    seen = np.zeros((40, 50), bool)
    seen[:, :25] = True
    spoiled = np.where(seen[..., None], image, 1 - target)
    assert psnr(spoiled, target, seen) == pytest.approx(psnr(image[:, :25], target[:, :25]), rel=1e-12)
    assert ssim(spoiled, target, seen) == ssim(np.where(seen[..., None], image, target), target, seen)
    assert np.isnan(psnr(image, target, ~seen & seen))
    everywhere = np.ones_like(seen)
    assert psnr(image, target, everywhere) == psnr(image, target)


# -- a room in which a sphere moves -----------------------------------------------------------------------------------

MAGENTA = np.array([1.0, 0.0, 1.0], np.float32)
NUM, WITH_SPHERE = 12, range(4, 9)


def with_sphere(capture):
    """The capture in which a magenta sphere moves through five frames, and where it covers them."""
    images, covered = capture.pixels.images.copy(), np.zeros((NUM, capture.height, capture.width), bool)
    rows, columns = np.mgrid[: capture.height, : capture.width] + 0.5
    for i in WITH_SPHERE:
        K = capture.K(i)
        rays = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones_like(rows)], axis=-1)
        center = np.array([0.12 * (i - 6), 0.05, 0.9])
        along = rays @ center / np.linalg.norm(rays, axis=-1)
        covered[i] = center @ center - along**2 < 0.25**2
        images[i][covered[i]] = MAGENTA
    return images, covered


class Streamed(NamedTuple):
    capture: Capture
    frame: StreamFrame
    exposures: Exposures
    colors: list  # of every third frame


def streamed(capture, model, params) -> Streamed:
    frame = capture.stream_frame(model.config)
    session = Session(model, params)
    exposures, _ = feed_capture(session, capture, range(NUM), frame)
    gaussians, shown = session.gaussians(), range(0, NUM, 3)
    colors = [np.asarray(drawn(gaussians, capture.camera(i, frame))) * exposures[i] for i in shown]
    return Streamed(capture, frame, exposures, colors)


@jax.jit
def drawn(gaussians, camera):
    """The image with holes filled, so that what no frame shows costs little."""
    out = ss.render(gaussians, camera, max_pairs=1 << 17)
    return fill_holes(out.color, out.alpha, mean_color(gaussians))


def magenta_share(colors) -> float:
    """Share of the pixels that are drawn magenta."""
    return float(np.mean([(c[..., 1] < 0.25) & (c[..., [0, 2]].min(axis=-1) > 0.5) for c in colors]))


@pytest.fixture(scope="module")
def scenes(programs_shared):
    """The masks of the empty and the spoiled room hide nothing, so that one program streams all three."""
    room = open_capture(f"procedural:room?frames={NUM}&size=96x64")
    images, covered = with_sphere(room)
    frames = tuple(dataclasses.replace(f, is_masked=i in WITH_SPHERE) for i, f in enumerate(room.frames))
    model, params = ss.StreamSplat(ss.preset("tiny")), ss.load_params("tiny")
    shown = {"empty": (room.pixels.images, ~covered | True), "spoiled": (images, ~covered | True)}
    scenes = {}
    for name, (pixels, seen) in (shown | {"masked": (images, ~covered)}).items():
        capture = dataclasses.replace(room, frames=frames, pixels=ArrayPixels(pixels, room.pixels.depths, seen))
        scenes[name] = streamed(capture, model, params)
    return scenes


def test_a_masked_sphere_does_not_appear(scenes):
    share = {name: magenta_share(scene.colors) for name, scene in scenes.items()}
    assert share["spoiled"] > 0.005
    assert share["masked"] <= share["empty"] + 1e-4, share


def test_the_rest_of_a_masked_room_is_as_good_as_an_empty_one(scenes):
    """Scored on the empty room's images; the spoiled room is clearly worse."""
    images = [scenes["empty"].capture.image(i) for i in range(0, NUM, 3)]
    scores = {name: np.mean([psnr(*pair) for pair in zip(s.colors, images, strict=True)]) for name, s in scenes.items()}
    assert scores["masked"] > scores["empty"] - 2.0  # five frames show less of it
    assert scores["spoiled"] < scores["masked"] - 0.5


def test_refinement_compares_with_the_pixels_of_a_capture_that_are_seen(scenes):
    capture, frame, exposures, _ = scenes["masked"]
    views = key_views_of(capture, range(NUM), frame, exposures)
    np.testing.assert_array_equal(views.seen, [capture.seen(i) for i in range(NUM)])


def test_refinement_learns_nothing_from_masked_pixels():
    """Whatever the masked pixels hold, the errors that the scene follows are the same."""
    capture = smooth_capture(1, 32, 32)
    camera = jax.tree.map(lambda x: x[None], capture.camera(0))
    seen = np.ones((1, 32, 32), bool)
    seen[0, :, :16] = False
    given, config = (scene(0, n=30), jax.numpy.zeros(3)), RefineConfig()
    loss = jax.jit(lambda view: view_loss(*given, view, jax.numpy.int32(0), config, 1 << 12)[0])
    losses = []
    for hidden in (0.0, 1.0):
        images = np.where(seen[..., None], capture.image(0)[None], np.float32(hidden))
        losses.append(loss(KeyViews.of(camera, images, None, seen).at(0)))
    assert losses[0] == losses[1] > 0
