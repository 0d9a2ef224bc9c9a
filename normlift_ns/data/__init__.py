"""Readers for trained splats and their training images, which return a `Scene` of the core."""
