"""Triangle meshes of the made worlds: boxes, lathed profiles, tori, and their displacement and bends. Meters, z up."""

import dataclasses

import numpy as np


@dataclasses.dataclass
class Mesh:
    """Triangles of one texture."""

    points: np.ndarray  # (n, 3)
    normals: np.ndarray  # (n, 3), unit
    uv: np.ndarray  # (n, 2), in meters along the surface
    triangles: np.ndarray  # (m, 3) indices of points
    layer: int = 0  # texture


def patch(corner, edge_u, edge_v, cell: float = 0.25, layer: int = 0) -> Mesh:
    """A parallelogram split into cells, with its normal along edge_u x edge_v."""
    corner, edge_u, edge_v = (np.asarray(x, float) for x in (corner, edge_u, edge_v))
    lengths = np.linalg.norm(edge_u), np.linalg.norm(edge_v)
    nu, nv = (max(1, int(np.ceil(length / cell))) for length in lengths)
    u, v = (x.ravel() for x in np.meshgrid(np.linspace(0, 1, nu + 1), np.linspace(0, 1, nv + 1), indexing="ij"))
    normal = np.cross(edge_u, edge_v)
    points = corner + u[:, None] * edge_u + v[:, None] * edge_v
    normals = np.broadcast_to(normal / np.linalg.norm(normal), points.shape).copy()
    return Mesh(points, normals, np.stack([u * lengths[0], v * lengths[1]], 1), _grid(nu, nv), layer)


def _grid(nu: int, nv: int) -> np.ndarray:
    first = (np.arange(nu)[:, None] * (nv + 1) + np.arange(nv)).ravel()
    a, b, c, d = first, first + nv + 1, first + nv + 2, first + 1
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def box(low, high, cell: float = 0.25, layer: int = 0) -> Mesh:
    """An axis-aligned box seen from outside."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    x, y, z = np.diag(high - low)
    sides = [(low, y, x), (low, x, z), (low, z, y), (high, -x, -y), (high, -z, -x), (high, -y, -z)]
    return join([patch(corner, u, v, cell, layer) for corner, u, v in sides])


def surface(points: np.ndarray, layer: int = 0) -> Mesh:
    """A mesh through a grid of points (a, b, 3), with smooth normals along d/da x d/db."""
    du, dv = np.gradient(points, axis=0), np.gradient(points, axis=1)
    normals = np.cross(du, dv).reshape(-1, 3)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    along_u = np.cumsum(np.linalg.norm(du, axis=2).mean(1))
    along_v = np.cumsum(np.linalg.norm(dv, axis=2).mean(0))
    uv = np.stack(np.meshgrid(along_u, along_v, indexing="ij"), -1).reshape(-1, 2)
    return Mesh(points.reshape(-1, 3), normals, uv, _grid(points.shape[0] - 1, points.shape[1] - 1), layer)


def lathe(radii, heights, layer: int = 0, sides: int = 20) -> Mesh:
    """A profile turned about the z axis; `radii` and `heights` run from bottom to top."""
    angle = np.linspace(0, 2 * np.pi, sides + 1)[:, None]
    radii, heights = np.asarray(radii, float), np.asarray(heights, float)
    points = np.stack([radii * np.cos(angle), radii * np.sin(angle), np.broadcast_to(heights, (sides + 1, len(radii)))])
    return surface(np.moveaxis(points, 0, -1), layer)


def torus(ring: float, tube: float, layer: int = 0) -> Mesh:
    """A torus lying in the plane z = 0."""
    a, b = np.meshgrid(np.linspace(0, 2 * np.pi, 25), np.linspace(0, 2 * np.pi, 13), indexing="ij")
    reach = ring + tube * np.cos(b)
    return surface(np.stack([reach * np.cos(a), reach * np.sin(a), tube * np.sin(b)], -1), layer)


def bend(mesh: Mesh, amount: float) -> Mesh:
    """`mesh` with x shifted by amount * z^2."""
    points = mesh.points.copy()
    points[:, 0] += amount * points[:, 2] ** 2
    return dataclasses.replace(mesh, points=points)


def displace(mesh: Mesh, rng: np.random.Generator, amount: float) -> Mesh:
    """`mesh` moved along its normals by a smooth random height field of at most `amount` meters."""
    waves = rng.normal(0, 9, (3, 4))
    shift = np.sin(mesh.points @ waves + rng.uniform(0, 6, 4)).mean(1, keepdims=True)
    return dataclasses.replace(mesh, points=mesh.points + amount * shift * mesh.normals)


def move(mesh: Mesh, offset, turn: float = 0.0) -> Mesh:
    """`mesh` turned by `turn` radians about z, then shifted by `offset` meters."""
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return dataclasses.replace(mesh, points=mesh.points @ R.T + np.asarray(offset), normals=mesh.normals @ R.T)


def join(meshes: list[Mesh]) -> Mesh:
    """One mesh of several; the texture is that of the first."""
    starts = np.cumsum([0, *(len(mesh.points) for mesh in meshes)])
    triangles = [mesh.triangles + start for mesh, start in zip(meshes, starts, strict=False)]
    points, normals, uv = (
        np.concatenate([getattr(mesh, name) for mesh in meshes]) for name in ("points", "normals", "uv")
    )
    return Mesh(points, normals, uv, np.concatenate(triangles), meshes[0].layer)
