"""What `ssplat bench` measures."""
