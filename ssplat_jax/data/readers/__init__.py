"""Readers of capture formats, one module each with `FORMAT` (its name), `matches(path)` and `read(path) -> Listing`.

A module whose files are not of camera-to-world poses with OpenCV axes says so in a `CONVENTION`. A reader checks
everything that can be checked without decoding an image, and raises `InputError`.
"""
