"""Readers that turn trained splats and their training images into a `Scene` of the core."""
