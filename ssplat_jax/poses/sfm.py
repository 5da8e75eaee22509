"""Structure from motion by COLMAP (`pycolmap`, extra `poses`): features, pairs, matches, mapping, and the files of it.

Everything that a step has finished is in the database, so that a step that was stopped goes on where it was. Seeds are
fixed. COLMAP works on a thread of its own, and Ctrl-C cancels it.
"""

import copy
import dataclasses
import itertools
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float32
from scipy.cluster.vq import kmeans, vq

from ssplat_jax.data.images import image_size
from ssplat_jax.data.posed_image import OPENGL_TO_OPENCV, invert_pose
from ssplat_jax.storage.files import write_json

SEED = 0
MIN_FREE_IMAGES = 20  # registered images from which on all of a camera's parameters are adjusted
MAX_CENTER_SHIFT = 0.1  # of a side; an adjusted principal point farther from the center is not believed
MAX_ASPECT = 0.02  # deviation of fx / fy from 1 above which an adjusted camera is not believed
IMAGES_PER_CALL, PAIRS_PER_CALL = 4, 100  # between two steps of the progress bar
MAX_EXHAUSTIVE = 100  # images of which all pairs are matched
OVERLAP = 8  # following images that an image of a video is matched with, and those 16, 32, ... after it
NUM_ALIKE_VIDEO, NUM_ALIKE_PHOTOS = 5, 25  # images that look alike, per image, that are matched as well
VOCABULARY = 64  # words
MAX_SAMPLES = 400  # descriptors per image that are used
LENS_PARAMETERS = {"OPENCV": ("k1", "k2", "p1", "p2"), "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4")}

Advance = Callable[[int], None]
Pair = tuple[int, int]  # indices of two images, the smaller one first


@dataclasses.dataclass(frozen=True)
class Workspace:
    """Images and database of one reconstruction."""

    images: Path  # folder
    database: Path
    names: Sequence[str]  # of the images, in order
    camera: str  # COLMAP's camera model

    def ids(self) -> dict[str, tuple[int, int]]:
        """Numbers of the image and of its camera, by name."""
        with pycolmap.Database.open(self.database) as database:
            return {image.name: (image.image_id, image.camera_id) for image in database.read_all_images()}


def quiet_colmap() -> None:
    """Keeps COLMAP's log off the terminal and off the disk; errors come as exceptions."""
    logging: Any = pycolmap.logging
    logging.logtostderr, logging.alsologtostderr = False, False
    logging.minloglevel = logging.stderrthreshold = int(logging.Level.FATAL)


def extract_features(space: Workspace, advance: Advance) -> None:
    """Finds the features of all images; those of one size share a camera."""
    # The images are entered first, in order: their numbers do not depend on which thread is done first.
    known, groups = space.ids(), {}
    for name in space.names:
        groups.setdefault(image_size(space.images / name), []).append(name)
    for names in groups.values():
        options = pycolmap.ImageReaderOptions(camera_model=space.camera)
        options.existing_camera_id = next((known[name][1] for name in names if name in known), -1)
        if new := [name for name in names if name not in known]:
            pycolmap.import_images(space.database, space.images, pycolmap.CameraMode.SINGLE, new, options)
    for k in range(0, len(space.names), IMAGES_PER_CALL):
        some = list(space.names[k : k + IMAGES_PER_CALL])
        _cancellable(pycolmap.extract_features, space.database, space.images, image_names=some)
        advance(k + len(some))


def pairs_to_match(space: Workspace, *, is_video: bool) -> list[Pair]:
    """All pairs of a small set of photos; else neighbors in time, and images that look alike, which close loops."""
    num = len(space.names)
    if not is_video and num <= MAX_EXHAUSTIVE:
        return list(itertools.combinations(range(num), 2))
    ids = space.ids()
    with pycolmap.Database.open(space.database) as database:
        found = [database.read_descriptors(ids[name][0]) for name in space.names]
    descriptors = [np.asarray(getattr(rows, "data", rows), np.float32).reshape(-1, 128) for rows in found]
    return sorted({*neighbor_pairs(num), *alike_pairs(descriptors, NUM_ALIKE_VIDEO if is_video else NUM_ALIKE_PHOTOS)})


def neighbor_pairs(num_images: int) -> list[Pair]:
    """Each image with the `OVERLAP` images that follow, and with those at doubling distances after them."""
    gaps = [*range(1, OVERLAP + 1)]
    while gaps[-1] * 2 < num_images:
        gaps.append(gaps[-1] * 2)
    return [(i, i + gap) for gap in gaps for i in range(num_images - gap)]


