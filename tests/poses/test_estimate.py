"""From pictures of a textured box to a capture: poses, files, resuming, refusals. COLMAP runs on small images."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError
from ssplat_jax.data.open_capture import open_capture
from ssplat_jax.poses import requirements, sfm
from ssplat_jax.poses.estimate import PoseOptions, _request, estimate_poses
from ssplat_jax.storage.files import write_json
from tests.poses.room_fixture import FOCAL, K, pictures, walk

pytest.importorskip("pycolmap", reason="poses need pycolmap: pip install -e '.[poses]'")

NUM_PHOTOS = 9
QUIET = Reporter(quiet=True)


def estimate(source, out, overwrite=False, **options):
    return estimate_poses(source, out, PoseOptions(**options), overwrite, QUIET)


def alike(points, wanted):
    """Largest distance between points and others, after the similarity that moves them closest."""
    a, b = points - points.mean(0), wanted - wanted.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation, scale = u @ np.diag(signs) @ vt, (s * signs).sum() / np.square(a).sum()
    return np.linalg.norm(b - scale * a @ rotation.T, axis=1).max()


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
    assert found.parts[0] == tuple(sorted(found.names)) and 0 < found.reprojection_error < 0.5
    assert alike(capture.camtoworlds[:, :3, 3], wanted[:, :3, 3]) < 0.02 * np.ptp(wanted[:, :3, 3], axis=0).max()
    turned = [np.einsum("ji,vjk->vik", poses[0, :3, :3], poses[:, :3, :3]) for poses in (capture.camtoworlds, wanted)]
    np.testing.assert_allclose(turned[0], turned[1], atol=0.02)  # radians since the first picture
    np.testing.assert_allclose(capture.K(0), K, atol=0.03 * FOCAL)
    assert capture.K(0)[0, 0] == capture.K(0)[1, 1]  # too few images for two focal lengths


def test_both_files_hold_the_same_cameras(estimated, tmp_path):
    """Read by another reader, COLMAP's files give the cameras and lens of transforms.json."""
    out, _ = estimated
    shutil.copytree(out / "images", tmp_path / "images")
    shutil.copytree(out / "sparse", tmp_path / "sparse")
    ours, colmap = open_capture(out), open_capture(tmp_path)
    assert (ours.format, colmap.format) == ("transforms.json", "COLMAP")
    np.testing.assert_allclose(ours.camtoworlds, colmap.camtoworlds, atol=1e-9)
    np.testing.assert_allclose(ours.K(3), colmap.K(3), rtol=1e-12)
    assert ours.frames[0].lens == colmap.frames[0].lens
    assert len({frame.K.tobytes() for frame in ours.frames}) == 1  # one camera


def test_a_finished_call_does_nothing_again(photos, estimated, monkeypatch):
    out, found = estimated
    files = {file: file.stat().st_mtime_ns for file in out.rglob("*") if file.is_file()}
    monkeypatch.setattr(sfm, "extract_features", None)
    assert estimate(photos, out) == found
    assert files == {file: file.stat().st_mtime_ns for file in out.rglob("*") if file.is_file()}


def test_a_stopped_call_continues(photos, estimated, tmp_path, monkeypatch):
    """Stopped among the matches, a second call keeps images, features and matches, and ends with the same cameras."""
    out, calls = tmp_path / "capture", []
    advance_of = sfm.match_pairs

    def stop(space, pairs, advance):
        advance_of(space, pairs[:20], advance)
        raise KeyboardInterrupt

    monkeypatch.setattr(sfm, "match_pairs", stop)
    with pytest.raises(KeyboardInterrupt):
        estimate(photos, out)
    assert not (out / "transforms.json").exists() and (out / "images").is_dir()
    monkeypatch.setattr(sfm, "match_pairs", advance_of)
    with sfm.require("pycolmap").Database.open(out / "database.db") as database:
        kept = {i.name: database.num_keypoints_for_image(i.image_id) for i in database.read_all_images()}
    original = sfm._cancellable
    monkeypatch.setattr(sfm, "_cancellable", lambda f, *a, **k: calls.append(f.__name__) or original(f, *a, **k))
    found = estimate(photos, out)
    assert len(kept) == NUM_PHOTOS and min(kept.values()) > 50
    assert "incremental_mapping" in calls
    assert found.parts == estimated[1].parts
    np.testing.assert_allclose(
        open_capture(out).camtoworlds[:, :3, :3], open_capture(estimated[0]).camtoworlds[:, :3, :3], atol=0.02
    )


def test_a_folder_belongs_to_one_call(photos, estimated, tmp_path):
    out, _ = estimated
    with pytest.raises(InputError, match=r"another call \(max_side\).*--overwrite"):
        estimate(photos, out, max_side=100)
    with pytest.raises(InputError, match="outside the photos"):
        estimate(photos, photos / "capture")
    (tmp_path / "images").mkdir()
    with pytest.raises(InputError, match="images of another maker"):
        estimate(photos, tmp_path)
    (tmp_path / "poses.json").write_text("{")
    with pytest.raises(InputError, match=r"poses\.json.*damaged.*another --out"):
        estimate(photos, tmp_path)


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_source_inside_the_results_is_refused_and_stays(overwrite, tmp_path):
    """Images of an earlier call, which --overwrite would remove, may be the only copy of a video's frames."""
    (tmp_path / "images").mkdir()
    write_json(tmp_path / "poses.json", {"request": {}})
    for i, picture in enumerate(pictures(walk(2))):
        Image.fromarray(picture).save(tmp_path / "images" / f"{i}.png")
    with pytest.raises(InputError, match="wanted a folder that does not hold the photos"):
        estimate(tmp_path / "images", tmp_path, overwrite)
    assert len(list((tmp_path / "images").iterdir())) == 2


