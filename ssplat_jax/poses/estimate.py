"""`estimate_poses`: a video or a folder of photos becomes a capture, step by step; a stopped call is continued.

The folder of the capture holds `images/`, `transforms.json`, `sparse/`, COLMAP's `database.db`, and `poses.json` with
what was asked for, the images, and the findings once there are any.
"""

import dataclasses
import hashlib
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ssplat_jax.core.console import Reporter
from ssplat_jax.core.errors import echo, refusal
from ssplat_jax.data.open_capture import VIDEO_SUFFIXES
from ssplat_jax.poses import sfm
from ssplat_jax.poses.capture_files import write_sparse, write_transforms
from ssplat_jax.poses.frame_choice import choose_frames
from ssplat_jax.poses.pairs import (
    MAX_EXHAUSTIVE,
    NUM_ALIKE_PHOTOS,
    NUM_ALIKE_VIDEO,
    Pair,
    alike_pairs,
    all_pairs,
    neighbor_pairs,
)
from ssplat_jax.poses.photos import copy_photos, list_photos
from ssplat_jax.poses.requirements import require
from ssplat_jax.poses.verdict import Findings, check_registered
from ssplat_jax.poses.video import count_frames, scan_video, write_frames
from ssplat_jax.storage.files import write_json
from ssplat_jax.storage.run_folder import lock_folder

RECORD = "poses.json"
MIN_READ_SHARE = 0.95
"""Share of the announced frames of a video below which a warning says that it could not be read to its end."""
OWN_FOLDERS = ("images", "images.partial", "sparse", "sparse.partial")
OWN_FILES = (RECORD, "transforms.json", "database.db", "database.db-shm", "database.db-wal", "database.pairs.txt")


@dataclasses.dataclass(frozen=True)
class PoseOptions:
    """Settings of the pose estimation."""

    max_frames: int = 120  # chosen from a video
    max_side: int = 1600  # pixels: larger images are reduced
    is_fisheye: bool = False  # equidistant lens (COLMAP's OPENCV_FISHEYE) instead of a perspective one


def estimate_poses(source: Path, out: Path, options: PoseOptions, overwrite: bool, reporter: Reporter) -> Findings:
    """Estimates the poses of a video's frames or of photos, and writes them with the images to `out`.

    Args:
        source: a video, or a folder of photos.
        out: folder of the capture; what an earlier call with the same arguments has finished there is kept.
        options: how poses are estimated.
        overwrite: remove what an earlier call has left in `out` and start anew.
        reporter: shows progress.

    Returns:
        What was found.

    Raises:
        InputError: a package is missing, `source` is unusable, `out` holds something else, or too few images could be
            registered.
        StorageError: `out` cannot be written.
    """
    require("pycolmap")
    request = _request(source, options)
    _check_out(source, out)
    with lock_folder(out):
        if overwrite and (out / RECORD).exists():
            _held_record(out)  # refuses a file of another maker
            _clear(out)
        record = _read_record(out, request) or {"request": request}
        if "names" not in record:
            write_json(out / RECORD, record)  # first: the images of a call that is killed are known as its own
            record["names"] = _gather_images(source, out, options, reporter)
            write_json(out / RECORD, record)
        if "findings" not in record:
            record["findings"] = dataclasses.asdict(_reconstruct(out, record["names"], source, options, reporter))
            write_json(out / RECORD, record)
    fields = record["findings"]
    return Findings(
        names=tuple(fields["names"]),
        parts=tuple(tuple(part) for part in fields["parts"]),
        reprojection_error=fields["reprojection_error"],
        num_points=fields["num_points"],
    )


def _request(source: Path, options: PoseOptions) -> dict[str, Any]:
    """Source and options of a call, as JSON types: two calls of the same request have the same result."""
    if not source.exists():
        raise refusal(str(source), wanted="a video or a folder of photos", got="nothing of that name", fix="check it")
    if source.is_dir():
        files = list_photos(source)
    elif source.suffix.lower() in VIDEO_SUFFIXES:
        files = [source]
    else:
        fix = f"give a folder, or a video file ({', '.join(sorted(VIDEO_SUFFIXES))})"
        raise refusal(str(source), wanted="a video or a folder of photos", got=echo(source.name), fix=fix)
    digest = hashlib.sha256()
    for file in files:
        with file.open("rb") as stream:
            content = hashlib.file_digest(stream, "sha256").hexdigest()
        digest.update(json.dumps([file.name, content]).encode())
    return {"source": source.name, "digest": digest.hexdigest()[:12], **dataclasses.asdict(options)}


def _check_out(source: Path, out: Path) -> None:
    """Checks that the results do not mix with the photos."""
    folder, place = out.resolve(), source.resolve()
    if source.is_dir() and (folder == place or folder.is_relative_to(place)):
        fix = "choose a folder beside it"
        raise refusal(f"--out {out}", wanted="a folder outside the photos", got="the folder of the photos", fix=fix)
    if any(place.is_relative_to(folder / name) for name in OWN_FOLDERS):  # `_clear` would remove the source
        fix = "choose another folder"
        raise refusal(f"--out {out}", wanted="a folder that does not hold the photos", got="one that does", fix=fix)
    held = [name for name in (*OWN_FOLDERS, *OWN_FILES) if (folder / name).exists()]
    if held and not (folder / RECORD).exists():
        got, fix = f"one that holds {', '.join(held)} of another maker", "choose another --out"
        raise refusal(f"--out {out}", wanted="a new folder", got=got, fix=fix)


