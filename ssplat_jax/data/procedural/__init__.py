"""Procedural worlds with exact cameras and depth, for training, the demo and tests. +y points down."""
