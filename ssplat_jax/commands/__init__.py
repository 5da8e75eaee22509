"""The `ssplat` command line: its entry point, and the commands that stream nothing."""
