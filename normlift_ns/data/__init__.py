"""Readers of trained splats and their training images. Together, they open a `Scene` of the core."""
