"""Posed captures: readers, the stream frame, and the choice and order of frames.

    path -> readers/ -> Frame (checked) -> Capture -> depth_range.py -> StreamFrame -> chunks

Everything is NumPy and Pillow up to the chunks, which are JAX arrays.
"""
