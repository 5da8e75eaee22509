"""`estimate_poses`: a video or a folder of photos becomes a capture, step by step; a stopped call is continued.

source -> gather_images -> images/ -> sfm (features, matching, mapping, refinement) -> transforms.json, sparse/

The folder of the capture also holds COLMAP's `database.db`, and `poses.json` with what was asked for, the images, and
the findings once there are any.
"""

import dataclasses
import hashlib
import json
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import InputError, echo, optional_package, reading, refusal
from ssplat_jax.data.open_capture import VIDEO_SUFFIXES
from ssplat_jax.poses import gather_images
from ssplat_jax.storage.files import write_json
from ssplat_jax.storage.run_folder import lock_folder

RECORD = "poses.json"
OWN_FOLDERS = ("images", "sparse")
OWN_FILES = (RECORD, "transforms.json", "database.db", "database.db-shm", "database.db-wal", "database.pairs.txt")
MIN_READ_SHARE = 0.95  # of the announced frames of a video; below it a warning says that it could not be read
MIN_REGISTERED, MIN_SHARE = 4, 0.25  # images, one chunk, and share of them; fewer registered ones are no result
GOOD_SHARE, GOOD_ERROR = 0.9, 1.5  # of the images, and pixels: what is worse is explained
MOST_NAMED = 6  # images without a pose that a line names


@dataclasses.dataclass(frozen=True)
class PoseOptions:
    """Settings of the pose estimation."""

    max_frames: int = 120  # chosen from a video
    max_side: int = 1600  # pixels: larger images are reduced
    is_fisheye: bool = False  # equidistant lens (COLMAP's OPENCV_FISHEYE) instead of a perspective one


@dataclasses.dataclass(frozen=True)
class Findings:
    """Contents of a reconstruction."""

    names: Sequence[str]  # of all images, in order
    registered: Sequence[str]  # of those that have a pose
    reprojection_error: float  # pixels, median over the points
    num_points: int

    def sentences(self) -> list[str]:
        """Findings, the most important first, and remedies."""
        error = f"median reprojection error {self.reprojection_error:.1f} px"
        lines = [f"registered {len(self.registered)} of {len(self.names)} images, {error}, {self.num_points:,} points"]
        if missing := [name for name in self.names if name not in self.registered]:
            more = f" and {len(missing) - MOST_NAMED} more" if len(missing) > MOST_NAMED else ""
            lines.append(f"without a pose: {', '.join(missing[:MOST_NAMED])}{more}")
        if len(self.registered) < GOOD_SHARE * len(self.names):
            lines.append(
                "to register more: move slowly and sideways, let neighboring pictures overlap by two thirds, keep"
                " textured surfaces in sight; blank walls, reflections and turning on the spot give no poses"
            )
        if self.reprojection_error > GOOD_ERROR:
            lines.append("the error is large: moving things, motion blur, or a fish-eye lens (then: --fisheye)")
        return lines


def estimate_poses(source: Path, out: Path, options: PoseOptions, overwrite: bool, reporter: Reporter) -> Findings:
    """Estimates the poses of a video's frames or of photos, and writes them with the images to `out`.

    What an earlier call with the same arguments has finished in `out` is kept, unless `overwrite` asks to start anew.

    Raises:
        InputError: a package is missing, `source` is unusable, `out` holds something else, or too few images could be
            registered.
        StorageError: `out` cannot be written.
    """
    optional_package("pycolmap", "poses")
    request = _request(source, options)
    _check_out(source, out)
    with lock_folder(out):
        record = _held_record(out)
        if overwrite and record:
            for name in OWN_FOLDERS:
                shutil.rmtree(out / name, ignore_errors=True)
            for name in OWN_FILES:
                (out / name).unlink(missing_ok=True)
            record = {}
        if record and record["request"] != request:
            changed = ", ".join(name for name in request if record["request"].get(name) != request[name])
            fix = "repeat it, start anew with --overwrite, or choose another --out"
            raise refusal(str(out), wanted="a folder of this call", got=f"one of another call ({changed})", fix=fix)
        record = record or {"request": request}
        if "names" not in record:
            write_json(out / RECORD, record)  # first: the images of a call that is killed are known as its own
            record["names"] = _gather(source, out, options, reporter)
            write_json(out / RECORD, record)
        if "findings" not in record:
            record["findings"] = dataclasses.asdict(_reconstruct(out, record["names"], source, options, reporter))
            write_json(out / RECORD, record)
    return Findings(**record["findings"])


