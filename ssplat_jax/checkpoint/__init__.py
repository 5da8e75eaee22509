"""What is kept on disk: training states (Orbax), shipped weights and stream states (npz, verified by sha256)."""
