"""glTF of other writers: nodes turn, move and scale Gaussians; quantized and interleaved attributes are understood."""

import base64
import json

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssplat_jax.core.cameras import Camera
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.core.pytree import replace
from ssplat_jax.rasterizer import render
from ssplat_jax.scene_files.gltf import save_gltf
from ssplat_jax.scene_files.gltf_reader import read_gltf
from tests.scene_files.scene_fixture import camera, decibels, scene

PREFIX = "KHR_gaussian_splatting:"
TURN = Rotation.from_rotvec([0.4, -1.1, 0.7])
SCALE, SHIFT = 1.7, np.array([0.3, -2.0, 5.0])
FLIP = np.diag([-1.0, -1.0, 1.0])  # y up to y down
RENDER_DB = 60.0


@pytest.fixture
def document(tmp_path):
    """The JSON of a written scene of 100 Gaussians."""
    save_gltf(tmp_path / "a.gltf", scene(3, n=100))
    return json.loads((tmp_path / "a.gltf").read_text())


def read(tmp_path, document) -> Gaussians:
    (tmp_path / "b.gltf").write_text(json.dumps(document))
    return read_gltf(tmp_path / "b.gltf").gaussians


def moved_camera(view: Camera) -> Camera:
    """The camera that sees the scene of the node below as `view` sees the written one."""
    to_scene = np.eye(4)  # from the file's axes in the node to those of a .ply
    to_scene[:3, :3] = FLIP @ TURN.as_matrix() * SCALE
    to_scene[:3, 3] = FLIP @ SHIFT
    viewmat = np.asarray(view.viewmats, np.float64) @ np.linalg.inv(to_scene)
    viewmat[:3] *= SCALE  # lengths are larger by this factor everywhere, which no image shows
    return replace(view, viewmats=jnp.asarray(viewmat, jnp.float32))


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize("as_matrix", [False, True])
def test_nodes_turn_move_and_scale_gaussians_with_their_sh(tmp_path, document, nested, as_matrix):
    node = {"translation": SHIFT.tolist(), "rotation": TURN.as_quat().tolist(), "scale": [SCALE] * 3}
    if as_matrix:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = TURN.as_matrix() * SCALE, SHIFT
        node = {"matrix": matrix.T.ravel().tolist()}
    document["nodes"] = [node | {"children": [1]}, {"mesh": 0}] if nested else [node | {"mesh": 0}]
    found = read(tmp_path, document)
    for view in (camera(), camera(0.4)):
        drawn = render(scene(3, n=100), view).color
        assert float(drawn.std()) > 0.05
        assert decibels(drawn, render(found, moved_camera(view)).color) >= RENDER_DB


def test_meshes_of_several_nodes_are_one_scene(tmp_path, document):
    document["nodes"] = [{"mesh": 0, "rotation": [0, 0, 1, 0]}, {"mesh": 0, "translation": [0.0, 0.0, 9.0]}]
    document["scenes"] = [{"nodes": [0, 1]}]
    found, once = read(tmp_path, document), scene(3, n=100)
    assert found.num_gaussians == 200
    np.testing.assert_allclose(found.means[:100], once.means, atol=1e-6)
    np.testing.assert_allclose(found.means[100:], np.asarray(once.means) * [-1, -1, 1] + [0, 0, 9], atol=1e-6)


def with_attribute(document, name, values, component, **accessor):
    """The document with one attribute replaced by `values` in a buffer of its own."""
    data = bytes(4) + values.tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    document["buffers"].append({"byteLength": len(data), "uri": uri})
    document["bufferViews"].append(
        {"buffer": len(document["buffers"]) - 1, "byteOffset": 4, "byteLength": values.nbytes}
        | accessor.pop("view", {})
    )
    kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[values.shape[-1]]
    held = {"bufferView": len(document["bufferViews"]) - 1, "componentType": component, "count": 100, "type": kind}
    document["accessors"].append(held | accessor)
    document["meshes"][0]["primitives"][0]["attributes"][PREFIX + name] = len(document["accessors"]) - 1
    return document


