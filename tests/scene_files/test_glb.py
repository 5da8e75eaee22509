""".glb of other writers: nodes turn, move and scale Gaussians; quantized and interleaved attributes are understood."""

import json
import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.scene_files.formats import load_scene, save_gaussians
from tests.scene_files.scene_fixture import assert_turned, scene

PREFIX = "KHR_gaussian_splatting:"
TURN = Rotation.from_rotvec([0.4, -1.1, 0.7])
SCALE, SHIFT = 1.7, np.array([0.3, -2.0, 5.0])
FLIP = np.diag([-1.0, -1.0, 1.0])  # y up to y down


class Glb:
    """A written scene of 100 Gaussians as its JSON and its buffer, to be changed and read again."""

    def __init__(self, folder):
        self.path = folder / "b.glb"
        save_gaussians(self.path, scene(3, n=100))
        data = self.path.read_bytes()
        (size,) = struct.unpack_from("<I", data, 12)
        self.document, self.buffer = json.loads(data[20 : 20 + size]), data[28 + size :]

    def read(self) -> Gaussians:
        text = json.dumps(self.document).encode()
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(self.buffer), b"BIN\0")
        self.path.write_bytes(struct.pack("<4sII", b"glTF", 2, 0) + chunks + self.buffer)
        return load_scene(self.path)

    def with_attribute(self, name, values, component, view=None, **accessor):
        """Points an attribute at `values`, which are appended to the buffer."""
        place = {"buffer": 0, "byteOffset": len(self.buffer), "byteLength": values.nbytes}
        self.document["bufferViews"].append(place | (view or {}))
        self.buffer += values.tobytes()
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[values.shape[-1]]
        place = len(self.document["bufferViews"]) - 1
        held = {"bufferView": place, "componentType": component, "count": 100, "type": kind} | accessor
        self.document["accessors"].append(held)
        attributes = self.document["meshes"][0]["primitives"][0]["attributes"]
        attributes[PREFIX + name] = len(self.document["accessors"]) - 1


@pytest.fixture
def glb(tmp_path):
    return Glb(tmp_path)


@pytest.mark.parametrize(("is_nested", "is_mirrored"), [(False, False), (True, False), (False, True)])
def test_nodes_turn_move_and_scale_gaussians_with_their_sh(glb, is_nested, is_mirrored):
    matrix = np.eye(4)
    mirror = np.diag([1.0, 1.0, -1.0 if is_mirrored else 1.0])
    matrix[:3, :3], matrix[:3, 3] = TURN.as_matrix() * SCALE, SHIFT
    node = {
        "translation": SHIFT.tolist(),
        "rotation": TURN.as_quat().tolist(),
        "scale": (SCALE * np.diag(mirror)).tolist(),
    }
    if is_nested:
        glb.document["nodes"] = [{"matrix": matrix.T.ravel().tolist(), "children": [1]}, {"mesh": 0}]
    else:
        glb.document["nodes"] = [node | {"mesh": 0}]
    found, once, turn = glb.read(), scene(3, n=100), FLIP @ TURN.as_matrix() @ mirror
    np.testing.assert_allclose(found.means, np.asarray(once.means) @ (SCALE * turn).T + FLIP @ SHIFT, atol=1e-5)
    assert_turned(found, once, turn, SCALE)


def test_meshes_of_several_nodes_are_one_scene(glb):
    (primitive,) = glb.document["meshes"][0]["primitives"]
    few = {name: x for name, x in primitive["attributes"].items() if "DEGREE_2" not in name and "DEGREE_3" not in name}
    glb.document["meshes"].append({"primitives": [primitive | {"attributes": few}]})
    glb.document["nodes"] = [{"mesh": 0, "rotation": [0, 0, 1, 0]}, {"mesh": 1, "translation": [0.0, 0.0, 9.0]}]
    glb.document["scenes"] = [{"nodes": [0, 1]}]
    found, once = glb.read(), scene(3, n=100)
    np.testing.assert_allclose(found.means[:100], once.means, atol=1e-6)
    np.testing.assert_allclose(found.means[100:], np.asarray(once.means) * [-1, -1, 1] + [0, 0, 9], atol=1e-6)
    np.testing.assert_array_equal(found.sh[100:, 0], once.sh[:, 0])
    assert not np.any(found.sh[100:, 4:]) and np.any(found.sh[100:, 1:4])


