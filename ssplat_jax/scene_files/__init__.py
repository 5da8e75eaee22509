"""Scene files (.ply, .compressed.ply, .spz, .sog, glTF, .splat); tests read what is written with other readers, too."""
