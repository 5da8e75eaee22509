"""Saved states: training states (Orbax), and weights, stream states and scene deltas (checksummed npz files)."""
