"""Gaussians, cameras, rotations, numerics, errors, terminal output, atomic files, kept programs: for every layer."""
