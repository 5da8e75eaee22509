"""A scene in a browser."""
