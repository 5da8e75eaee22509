"""Training: recipes, samples, losses, a pure training step, and the loop that logs, saves and resumes."""
