"""Files and folders: arrays, JSON, video, weights, saved states, run folders and their locks."""
