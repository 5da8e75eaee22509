"""Synthetic worlds of textured meshes, rendered with OpenGL into capture folders with exact poses and z-depth."""
