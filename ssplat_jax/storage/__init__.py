"""Files and folders: atomic writes, locks, JSON, npz, video, PyTorch checkpoints, run folders."""