def test_normalized_integers_are_fractions_and_strides_are_kept(glb):
    gaussians = scene(3, n=100)
    opacities = np.round(255 * np.asarray(gaussians.opacities)[:, None]).astype("u1")
    quats = np.asarray(gaussians.quats)[:, [1, 2, 3, 0]]
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    scales = np.asarray(gaussians.scales, "<f4")
    spaced = np.concatenate([scales, np.full((100, 2), 77, "<f4")], axis=1)
    glb.with_attribute("OPACITY", opacities, 5121, normalized=True)
    glb.with_attribute("ROTATION", np.round(32767 * quats).astype("<i2"), 5122, normalized=True)
    glb.with_attribute("SCALE", spaced.reshape(500, 1), 5126, type="VEC3", view={"byteStride": 20})
    found = glb.read()
    np.testing.assert_allclose(found.opacities, gaussians.opacities, atol=0.51 / 255)
    np.testing.assert_allclose(np.asarray(found.quats)[:, [1, 2, 3, 0]], quats, atol=1e-4)
    np.testing.assert_allclose(found.scales, scales, rtol=1e-6)


@pytest.mark.parametrize("is_turned", [False, True])
def test_a_rotation_that_is_not_finite_is_refused(glb, is_turned):
    quats = np.tile(np.float32([0, 0, 0, 1]), (100, 1))
    quats[7, 2] = np.nan
    glb.with_attribute("ROTATION", quats, 5126)
    if is_turned:  # without our half turn, the columns are turned
        glb.document["nodes"][0].pop("rotation")
    with pytest.raises(InputError, match="quats, row 7: wanted finite"):
        glb.read()


def extension(document: dict) -> dict:
    return document["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]


BAD = {
    "stretched": (lambda d: d["nodes"][0].update(scale=[1, 2, 1]), "stretches"),
    "its own child": (lambda d: d["nodes"][0].update(children=[0]), "two parents"),
    "no extension": (lambda d: (d.pop("extensionsUsed"), d["meshes"][0]["primitives"][0].pop("extensions")), "none"),
    "linear colors": (lambda d: extension(d).update(colorSpace="lin_rec709_display"), "colorSpace"),
    "another kernel": (lambda d: extension(d).update(kernel="box"), "kernel"),
    "compressed": (lambda d: d["meshes"][0]["primitives"][0].update(attributes={}), "compressed"),
    "sparse": (lambda d: d["accessors"][0].update(sparse={}), "sparse"),
    "count too large": (lambda d: d["accessors"][0].update(count=10**9), "beyond its buffer"),
    "negative offset": (lambda d: d["bufferViews"][0].update(byteOffset=-8), "beyond its buffer"),
    "different lengths": (lambda d: d["accessors"][2].update(count=99), "different lengths"),
    "unknown component": (lambda d: d["accessors"][0].update(componentType=1), "KeyError"),
    "outside": (lambda d: d["buffers"][0].update(uri="../../etc/passwd"), "outside"),
    "instances": (
        lambda d: d["nodes"][0].update(extensions={"EXT_mesh_gpu_instancing": {}}),
        "EXT_mesh_gpu_instancing",
    ),
    "hidden": (lambda d: d["nodes"][0].update(extensions={"KHR_node_visibility": {}}), "KHR_node_visibility"),
    "a skin": (lambda d: d["nodes"][0].update(skin=0), "skin"),
    "in another scene": (lambda d: d["scenes"].insert(0, {"nodes": []}), "it has none"),
    "no asset": (lambda d: d.pop("asset"), "asset"),
    "no finite offset": (lambda d: d["asset"]["extras"].update(offset=[0, float("inf"), 0]), "offset"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_spoiled_document_is_refused_in_one_line(glb, name):
    change, words = BAD[name]
    change(glb.document)
    with pytest.raises(InputError) as caught:
        glb.read()
    assert words in str(caught.value) and "b.glb" in str(caught.value) and "\n" not in str(caught.value)
