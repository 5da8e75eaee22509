"""Writers of one small capture in every format that `data.readers` reads.

Rotations are converted with SciPy, which the readers do not use.
"""

import json
import struct

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.badinputs.cases import HEIGHT, NUM_FRAMES, WIDTH

FX, FY, CX, CY = 50.0, 51.0, 31.0, 25.0
K = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
COLMAP_IMAGES = ("b 0.jpg", "9.jpg", "10.jpg", "c/1.jpg")  # names with spaces, folders and numbers, unsorted
IDS = (7, 3, 900, 12)  # COLMAP's ids of the images


def poses():
    """Camera-to-world matrices of a moving and rotating camera."""
    rotations = Rotation.from_rotvec([[0.1 * i, 0.2 - 0.1 * i, 0.05] for i in range(NUM_FRAMES)])
    matrices = np.tile(np.eye(4), (NUM_FRAMES, 1, 1))
    matrices[:, :3, :3] = rotations.as_matrix()
    matrices[:, :3, 3] = [[0.1 * i, 0.02 * i * i, 0.3] for i in range(NUM_FRAMES)]
    return matrices


def write_image(path, i=0, size=(WIDTH, HEIGHT)):
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(i).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path)


def write_depth(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((HEIGHT // 2, WIDTH // 2), value, np.uint16)).save(path)


def colmap_pose(i):
    """(quaternion wxyz, translation) of the world-to-camera transform."""
    worldtocam = np.linalg.inv(poses()[i])
    x, y, z, w = Rotation.from_matrix(worldtocam[:3, :3]).as_quat()
    return (w, x, y, z), tuple(worldtocam[:3, 3])


def write_colmap_images(root, folder="images", size=(WIDTH, HEIGHT)):
    for i, name in enumerate(COLMAP_IMAGES):
        write_image(root / folder / name, i, size)


def write_colmap_text(root, *, camera=f"1 PINHOLE {WIDTH} {HEIGHT} {FX} {FY} {CX} {CY}", sparse="sparse/0"):
    write_colmap_images(root)
    (root / sparse).mkdir(parents=True, exist_ok=True)
    (root / sparse / "cameras.txt").write_text(f"# a comment\n{camera}\n")
    lines = ["# IMAGE_ID, QW ...", "# POINTS2D"]
    for i in (2, 0, 3, 1):
        quat, translation = colmap_pose(i)
        # Two 2D points, one of them with a 3D point; one image has none.
        points = "1.5 2.5 -1 3.5 4.5 17" if i else ""
        pose = " ".join(repr(float(x)) for x in (*quat, *translation))
        lines += [f"{IDS[i]} {pose} 1 {COLMAP_IMAGES[i]}", points]
    (root / sparse / "images.txt").write_text("\n".join(lines) + "\n")


def camera_bytes(model, params, camera=1, size=(WIDTH, HEIGHT)):
    return struct.pack(f"<IiQQ{len(params)}d", camera, model, *size, *params)


def write_colmap_binary(root, cameras=None, sparse="sparse/0"):
    write_colmap_images(root)
    (root / sparse).mkdir(parents=True, exist_ok=True)
    cameras = [camera_bytes(1, (FX, FY, CX, CY))] if cameras is None else cameras
    (root / sparse / "cameras.bin").write_bytes(struct.pack("<Q", len(cameras)) + b"".join(cameras))
    data = struct.pack("<Q", NUM_FRAMES)
    for i in (2, 0, 3, 1):
        quat, translation = colmap_pose(i)
        data += struct.pack("<I7dI", IDS[i], *quat, *translation, 1) + COLMAP_IMAGES[i].encode() + b"\0"
        data += struct.pack("<Q", i) + i * struct.pack("<ddq", 1.5, 2.5, -1)
    (root / sparse / "images.bin").write_bytes(data)


def matrix_text(matrix):
    return "\n".join(" ".join(repr(float(x)) for x in row) for row in matrix) + "\n"


def written(root, pattern):
    """Numbers and poses of the images, each of which is written to `root` under its name."""
    for i, pose in enumerate(poses()):
        write_image(root / pattern.format(i), i)
        yield i, pose


def write_scannet(root):
    for folder in ("pose", "intrinsic"):
        (root / folder).mkdir()
    for i, pose in enumerate(poses(), start=9):
        write_image(root / "color" / f"{i}.jpg", i)
        write_depth(root / "depth" / f"{i}.png", 1500)
        (root / "pose" / f"{i}.txt").write_text(matrix_text(pose))
    intrinsics = np.eye(4)
    intrinsics[:3, :3] = K
    (root / "intrinsic" / "intrinsic_color.txt").write_text(matrix_text(intrinsics))


def tum_line(time, pose):
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return f"{time:.4f} " + " ".join(repr(float(v)) for v in (*pose[:3, 3], x, y, z, w))


def write_tum(root):
    images, depths, truth = ["# color images"], [], ["# ground truth"]
    for i, pose in enumerate(poses()):
        time = 1305031102.25 + i / 30
        write_image(root / "rgb" / f"{time:.6f}.png", i)
        write_depth(root / "depth" / f"{i}.png", 7500)
        images.append(f"{time:.6f} rgb/{time:.6f}.png")
        depths.append(f"{time + 0.01:.6f} depth/{i}.png")
        truth.append(f"{time:.6f} " + tum_line(0, pose).split(maxsplit=1)[1])
    truth[2:4] = truth[3:1:-1]  # unsorted
    (root / "rgb.txt").write_text("\n".join(images))
    (root / "depth.txt").write_text("\n".join(depths))
    (root / "groundtruth.txt").write_text("\n".join(truth))
    (root / "calibration.txt").write_text(f"{FX} {FY} {CX - 0.5} {CY - 0.5}\n")


def write_realestate(root):
    lines = ["https://www.youtube.com/watch?v=0123456789a"]
    for i, pose in enumerate(poses()):
        write_image(root / "0a1b" / f"{90000 + 33367 * i}.png", i)
        row = (FX / WIDTH, FY / HEIGHT, CX / WIDTH, CY / HEIGHT, 0, 0, *np.linalg.inv(pose)[:3].reshape(-1))
        lines.append(f"{90000 + 33367 * i} " + " ".join(repr(float(x)) for x in row))
    (root / "0a1b.txt").write_text("\n".join(lines))


OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # columns of OpenCV's camera axes to those of OpenGL


def write_splat_cameras(root):
    entries = []
    for i, pose in written(root, "images/frame_{}.png"):
        size = {"width": WIDTH, "height": HEIGHT, "fx": FX, "fy": FY}
        pose = {"position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist()}
        entries.append({"id": i, "img_name": f"frame_{i}", **size, **pose})
    (root / "cameras.json").write_text(json.dumps(entries))


def write_polycam(root):
    for i, pose in enumerate(poses()):
        write_image(root / "keyframes" / "images" / f"{7000 + i}.jpg", i)
        write_depth(root / "keyframes" / "depth" / f"{7000 + i}.png", 1500)
        fields = {"fx": FX, "fy": FY, "cx": CX, "cy": CY, "width": WIDTH, "height": HEIGHT, "blur_score": 80.5}
        fields |= {f"t_{row}{column}": (pose @ OPENGL)[row, column] for row in range(3) for column in range(4)}
        (root / "keyframes" / "cameras").mkdir(exist_ok=True)
        (root / "keyframes" / "cameras" / f"{7000 + i}.json").write_text(json.dumps(fields))


def write_record3d(root):
    rows = []
    for _, pose in written(root, "rgb/{}.jpg"):
        rows.append([*Rotation.from_matrix((pose @ OPENGL)[:3, :3]).as_quat().tolist(), *pose[:3, 3].tolist()])
    meta = {"w": WIDTH, "h": HEIGHT, "K": K.T.reshape(-1).tolist(), "poses": rows, "fps": 60}
    (root / "metadata.json").write_text(json.dumps(meta))


def write_llff(root):
    rows = []
    for _, pose in written(root, "images/IMG_{}.JPG"):
        right, down, forward, center = pose[:3].T
        matrix = np.stack([down, right, -forward, center, (HEIGHT, WIDTH, FX)], axis=1)
        rows.append([*matrix.reshape(-1), 1.5, 9.0])
    np.save(root / "poses_bounds.npy", np.array(rows))


def write_kitti(root):
    offset = np.array([0.3, -0.02, 0.005])  # of camera 2 from camera 0, in the axes of both
    image_K = K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    lines = [f"P{i}: " + " ".join(["1"] * 12) for i in range(2)]
    projection = np.hstack([image_K, (image_K @ -offset)[:, None]])
    lines.append("P2: " + " ".join(repr(float(x)) for x in projection.reshape(-1)))
    rows = []
    for _, pose in written(root, "image_2/{:06d}.png"):
        back = np.eye(4)
        back[:3, 3] = -offset
        rows.append(" ".join(repr(float(x)) for x in (pose @ back)[:3].reshape(-1)))
    (root / "calib.txt").write_text("\n".join(lines))
    (root / "poses.txt").write_text("\n".join(rows))


def write_reality_capture(root):
    rows = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for i, pose in written(root, "images/{}.jpg"):
        turn, pitch, roll = Rotation.from_matrix((pose @ OPENGL)[:3, :3]).as_euler("ZXY", degrees=True)
        inner = np.array([FX, CX - WIDTH / 2, CY - HEIGHT / 2]) * 36 / WIDTH
        values = (*pose[:3, 3], -turn, pitch, roll, *inner)
        rows.append(f"{i}.jpg," + ",".join(repr(float(x)) for x in values) + ",0,0,0,0,0,0")
    (root / "cameras.csv").write_text("\r\n".join(rows))


def write_metashape(root):
    cameras = "".join(
        f'<camera id="{i}" sensor_id="0" component_id="0" label="{i}"><transform>{matrix_text(m)}</transform></camera>'
        for i, m in written(root, "images/{}.jpg")
    )
    text = (
        '<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="c"><sensors><sensor id="0">'
        '<calibration type="frame" class="initial"><f>1</f></calibration><calibration type="frame" class="adjusted">'
        f'<resolution width="{WIDTH}" height="{HEIGHT}"/><f>{FY}</f><b1>{FX - FY}</b1><cx>{CX - WIDTH / 2}</cx>'
        f"<cy>{CY - HEIGHT / 2}</cy></calibration></sensor></sensors><cameras>{cameras}</cameras></chunk></document>"
    )
    (root / "cameras.xml").write_text(text)


def edit_text(file, change):
    """Writes what `change` makes of a text file; it must change it."""

    def spoil(root):
        text = (root / file).read_text()
        assert change(text) != text
        (root / file).write_text(change(text))

    return spoil


def edit_json(file, **fields):
    """Sets fields of a JSON object, or of each entry of a list."""

    def change(text):
        value = json.loads(text)
        for entry in value if isinstance(value, list) else [value]:
            entry.update(fields)
        return json.dumps(value)

    return edit_text(file, change)


def remove(*patterns):
    return lambda root: [file.unlink() for pattern in patterns for file in root.glob(pattern)]


WRITERS = {
    "COLMAP": write_colmap_binary,
    "COLMAP text": write_colmap_text,
    "ScanNet": write_scannet,
    "TUM RGB-D": write_tum,
    "RealEstate10K": write_realestate,
    "cameras.json": write_splat_cameras,
    "Polycam": write_polycam,
    "Record3D": write_record3d,
    "LLFF": write_llff,
    "KITTI": write_kitti,
    "RealityCapture": write_reality_capture,
    "Metashape": write_metashape,
}
