"""Masks: where they come from, and that what they hide gives no tokens, no exposure, no score and nothing to learn."""

import dataclasses

import jax
import numpy as np
import pytest
from PIL import Image

import ssplat_jax as ss
from ssplat_jax.config import StreamConfig
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import mean_color
from ssplat_jax.data.capture import ArrayPixels
from ssplat_jax.data.images import Lens, undistort
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.evaluation.metrics import psnr, ssim
from ssplat_jax.rasterizer import fill_holes
from ssplat_jax.refinement.compared_views import RefineConfig, view_loss
from ssplat_jax.refinement.refine import key_views_of
from ssplat_jax.runs.capture_run import GrowingCapture
from ssplat_jax.runs.stream_commands import Run
from ssplat_jax.streaming.session import Session, feed_capture
from tests.badinputs.cases import HEIGHT, NUM_FRAMES, WIDTH, another, frame, make_capture, opened, top
from tests.data.capture_fixture import frame_of, smooth_capture
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
    chunk = next(capture.chunks(StreamConfig(), range(4), stream_frame=frame_of(capture)))
    np.testing.assert_array_equal(chunk.seen[2], ~HIDDEN)
    assert chunk.seen[:2].all()
    small = dataclasses.replace(capture, width=WIDTH // 2, height=HEIGHT // 2).seen(2)
    assert not small[5:10, 3:15].any() and small[:4].all() and small[12:].all()


def test_masks_of_no_image_are_counted_and_captures_without_masks_have_none(tmp_path):
    capture = opened(tmp_path, in_folder("another.png"))
    assert not capture.is_masked and capture.notes[0].startswith("1 files in masks/ are left out")
    assert capture.seen(0) is None
    assert next(capture.chunks(StreamConfig(), range(4), stream_frame=frame_of(capture))).seen is None


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
    assert psnr(image, target, np.ones_like(seen)) == psnr(image, target)


# -- a room in which a sphere moves -----------------------------------------------------------------------------------

NUM, WITH_SPHERE = 8, range(3, 6)


def with_sphere(capture):
    """The capture in which a magenta sphere moves through three frames, and where it covers them."""
    images, covered = capture.pixels.images.copy(), np.zeros((NUM, capture.height, capture.width), bool)
    rows, columns = np.mgrid[: capture.height, : capture.width] + 0.5
    for i in WITH_SPHERE:
        K = capture.K(i)
        rays = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones_like(rows)], axis=-1)
        center = np.array([0.12 * (i - 4), 0.05, 0.9])
        along = rays @ center / np.linalg.norm(rays, axis=-1)
        covered[i] = center @ center - along**2 < 0.25**2
        images[i][covered[i]] = [1.0, 0.0, 1.0]
    return images, covered


@jax.jit
def drawn(gaussians, camera):
    """The image with holes filled, so that what no frame shows costs little."""
    out = ss.render(gaussians, camera, max_pairs=1 << 17)
    return fill_holes(out.color, out.alpha, mean_color(gaussians))


@pytest.fixture(scope="module")
def colors(programs_shared):
    """Every third frame of the empty room, and as drawn after a stream of it, of the spoiled room and of a masked one.

    The masks of the first two rooms hide nothing, so that one program streams all three.
    """
    room = open_capture(f"procedural:room?frames={NUM}&size=64x48")
    images, covered = with_sphere(room)
    frames = tuple(dataclasses.replace(f, is_masked=i in WITH_SPHERE) for i, f in enumerate(room.frames))
    model, params = ss.StreamSplat(ss.preset("tiny")), ss.load_params("tiny")
    colors = {"wanted": [room.image(i) for i in range(0, NUM, 3)]}
    everywhere = np.ones_like(covered)
    rooms = {"empty": (room.pixels.images, everywhere), "spoiled": (images, everywhere), "masked": (images, ~covered)}
    for name, (pixels, seen) in rooms.items():
        capture = dataclasses.replace(room, frames=frames, pixels=ArrayPixels(pixels, room.pixels.depths, seen))
        frame, session = capture.stream_frame(model.config), Session(model, params)
        exposures, _ = feed_capture(session, capture, range(NUM), frame)
        gaussians = session.gaussians()
        colors[name] = [drawn(gaussians, capture.camera(i, frame)) * exposures[i] for i in range(0, NUM, 3)]
    return {name: np.stack(x) for name, x in colors.items()}


def test_a_masked_sphere_does_not_appear(colors):
    """Few pixels are as magenta as it is."""
    share = {name: np.mean((c[..., 1] < 0.25) & (c[..., [0, 2]].min(axis=-1) > 0.5)) for name, c in colors.items()}
    assert share["spoiled"] > 0.005
    assert share["masked"] <= share["empty"] + 1e-4, share


def test_the_rest_of_a_masked_room_is_as_good_as_an_empty_one(colors):
    """Scored on the empty room's images; the spoiled room is clearly worse."""
    drawn, wanted = (colors[name] for name in ("empty", "spoiled", "masked")), colors["wanted"]
    empty, spoiled, masked = (np.mean([psnr(*pair) for pair in zip(x, wanted, strict=True)]) for x in drawn)
    assert masked > empty - 2.0  # three frames show less of it
    assert spoiled < masked - 0.5


def test_refinement_learns_nothing_from_masked_pixels():
    """Whatever the masked pixels hold, the errors that the scene follows are the same."""
    capture, seen, losses = smooth_capture(1, 32, 32), np.ones((1, 32, 32), bool), []
    seen[0, :, :16] = False
    frames = (dataclasses.replace(capture.frames[0], is_masked=True),)
    given, config = (scene(0, n=30), jax.numpy.zeros(3)), RefineConfig()
    loss = jax.jit(lambda view: view_loss(*given, view, jax.numpy.int32(0), config, 1 << 12)[0])
    for hidden in (0.0, 1.0):
        images = np.where(seen[..., None], capture.pixels.images, np.float32(hidden))
        masked = dataclasses.replace(capture, frames=frames, pixels=ArrayPixels(images, capture.pixels.depths, seen))
        views = key_views_of(masked, [0], frame_of(masked), {0: np.ones(3)})
        np.testing.assert_array_equal(views.seen, seen)
        losses.append(loss(views.at(0)))
    assert losses[0] == losses[1] > 0
