"""Viewing a scene in a browser."""