def _clear(out: Path) -> None:
    """Removes what an earlier call has written."""
    for name in OWN_FOLDERS:
        shutil.rmtree(out / name, ignore_errors=True)
    for name in OWN_FILES:
        (out / name).unlink(missing_ok=True)


def _read_record(out: Path, request: dict[str, Any]) -> dict[str, Any] | None:
    """Result of an earlier call with the same request, or None."""
    if not (out / RECORD).exists():
        return None
    record = _held_record(out)
    held = record["request"]
    if held != request:
        changed = ", ".join(name for name in request if held.get(name) != request[name])
        fix = "repeat it, start anew with --overwrite, or choose another --out"
        raise refusal(str(out), wanted="a folder of this call", got=f"one of another call ({changed})", fix=fix)
    return record


def _held_record(out: Path) -> dict[str, Any]:
    """The record of an earlier call.

    Raises:
        InputError: the file of that name is of another maker, whose images must not be removed.
    """
    file = out / RECORD
    try:
        record = json.loads(file.read_text())
        if not isinstance(record["request"], dict):
            raise TypeError
    except (ValueError, KeyError, TypeError):
        got, fix = "a file of another maker, or a damaged one", "choose another --out, or remove the folder"
        raise refusal(str(file), wanted="the record of an earlier call", got=got, fix=fix) from None
    return record


def _gather_images(source: Path, out: Path, options: PoseOptions, reporter: Reporter) -> list[str]:
    """Fills `out/images`, which appears when it is complete, and returns the names of the images."""
    partial = out / "images.partial"
    shutil.rmtree(partial, ignore_errors=True)
    shutil.rmtree(out / "images", ignore_errors=True)  # of a call that was killed before its record
    partial.mkdir()
    try:
        names = (_copy_photos if source.is_dir() else _choose_from_video)(source, partial, options, reporter)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        (out / RECORD).unlink(missing_ok=True)
        raise
    partial.rename(out / "images")
    return names


def _copy_photos(source: Path, folder: Path, options: PoseOptions, reporter: Reporter) -> list[str]:
    photos = list_photos(source)
    with reporter.progress("photos", len(photos), waiting="") as advance:
        return copy_photos(photos, folder, options.max_side, advance)


def _choose_from_video(source: Path, folder: Path, options: PoseOptions, reporter: Reporter) -> list[str]:
    announced = count_frames(source)
    with reporter.progress("looking at the video", announced, waiting="") as advance:
        scan = scan_video(source, advance)
    if (found := len(scan.motion)) < MIN_READ_SHARE * announced:
        reporter.warn(
            f"{source}: {found} of about {announced} frames can be read; the rest is left out. If the video plays to"
            " its end, convert it with `ffmpeg -i INPUT output.mp4`"
        )
    chosen = choose_frames(scan.motion, scan.sharpnesses, options.max_frames)
    with reporter.progress("frames", len(chosen), waiting="") as advance:
        return write_frames(source, chosen.tolist(), folder, options.max_side, advance)


def _reconstruct(out: Path, names: list[str], source: Path, options: PoseOptions, reporter: Reporter) -> Findings:
    """Runs structure from motion and writes the capture's files."""
    sfm.quiet_colmap()
    space = sfm.Workspace(out / "images", tuple(names), out / "database.db", options.is_fisheye)
    with reporter.progress("features", len(names), waiting="") as advance:
        sfm.extract_features(space, advance)
    pairs = _pairs(space, is_video=not source.is_dir())
    with reporter.progress("matching", len(pairs), waiting="") as advance:
        sfm.match_pairs(space, pairs, advance)
    with tempfile.TemporaryDirectory() as scratch, reporter.progress("poses", len(names), waiting="") as advance:
        models = sfm.map_images(space, Path(scratch), advance)
    found = findings(names, models)
    check_registered(found, str(source))
    write_sparse(out, models)
    write_transforms(out, models[0])
    return found


def _pairs(space: sfm.Workspace, *, is_video: bool) -> list[Pair]:
    """Pairs of images to match."""
    num = len(space.names)
    if not is_video and num <= MAX_EXHAUSTIVE:
        return all_pairs(num)
    alike = alike_pairs(sfm.read_descriptors(space), NUM_ALIKE_VIDEO if is_video else NUM_ALIKE_PHOTOS)
    return sorted({*neighbor_pairs(num), *alike})


def findings(names: list[str], models: list[Any]) -> Findings:
    """Contents of the reconstructions of the images `names`."""
    parts = tuple(tuple(sorted(i.name for i in model.images.values() if i.has_pose)) for model in models)
    errors = [point.error for point in models[0].points3D.values()] if models else []
    error = float(np.median(errors)) if errors else 0.0
    return Findings(tuple(names), parts, error, len(errors))
