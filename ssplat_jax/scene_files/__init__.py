"""Scene files (.ply, .compressed.ply, .spz, .sog, .glb, .splat); the tests read what is written with other readers."""
