"""Posed captures: reading them, putting them into the stream frame, choosing frames. NumPy and Pillow until the chunk.

path -> readers/ -> Frame (checked) -> Capture -> scale.py -> StreamFrame -> chunks
"""
