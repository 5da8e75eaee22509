"""The benchmarks of `ssplat bench`."""
