"""Conventions of the package: camera axes, pixels, frames, array axes and names. This module holds no code.

## Cameras

Cameras have OpenCV axes: x points right, y points down, z points forward.

```text
              z  forward, the viewing direction
             /
            /
    center +----------> x  right
           |
           |
           v
           y  down
```

- `viewmats` map world to camera: `p_camera = viewmat @ p_world`, with homogeneous points.
- `camtoworlds` are their inverse; the last column is the camera's center.
- `Ks` are 3 x 3 intrinsics in pixels: `pixel = (K @ p_camera)[:2] / z`.
- `depths` are the z coordinate in the camera, not the length of the ray.

## Pixels

Pixel coordinates are (x, y) with the origin at the top left corner of the image. The center of the first pixel is at
(0.5, 0.5); arrays are indexed `[row, column]`, that is `[y, x]`.

```text
    (0, 0)
      +-----------+-----------+---> x
      |     .     |     .     |
      | (0.5,0.5) | (1.5,0.5) |
      +-----------+-----------+
      |     .     |     .     |
      | (0.5,1.5) | (1.5,1.5) |
      +-----------+-----------+
      |
      v  y
```

## Frames

| Frame | Origin and axes | Unit of length |
|---|---|---|
| capture frame | those of the poses as the user gave them | the capture's |
| stream frame | those of the first camera | capture unit / scene scale (`data.stream_frame.StreamFrame`) |

The network and the cache work in the stream frame, so that a voxel means the same in every capture. Lengths are in the
unit of their frame and angles in radians unless a name says otherwise.

## Array axes

| Letter | Axis |
|---|---|
| `b` | batch: streams, or any leading axes (`*b`) |
| `t` | chunks in order of time |
| `v` | views of a chunk |
| `s` | source views of a view; target views of a training sample |
| `h w` | pixels |
| `hp wp` | pixels of the padded image |
| `hf wf` | feature grid, 1/4 of the padded image: one token per cell |
| `hm wm` | matching grid of the cost volume |
| `d` | depth candidates |
| `c` | channels |
| `m` | tokens |
| `n` | Gaussians |
| `k` | pivots of a voxel; coefficients of spherical harmonics in `sh` |
| `g` | cells along a side of a stored coarse view |
| `r` | residual numbers of a pivot |
| `a` | numbers of a pivot's mean colors |
| `slots` | entries of the hash table |
| `capacity` | voxels that a cache can hold |

## Values

- Images are float32 RGB in [0, 1], `[v h w 3]`.
- Quaternions are wxyz.
- `log_depths` are natural logarithms of `depths`.
- Gaussians have `means`, `quats`, `scales`, `opacities` and `sh`. These names stand for activated values (`scales` are
  standard deviations, `opacities` lie in [0, 1]); values before activation say so (`raw_scales`, `log_scales`,
  `logit_opacities`).
"""