def test_normalized_integers_are_fractions(tmp_path, document):
    gaussians = scene(3, n=100)
    opacities = np.round(255 * np.asarray(gaussians.opacities)[:, None]).astype("u1")
    quats = np.asarray(gaussians.quats)[:, [1, 2, 3, 0]]
    quats = np.round(32767 * quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype("<i2")
    with_attribute(document, "OPACITY", opacities, 5121, normalized=True)
    with_attribute(document, "ROTATION", quats, 5122, normalized=True)
    found = read(tmp_path, document)
    np.testing.assert_allclose(found.opacities, gaussians.opacities, atol=0.51 / 255)
    drawn = render(gaussians, camera()).color
    assert decibels(drawn, render(found, camera()).color) >= 45


def test_interleaved_attributes_are_read_with_their_stride(tmp_path, document):
    scales = np.asarray(scene(3, n=100).scales, "<f4")
    spaced = np.concatenate([scales, np.full((100, 2), 77, "<f4")], axis=1)
    padded = np.ndarray((100, 3), "<f4", spaced.tobytes(), strides=(20, 4))
    assert np.array_equal(padded, scales)
    document = with_attribute(document, "SCALE", spaced.reshape(500, 1), 5126, type="VEC3", view={"byteStride": 20})
    np.testing.assert_allclose(read(tmp_path, document).scales, scales, rtol=1e-6)


BAD = {
    "stretched": (lambda d: d["nodes"][0].update(scale=[1, 2, 1]), "stretches"),
    "mirrored": (lambda d: d["nodes"][0].update(scale=[-1, 1, 1]), "stretches"),
    "its own child": (lambda d: d["nodes"][0].update(children=[0]), "contain themselves"),
    "no such mesh": (lambda d: d["nodes"][0].update(mesh=7), "cannot use its glTF"),
    "no extension": (
        lambda d: (d.pop("extensionsUsed"), d["meshes"][0]["primitives"][0].pop("extensions")),
        "it has none",
    ),
    "compressed": (lambda d: d["meshes"][0]["primitives"][0].update(attributes={}), "compressed"),
    "sparse": (lambda d: d["accessors"][0].update(sparse={}), "sparse"),
    "count too large": (lambda d: d["accessors"][0].update(count=10**9), "beyond its buffer"),
    "negative offset": (lambda d: d["bufferViews"][0].update(byteOffset=-8), "beyond its buffer"),
    "zero stride": (lambda d: d["bufferViews"][0].update(byteStride=0), "beyond its buffer"),
    "different lengths": (lambda d: d["accessors"][2].update(count=99), "different lengths"),
    "unknown component": (lambda d: d["accessors"][0].update(componentType=1), "cannot use its glTF"),
    "encoded outside": (lambda d: d["buffers"][0].update(uri="%2e%2e/passwd"), "outside"),
    "outside": (lambda d: d["buffers"][0].update(uri="../../etc/passwd"), "outside"),
    "broken base64": (lambda d: d["buffers"][0].update(uri="data:,*"), "cannot use its glTF"),
    "a list": (lambda d: d.update(nodes=7), "cannot use its glTF"),
    "no asset": (lambda d: d.pop("asset"), "no asset"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_spoiled_document_is_refused_in_one_line(tmp_path, document, name):
    change, words = BAD[name]
    change(document)
    with pytest.raises(InputError) as caught:
        read(tmp_path, document)
    assert words in str(caught.value) and "b.gltf" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(("name", "uri"), [("data.bin", "data.bin"), ("my scene%.bin", "my%20scene%25.bin")])
def test_a_buffer_beside_the_file_is_read(tmp_path, document, name, uri):
    """Names in URIs are percent-encoded."""
    embedded = document["buffers"][0]["uri"]
    (tmp_path / name).write_bytes(base64.b64decode(embedded.partition(",")[2]))
    document["buffers"][0]["uri"] = uri
    assert read(tmp_path, document).num_gaussians == 100


@pytest.mark.parametrize("is_turned", [False, True])
def test_a_rotation_that_is_not_finite_is_refused(tmp_path, document, is_turned):
    quats = np.tile(np.float32([0, 0, 0, 1]), (100, 1))
    quats[7, 2] = np.nan
    with_attribute(document, "ROTATION", quats, 5126)
    if is_turned:  # without our half turn, the columns are turned
        document["nodes"][0].pop("rotation")
    with pytest.raises(InputError, match="finite"):
        read(tmp_path, document)


def test_deep_json_is_refused(tmp_path):
    (tmp_path / "b.gltf").write_text("[" * 100_000)
    with pytest.raises(InputError, match="JSON"):
        read_gltf(tmp_path / "b.gltf")
