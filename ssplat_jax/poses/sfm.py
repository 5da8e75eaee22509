"""Structure from motion by COLMAP (`pycolmap`): features, matching, mapping and refinement, with one database.

Everything that a step has finished is in the database, so that a step that was stopped goes on where it was. Seeds are
fixed. COLMAP works on a thread of its own, and Ctrl-C cancels it.
"""

import copy
import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from ssplat_jax.data.images import image_size
from ssplat_jax.poses.pairs import Pair
from ssplat_jax.poses.requirements import require

SEED = 0
MIN_FREE_IMAGES = 20  # registered images from which on all of a camera's parameters are adjusted
MAX_CENTER_SHIFT = 0.1  # of a side; an adjusted principal point farther from the center is not believed
MAX_ASPECT = 0.02  # deviation of fx / fy from 1 above which an adjusted camera is not believed
IMAGES_PER_CALL, PAIRS_PER_CALL = 4, 100  # between two steps of the progress bar

Advance = Callable[[int], None]


@dataclasses.dataclass(frozen=True)
class Workspace:
    """Images and database of one reconstruction."""

    images: Path  # folder
    names: tuple[str, ...]  # of the images, in order
    database: Path
    is_fisheye: bool


def quiet_colmap() -> None:
    """Keeps COLMAP's log off the terminal and off the disk; errors come as exceptions."""
    logging = require("pycolmap").logging
    logging.logtostderr, logging.alsologtostderr = False, False
    logging.minloglevel = logging.stderrthreshold = int(logging.Level.FATAL)


def extract_features(space: Workspace, advance: Advance) -> None:
    """Finds the features of all images; images of one size share one camera.

    Args:
        space: images and database.
        advance: called with the number of images so far.
    """
    pycolmap = require("pycolmap")
    _list_images(space)
    for k in range(0, len(space.names), IMAGES_PER_CALL):
        some = list(space.names[k : k + IMAGES_PER_CALL])
        _cancellable(pycolmap.extract_features, space.database, space.images, image_names=some)
        advance(k + len(some))


def _list_images(space: Workspace) -> None:
    """Enters the images into the database, in order: their numbers do not depend on which thread is done first."""
    pycolmap = require("pycolmap")
    with pycolmap.Database.open(space.database) as database:
        known = {image.name: image.camera_id for image in database.read_all_images()}
    groups: dict[tuple[int, int], list[str]] = {}
    for name in space.names:
        groups.setdefault(image_size(space.images / name), []).append(name)
    for names in groups.values():
        # A camera has one focal length at first: with two, a straight path would leave their ratio open.
        options = pycolmap.ImageReaderOptions(camera_model="RADIAL_FISHEYE" if space.is_fisheye else "RADIAL")
        options.existing_camera_id = next((known[name] for name in names if name in known), -1)
        new = [name for name in names if name not in known]
        if new:
            pycolmap.import_images(space.database, space.images, pycolmap.CameraMode.SINGLE, new, options)


def read_descriptors(space: Workspace) -> list[Float32[np.ndarray, "_ c"]]:
    """Descriptors of the features of each image, in the order of `space.names`."""
    with require("pycolmap").Database.open(space.database) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        return [_rows(database.read_descriptors(ids[name])) for name in space.names]


def _rows(descriptors: Any) -> Float32[np.ndarray, "_ c"]:
    return np.asarray(getattr(descriptors, "data", descriptors), np.float32).reshape(-1, 128)


def match_pairs(space: Workspace, pairs: Sequence[Pair], advance: Advance) -> None:
    """Matches pairs of images and verifies the matches; pairs that the database holds are not matched again.

    Args:
        space: images and database.
        pairs: indices of `space.names`.
        advance: called with the number of pairs so far.
    """
    pycolmap = require("pycolmap")
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    pairs_file = space.database.with_suffix(".pairs.txt")
    for k in range(0, len(pairs), PAIRS_PER_CALL):
        some = pairs[k : k + PAIRS_PER_CALL]
        pairs_file.write_text("".join(f"{space.names[i]} {space.names[j]}\n" for i, j in some))
        _cancellable(
            pycolmap.match_image_pairs,
            space.database,
            pairing_options=pycolmap.ImportedPairingOptions(match_list_path=str(pairs_file)),
            verification_options=verification,
        )
        advance(k + len(some))
    pairs_file.unlink(missing_ok=True)


def map_images(space: Workspace, scratch: Path, advance: Advance) -> list[Any]:
    """Estimates poses, intrinsics and points.

    Args:
        space: images and database.
        scratch: existing empty folder for COLMAP's files.
        advance: called with the number of images registered so far.

    Returns:
        `pycolmap.Reconstruction`s that share no frame of reference, that with the most images first.
    """
    pycolmap = require("pycolmap")
    options = pycolmap.IncrementalPipelineOptions(random_seed=SEED)
    options.mapper.random_seed = options.triangulation.random_seed = SEED
    registered = [0]

    def count(added: int) -> None:
        registered[0] += added
        advance(min(registered[0], len(space.names)))  # smaller models may share images with larger ones

    found = _cancellable(
        pycolmap.incremental_mapping,
        space.database,
        space.images,
        scratch,
        options=options,
        initial_image_pair_callback=lambda: count(2),
        next_image_callback=lambda: count(1),
    )
    return [_refined(model) for model in sorted(found.values(), key=lambda model: -model.num_reg_images())]


def _refined(model: Any) -> Any:
    """The model with OpenCV's cameras, all parameters of which are adjusted if they come out plausible."""
    pycolmap = require("pycolmap")
    for camera in model.cameras.values():
        f, cx, cy, k1, k2 = camera.params
        is_fisheye = camera.model == pycolmap.CameraModelId.RADIAL_FISHEYE
        camera.model = pycolmap.CameraModelId.OPENCV_FISHEYE if is_fisheye else pycolmap.CameraModelId.OPENCV
        camera.params = [f, f, cx, cy, k1, k2, 0.0, 0.0]
    if model.num_reg_images() >= MIN_FREE_IMAGES:
        free = copy.deepcopy(model)
        _adjust(free)
        if all(is_plausible(camera) for camera in free.cameras.values()):
            model = free
    model.update_point_3d_errors()
    return model


def _adjust(model: Any) -> None:
    """Bundle adjustment of all poses, points and cameras, with free principal points."""
    pycolmap = require("pycolmap")
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, print_summary=False)
    config = pycolmap.BundleAdjustmentConfig()
    for key in model.reg_image_ids():
        config.add_image(key)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def is_plausible(camera: Any) -> bool:
    """True if a camera has nearly square pixels and its principal point near the center of its images."""
    x, y = camera.principal_point_x / camera.width - 0.5, camera.principal_point_y / camera.height - 0.5
    aspect = camera.focal_length_x / camera.focal_length_y
    return max(abs(x), abs(y)) <= MAX_CENTER_SHIFT and abs(aspect - 1) <= MAX_ASPECT


def _cancellable(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Calls a function of COLMAP on another thread; an exception in this one, such as Ctrl-C, cancels it."""
    pycolmap = require("pycolmap")
    token = pycolmap.CancellationToken()

    def work() -> Any:
        pycolmap.set_random_seed(SEED)  # of this thread
        return function(*args, **kwargs, cancellation_token=token)

    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(work)
        try:
            return done.result()
        except BaseException:
            token.cancel()
            raise
