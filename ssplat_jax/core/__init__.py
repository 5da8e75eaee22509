"""Cameras, rotations, sampling and voxel keys: plain functions of arrays, no networks."""
