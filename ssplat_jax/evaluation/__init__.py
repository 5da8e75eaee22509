"""Scores, exposures and latency of rendered views."""
