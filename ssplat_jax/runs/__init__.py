"""The work behind `ssplat run`, `demo`, `render` and `export`."""