def alike_pairs(descriptors: Sequence[Float32[np.ndarray, "_ c"]], num_alike: int) -> set[Pair]:
    """Each image with the `num_alike` images that look most like it; images without descriptors are left out.

    Alike means: similar vectors of locally aggregated descriptors (VLAD, Jégou et al., CVPR 2010) over a vocabulary
    that is learned from the images themselves. COLMAP's vocabulary tree would have to be downloaded.
    """
    filled = [i for i, rows in enumerate(descriptors) if len(rows)]
    if len(filled) < 2:
        return set()
    samples = [descriptors[i][:: -(-len(descriptors[i]) // MAX_SAMPLES)] for i in filled]
    rows = np.concatenate(samples)
    rows = rows[:: -(-len(rows) // (VOCABULARY * 200))]
    first = rows[np.linspace(0, len(rows) - 1, min(VOCABULARY, len(rows))).astype(int)]  # the same rows, the same words
    words, _ = kmeans(rows, first)
    vectors = []
    for rows in samples:
        sums, nearest = np.zeros_like(words), vq(rows, words)[0]
        np.add.at(sums, nearest, rows - words[nearest])
        sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
        vectors.append(sums.reshape(-1) / max(float(np.linalg.norm(sums)), 1e-9))
    likeness = np.array(vectors) @ np.array(vectors).T
    np.fill_diagonal(likeness, -np.inf)
    partners = np.argsort(-likeness, axis=1, kind="stable")[:, : min(num_alike, len(filled) - 1)]
    ends = [(filled[i], filled[j]) for i, row in enumerate(partners.tolist()) for j in row]
    return {(min(pair), max(pair)) for pair in ends}


def match_pairs(space: Workspace, pairs: Sequence[Pair], advance: Advance) -> None:
    """Matches pairs of images and verifies the matches; pairs that the database holds are not matched again."""
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    names, pairs_file = space.names, space.database.with_suffix(".pairs.txt")
    for k in range(0, len(pairs), PAIRS_PER_CALL):
        some = pairs[k : k + PAIRS_PER_CALL]
        pairs_file.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in some))
        _cancellable(
            pycolmap.match_image_pairs,
            space.database,
            pairing_options=pycolmap.ImportedPairingOptions(match_list_path=str(pairs_file)),
            verification_options=verification,
        )
        advance(k + len(some))
    pairs_file.unlink(missing_ok=True)


def map_images(space: Workspace, scratch: Path, advance: Advance) -> Any | None:
    """Estimates poses, intrinsics and points; `scratch` is an empty folder for COLMAP's files.

    Returns:
        The `pycolmap.Reconstruction` with the most images; None if there is none.
    """
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
    return _refined(max(found.values(), key=lambda model: model.num_reg_images())) if found else None


def _refined(model: Any) -> Any:
    """The model with OpenCV's cameras, all parameters of which are adjusted if they come out plausible."""
    for camera in model.cameras.values():
        f, cx, cy, k1, k2 = camera.params
        is_fisheye = camera.model == pycolmap.CameraModelId.RADIAL_FISHEYE
        camera.model = pycolmap.CameraModelId.OPENCV_FISHEYE if is_fisheye else pycolmap.CameraModelId.OPENCV
        camera.params = [f, f, cx, cy, k1, k2, 0.0, 0.0]
    if model.num_reg_images() >= MIN_FREE_IMAGES:
        free = copy.deepcopy(model)
        config = pycolmap.BundleAdjustmentConfig()
        for key in free.reg_image_ids():
            config.add_image(key)
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, print_summary=False)
        pycolmap.create_default_bundle_adjuster(options, config, free).solve()
        cameras = [(c.params[:2], c.params[2:4] / [c.width, c.height]) for c in free.cameras.values()]
        if all(abs(f[0] / f[1] - 1) <= MAX_ASPECT and max(abs(c - 0.5)) <= MAX_CENTER_SHIFT for f, c in cameras):
            model = free
    model.update_point_3d_errors()
    return model


def _cancellable(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Calls a function of COLMAP on another thread; an exception in this one, such as Ctrl-C, cancels it."""
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


def write_capture(out: Path, model: Any) -> None:
    """Writes a reconstruction to `sparse/0` of COLMAP, and as transforms.json.

    Poses there are camera-to-world with OpenGL axes, in the reconstruction's frame and unit; intrinsics, per image, are
    in pixels with the center of the first pixel at (0.5, 0.5), which is COLMAP's convention too.
    """
    shutil.rmtree(out / "sparse", ignore_errors=True)
    (out / "sparse" / "0").mkdir(parents=True)
    model.write(out / "sparse" / "0")
    frames, images = [], [image for image in model.images.values() if image.has_pose]
    for image in sorted(images, key=lambda image: image.name):
        camera, worldtocam = image.camera, np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
        names = ("fl_x", "fl_y", "cx", "cy", *LENS_PARAMETERS[camera.model_name])
        frame = {"file_path": f"images/{image.name}", "camera_model": camera.model_name}
        frame |= {"w": camera.width, "h": camera.height, **dict(zip(names, map(float, camera.params), strict=True))}
        frames.append(frame | {"transform_matrix": (invert_pose(worldtocam) @ OPENGL_TO_OPENCV).tolist()})
    write_json(out / "transforms.json", {"frames": frames})