def _request(source: Path, options: PoseOptions) -> dict[str, Any]:
    """Source and options of a call, as JSON types: two calls of the same request have the same result."""
    if source.is_dir():
        files = gather_images.list_photos(source)
    elif source.exists() and source.suffix.lower() in VIDEO_SUFFIXES:
        files = [source]
    else:
        got = echo(source.name) if source.exists() else "nothing of that name"
        fix = f"give a folder, or a video file ({', '.join(sorted(VIDEO_SUFFIXES))})"
        raise refusal(str(source), wanted="a video or a folder of photos", got=got, fix=fix)
    digest = hashlib.sha256()
    for file in files:
        with file.open("rb") as stream:
            content = hashlib.file_digest(stream, "sha256").hexdigest()
        digest.update(json.dumps([file.name, content]).encode())
    return {"source": source.name, "digest": digest.hexdigest()[:12], **dataclasses.asdict(options)}


def _check_out(source: Path, out: Path) -> None:
    """Checks that the results do not mix with the photos, nor with files of another maker."""
    folder, place = out.resolve(), source.resolve()
    held = [name for name in (*OWN_FOLDERS, *OWN_FILES) if (folder / name).exists()]
    if source.is_dir() and (folder == place or folder.is_relative_to(place)):
        wanted, got = "a folder outside the photos", "the folder of the photos"
    elif any(place.is_relative_to(folder / name) for name in OWN_FOLDERS):  # --overwrite would remove the source
        wanted, got = "a folder that does not hold the photos", "one that does"
    elif held and not (folder / RECORD).exists():
        wanted, got = "a new folder", f"one that holds {', '.join(held)} of another maker"
    else:
        return
    raise refusal(f"--out {out}", wanted=wanted, got=got, fix="choose another --out")


def _held_record(out: Path) -> dict[str, Any]:
    """The record of an earlier call; empty if there was none. The images of another maker must not be removed."""
    with reading(out / RECORD, "it is of another maker or damaged: choose another --out, or remove the folder"):
        record = json.loads((out / RECORD).read_text()) if (out / RECORD).exists() else {}
        if record and not isinstance(record["request"], dict):
            raise TypeError("no record of an earlier call")
    return record


def _gather(source: Path, out: Path, options: PoseOptions, reporter: Reporter) -> list[str]:
    """Fills `out/images`, anew if another call was killed meanwhile, and returns the names of the images."""
    folder = out / "images"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    try:
        if not source.is_dir():
            return _choose_from_video(source, folder, options, reporter)
        photos = gather_images.list_photos(source)
        with reporter.progress("photos", len(photos), waiting="") as advance:
            return gather_images.copy_photos(photos, folder, options.max_side, advance)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        (out / RECORD).unlink(missing_ok=True)
        raise


def _choose_from_video(source: Path, folder: Path, options: PoseOptions, reporter: Reporter) -> list[str]:
    announced = gather_images.count_frames(source)
    with reporter.progress("looking at the video", announced, waiting="") as advance:
        motion, sharpnesses = gather_images.scan_video(source, advance)
    if len(motion) < MIN_READ_SHARE * announced:
        reporter.warn(
            f"{source}: {len(motion)} of about {announced} frames can be read; the rest is left out. If the video plays"
            " to its end, convert it with `ffmpeg -i INPUT output.mp4`"
        )
    chosen = gather_images.choose_frames(motion, sharpnesses, options.max_frames)
    with reporter.progress("frames", len(chosen), waiting="") as advance:
        return gather_images.write_frames(source, chosen.tolist(), folder, options.max_side, advance)


def _reconstruct(out: Path, names: list[str], source: Path, options: PoseOptions, reporter: Reporter) -> Findings:
    """Runs structure from motion and writes the capture's files."""
    from ssplat_jax.poses import sfm  # imports pycolmap

    sfm.quiet_colmap()
    # A camera has one focal length at first: with two, a straight path would leave their ratio open.
    camera = "RADIAL_FISHEYE" if options.is_fisheye else "RADIAL"
    space = sfm.Workspace(out / "images", out / "database.db", names, camera)
    with reporter.progress("features", len(names), waiting="") as advance:
        sfm.extract_features(space, advance)
    pairs = sfm.pairs_to_match(space, is_video=not source.is_dir())
    with reporter.progress("matching", len(pairs), waiting="") as advance:
        sfm.match_pairs(space, pairs, advance)
    with tempfile.TemporaryDirectory() as scratch, reporter.progress("poses", len(names), waiting="") as advance:
        model = sfm.map_images(space, Path(scratch), advance)
    images = [] if model is None else model.images.values()
    registered = sorted(image.name for image in images if image.has_pose)
    if model is None or len(registered) < max(MIN_REGISTERED, MIN_SHARE * len(names)):
        got = f"{len(registered)} of {len(names)}"
        raise InputError(
            f"{source}: wanted poses of most images, got {got}; take pictures of a scene that stands still, with two"
            " thirds of overlap between neighbors, moving sideways past textured surfaces, not turning on the spot."
        )
    errors = [point.error for point in model.points3D.values()]
    sfm.write_capture(out, model)
    return Findings(names, registered, float(np.median(errors)) if errors else 0.0, len(errors))
