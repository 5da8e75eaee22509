"""Scene files (.ply, .spz, .splat); every writer is atomic, and tests read its files with an independent reader."""
