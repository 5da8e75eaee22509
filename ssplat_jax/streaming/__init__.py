"""The streaming step, sessions around it, and the scene changes that it causes."""
