"""The step, and what feeds it chunk by chunk."""
