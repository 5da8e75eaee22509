"""VACC, the Voxel-Aligned Causal Cache (Sec. 3.4): `fuse` writes tokens, `project` shows them, `carve` revises."""
