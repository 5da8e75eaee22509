"""Training: losses, one pure train step, and the loop that logs, saves and resumes."""
