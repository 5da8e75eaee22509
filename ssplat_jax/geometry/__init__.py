"""Rotations, cameras, sampling and voxel keys: plain functions of arrays, no networks."""