def test_pictures_without_overlap_are_refused_and_leave_no_capture(tmp_path):
    rng = np.random.default_rng(0)
    (tmp_path / "in").mkdir()
    for i in range(4):
        Image.fromarray(rng.integers(0, 255, (60, 80, 3), dtype=np.uint8)).save(tmp_path / "in" / f"{i}.png")
    with pytest.raises(InputError, match=r"got 0 of 4; take pictures"):
        estimate(tmp_path / "in", tmp_path / "out")
    assert not (tmp_path / "out" / "transforms.json").exists()
    with pytest.raises(InputError, match=r"got 0 of 4"):  # and again, from what is there
        estimate(tmp_path / "in", tmp_path / "out")
    assert json.loads((tmp_path / "out" / "poses.json").read_text())["names"] == [f"{i}.png" for i in range(4)]


def test_sources_that_hold_no_pictures_are_refused(tmp_path):
    (tmp_path / "clip.mp4").write_bytes(b"no video")
    (tmp_path / "notes.txt").write_text("")
    for name, words in [
        ("clip.mp4", "cannot be decoded"),
        ("notes.txt", "'notes.txt'"),
        ("nowhere", "nothing of that name"),
        (".", "fewer than two images"),
    ]:
        with pytest.raises(InputError, match=words):
            estimate(tmp_path / name, tmp_path.parent / f"{tmp_path.name}-out")
    assert not (tmp_path.parent / f"{tmp_path.name}-out").exists()


def test_missing_packages_are_named_with_the_command(photos, tmp_path, monkeypatch):
    monkeypatch.setattr(requirements.importlib, "import_module", lambda name: exec("raise ImportError"))
    with pytest.raises(InputError, match=r'pycolmap.*not installed; run: pip install -e "\.\[poses\]"'):
        estimate(photos, tmp_path / "out")
    assert not Path(tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["sparse/0/cameras.txt", "transforms.json", "database.db", "images/1.png"])
def test_files_of_another_maker_are_left_alone(name, photos, tmp_path):
    held = tmp_path / "capture" / name
    held.parent.mkdir(parents=True)
    held.write_text("mine")
    for overwrite in (False, True):
        with pytest.raises(InputError, match="of another maker"):
            estimate(photos, tmp_path / "capture", overwrite)
    assert held.read_text() == "mine"


@pytest.mark.parametrize("text", ['{"poses": []}', "[1]", '{"request": "mine"}', "no JSON"])
def test_overwrite_removes_nothing_of_another_maker(text, photos, tmp_path):
    (tmp_path / "images").mkdir()
    for name in ("poses.json", "transforms.json", "images/1.png"):
        (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=r"poses\.json.*of another maker.*another --out"):
        estimate(photos, tmp_path, overwrite=True)
    for name in ("poses.json", "transforms.json", "images/1.png"):
        assert (tmp_path / name).read_text() == text


def test_other_pixels_in_as_many_bytes_are_another_request(tmp_path):
    Image.new("RGB", (40, 30), (10, 20, 30)).save(tmp_path / "1.bmp")
    Image.new("RGB", (40, 30)).save(tmp_path / "2.bmp")
    before, size = _request(tmp_path, PoseOptions()), (tmp_path / "1.bmp").stat().st_size
    assert _request(tmp_path, PoseOptions()) == before
    Image.new("RGB", (40, 30), (10, 20, 31)).save(tmp_path / "1.bmp")
    assert (tmp_path / "1.bmp").stat().st_size == size
    after = _request(tmp_path, PoseOptions())
    assert [name for name in before if after[name] != before[name]] == ["digest"]


def test_a_call_killed_among_its_images_continues(photos, estimated, tmp_path, monkeypatch):
    killed = tmp_path / "capture"
    with monkeypatch.context() as patched:
        patched.setattr("ssplat_jax.poses.estimate.write_json", _only_once(write_json))
        with pytest.raises(MemoryError):
            estimate(photos, killed)
    assert (killed / "images").is_dir()
    found, wanted = estimate(photos, killed), estimated[1]
    assert (found.names, found.parts) == (wanted.names, wanted.parts)
    assert found.num_points == pytest.approx(wanted.num_points, rel=0.05)  # COLMAP's threads decide about a few


def _only_once(function):
    """`function`, which the second time ends as a kill does: nothing after it happens."""
    calls = iter((function,))

    def call(*arguments):
        try:
            next(calls)(*arguments)
        except StopIteration:
            raise MemoryError from None

    return call


def test_a_source_without_images_leaves_no_record(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError):
        estimate(tmp_path / "empty", tmp_path / "capture")
    assert not (tmp_path / "capture" / "poses.json").exists()
