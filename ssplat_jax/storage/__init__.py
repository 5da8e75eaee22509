"""Files and folders: atomic writes, locks, JSON, npz, images, video, PyTorch files."""
