"""The `ssplat` command line, a command a file."""
