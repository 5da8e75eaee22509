"""Scores, exposures and latency of novel views."""
