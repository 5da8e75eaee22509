"""From pictures of a textured box to a capture: poses, files, resuming, refusals. COLMAP runs on small images."""

import json

import numpy as np
import pytest
from PIL import Image
from skimage.transform import estimate_transform

from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.poses.estimate import PoseOptions, estimate_poses
from ssplat_jax.storage.files import write_json
from tests.poses.room_fixture import FOCAL, K, pictures, walk

pycolmap = pytest.importorskip("pycolmap", reason="poses need pycolmap: pip install -e '.[poses]'")

from ssplat_jax.poses import sfm  # noqa: E402
from ssplat_jax.poses.sfm import alike_pairs  # noqa: E402

NUM_PHOTOS = 9
QUIET = Reporter(quiet=True)


def estimate(source, out, overwrite=False, **options):
    return estimate_poses(source, out, PoseOptions(**options), overwrite, QUIET)


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    for i, picture in enumerate(pictures(walk(NUM_PHOTOS))):
        Image.fromarray(picture).save(folder / f"p {i}.png")
    return folder


@pytest.fixture(scope="module")
def estimated(photos, tmp_path_factory):
    out = tmp_path_factory.mktemp("estimated") / "capture"
    return out, estimate(photos, out)


def test_cameras_are_found_up_to_a_similarity(estimated):
    out, found = estimated
    capture, wanted = open_capture(out), walk(NUM_PHOTOS)
    assert [frame.name for frame in capture.frames] == [f"images/p_{i}.png" for i in range(NUM_PHOTOS)]
    assert found.registered == sorted(found.names) and 0 < found.reprojection_error < 0.5
    centers = capture.camtoworlds[:, :3, 3], wanted[:, :3, 3]
    similarity = estimate_transform("similarity", *centers)
    assert similarity.residuals(*centers).max() < 0.02 * np.ptp(centers[1], axis=0).max()
    turned = [np.einsum("ji,vjk->vik", poses[0, :3, :3], poses[:, :3, :3]) for poses in (capture.camtoworlds, wanted)]
    np.testing.assert_allclose(turned[0], turned[1], atol=0.02)  # radians since the first picture
    np.testing.assert_allclose(capture.K(0), K, atol=0.03 * FOCAL)
    assert capture.K(0)[0, 0] == capture.K(0)[1, 1]  # too few images for two focal lengths


def test_a_finished_call_does_nothing_again(photos, estimated, monkeypatch):
    out, found = estimated
    files = {file: file.stat().st_mtime_ns for file in out.rglob("*") if file.is_file()}
    monkeypatch.setattr(sfm, "extract_features", None)
    assert estimate(photos, out) == found
    assert files == {file: file.stat().st_mtime_ns for file in out.rglob("*") if file.is_file()}
    with pytest.raises(InputError, match=r"another call \(max_side\).*--overwrite"):
        estimate(photos, out, max_side=100)


def test_a_stopped_call_continues(photos, estimated, tmp_path, monkeypatch):
    """Stopped among the matches, a second call keeps images, features and matches, and ends with the same cameras."""
    out, match_pairs = tmp_path / "capture", sfm.match_pairs

    def stop(space, pairs, advance):
        match_pairs(space, pairs[:20], advance)
        raise KeyboardInterrupt

    monkeypatch.setattr(sfm, "match_pairs", stop)
    with pytest.raises(KeyboardInterrupt):
        estimate(photos, out)
    assert not (out / "transforms.json").exists() and (out / "images").is_dir()
    monkeypatch.setattr(sfm, "match_pairs", match_pairs)
    with pycolmap.Database.open(out / "database.db") as database:
        kept = {i.name: database.num_keypoints_for_image(i.image_id) for i in database.read_all_images()}
    assert len(kept) == NUM_PHOTOS and min(kept.values()) > 50
    assert estimate(photos, out).registered == estimated[1].registered
    found, wanted = (open_capture(folder).camtoworlds[:, :3, :3] for folder in (out, estimated[0]))
    np.testing.assert_allclose(found, wanted, atol=0.02)


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_source_inside_the_results_is_refused_and_stays(overwrite, tmp_path):
    """Images of an earlier call, which --overwrite would remove, may be the only copy of a video's frames."""
    (tmp_path / "images").mkdir()
    write_json(tmp_path / "poses.json", {"request": {}})
    for i, picture in enumerate(pictures(walk(2))):
        Image.fromarray(picture).save(tmp_path / "images" / f"{i}.png")
    with pytest.raises(InputError, match="wanted a folder that does not hold the photos"):
        estimate(tmp_path / "images", tmp_path, overwrite)
    with pytest.raises(InputError, match="outside the photos"):
        estimate(tmp_path / "images", tmp_path / "images" / "capture")
    assert len(list((tmp_path / "images").iterdir())) == 2


def test_pictures_without_overlap_are_refused_and_leave_no_capture(tmp_path):
    rng = np.random.default_rng(0)
    (tmp_path / "in").mkdir()
    for i in range(4):
        Image.fromarray(rng.integers(0, 255, (60, 80, 3), dtype=np.uint8)).save(tmp_path / "in" / f"{i}.png")
    for _ in range(2):  # and again, from what is there
        with pytest.raises(InputError, match=r"got 0 of 4; take pictures"):
            estimate(tmp_path / "in", tmp_path / "out")
    assert not (tmp_path / "out" / "transforms.json").exists()
    assert json.loads((tmp_path / "out" / "poses.json").read_text())["names"] == [f"{i}.png" for i in range(4)]


@pytest.mark.parametrize("name", ["sparse/0/cameras.txt", "transforms.json", "database.db", "images/1.png"])
@pytest.mark.parametrize("text", [None, '{"poses": []}', "[1]", '{"request": "mine"}', "no JSON"])
def test_files_of_another_maker_are_left_alone(name, text, photos, tmp_path):
    """Without a poses.json, or with one that is not ours."""
    held = tmp_path / "capture" / name
    held.parent.mkdir(parents=True)
    held.write_text("mine")
    if text is not None:
        (tmp_path / "capture" / "poses.json").write_text(text)
    for overwrite in (False, True):
        with pytest.raises(InputError, match=r"of another maker.*another --out"):
            estimate(photos, tmp_path / "capture", overwrite)
    assert held.read_text() == "mine"


def test_images_of_the_same_place_are_alike():
    """Two walks past ten places: the partner of an image is that of the same place in the other walk."""
    rng = np.random.default_rng(0)
    places = [rng.uniform(0, 255, (30, 128)) for _ in range(10)]
    walks = [place + rng.normal(0, 8, place.shape) for _ in range(2) for place in places]
    descriptors = [walk.astype(np.float32) for walk in walks]
    assert sorted(alike_pairs(descriptors, 1)) == [(i, i + 10) for i in range(10)]
    descriptors[13] = np.zeros((0, 128), np.float32)  # an image without features
    pairs = alike_pairs(descriptors, 1)
    assert all(13 not in pair for pair in pairs) and (2, 12) in pairs
    assert alike_pairs(descriptors[13:15], 5) == set()
