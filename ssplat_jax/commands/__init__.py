"""The `ssplat` command line: one file per command."""
