"""The work behind `ssplat run`, `refine`, `eval`, `demo`, `render` and `export`, and their reports."""
