"""The glossary: what every axis letter, name and convention in this package means. Nothing here runs.

Axes
    b streams · v views · t chunks · h w pixels · hf wf feature grid (1/4 of the padded image) · d depth candidates
    c channels · n Gaussians · m tokens · k pivots of a voxel (or SH terms, where it stands beside Gaussians)
    capacity voxels that a cache can hold

Cameras
    OpenCV axes: +x right, +y down, +z forward. `viewmats` map world to camera, `camtoworlds` are the inverse.
    `Ks` are full 3x3 intrinsics in pixels; the center of pixel (0, 0) is at (0.5, 0.5).
    `depths` are camera z, not the length of the ray.

Frames
    capture frame   the frame and units of the poses as the user gave them
    stream frame    what the network works in: the first camera is the origin and lengths are multiplied by the scene
                    scale (`data.frame.StreamFrame`), so that a voxel means the same in every capture

Values
    Images are float32 RGB in [0, 1], `[v h w 3]`. Quaternions are wxyz. Plain names are activated values (`scales`,
    `opacities`); raw ones say so (`log_scales`, `logit_opacities`). Lengths are scene units, angles radians.
    `log_depths` are natural logarithms of camera z: the space of the depth candidates.
"""
